"""Guesses: what a caller may hand over as the first linearisation point."""

import numpy as np

from scp_mpc.arrays import require_finite
from scp_mpc.errors import InvalidArgumentError, ShapeError
from scp_mpc.problem import Problem
from scp_mpc.scp.iterate import Iterate, Multipliers
from scp_mpc.trajectory import Trajectory


def as_iterate(guess: Trajectory | Iterate, problem: Problem) -> Iterate:
    """Return the guess as an iterate; a bare trajectory gets s = s_ref and no slack.

    Raises:
        InvalidArgumentError: The guess is neither a trajectory nor an iterate.
        ShapeError: Its horizon or sizes are not those of the problem.
        NotFiniteError: NaN or infinity.
    """
    model, N, M = problem.model, problem.horizon, problem.max_obstacles
    if not isinstance(guess, Trajectory | Iterate):
        raise InvalidArgumentError("guess", f"{guess!r} is neither a Trajectory nor an Iterate")
    nodes = N * len(problem.discs) * problem.nodes_per_interval
    if isinstance(guess, Trajectory):
        s = np.full(M, problem.size.reference)
        guess = Iterate(guess.states, guess.inputs, s, np.zeros((M, nodes)))
    path = {"states": (N + 1, model.nx), "inputs": (N, model.nu)}
    _check(guess, {**path, "s": (M,), "slack": (M, nodes)})
    if guess.multipliers is not None:
        shapes = {"dynamics": (N, model.nx), "inputs": (N, model.nu), "margin": (M,)}
        _check(guess.multipliers, {**shapes, "obstacles": (M, nodes), "slack": (M, nodes)})
        if guess.multipliers.states.size:
            _check(guess.multipliers, {"states": (N, len(problem.bounded_states))})
        if guess.multipliers.rates.size:
            _check(guess.multipliers, {"rates": (N, model.nu)})
    return guess


def _check(owner: Iterate | Multipliers, shapes: dict[str, tuple[int, ...]]) -> None:
    for name, shape in shapes.items():
        array = getattr(owner, name)
        if array.shape != shape:
            raise ShapeError(f"guess.{name}", f"shape {array.shape} is not {shape}")
        if not np.isfinite(array.sum()):  # the quick way to know that all is well
            require_finite(f"guess.{name}", array)
