"""Guesses: what a caller may hand over as the first linearisation point."""

import numpy as np

from scp_mpc.errors import InvalidArgumentError, ShapeError
from scp_mpc.problem import Problem
from scp_mpc.solver.iterate import Iterate
from scp_mpc.trajectory import Trajectory


def as_iterate(guess: Trajectory | Iterate, problem: Problem) -> Iterate:
    """Return the guess as an iterate; a bare trajectory gets s = s_ref and no slack.

    Raises:
        InvalidArgumentError: The guess is neither a trajectory nor an iterate.
        ShapeError: Its horizon or sizes are not those of the problem.
    """
    model, N, M = problem.model, problem.horizon, problem.max_obstacles
    if not isinstance(guess, Trajectory | Iterate):
        raise InvalidArgumentError("guess", f"{guess!r} is neither a Trajectory nor an Iterate")
    for name, array, shape in (
        ("guess.states", guess.states, (N + 1, model.nx)),
        ("guess.inputs", guess.inputs, (N, model.nu)),
    ):
        if array.shape != shape:
            raise ShapeError(name, f"shape {array.shape} is not {shape}")
    if isinstance(guess, Trajectory):
        s = np.full(M, problem.margin.reference)
        return Iterate(guess.states, guess.inputs, s, np.zeros((M, N)))
    for name, array, shape in (
        ("guess.s", guess.s, (M,)),
        ("guess.slack", guess.slack, (M, N)),
    ):
        if array.shape != shape:
            raise ShapeError(name, f"shape {array.shape} is not {shape}")
    return guess
