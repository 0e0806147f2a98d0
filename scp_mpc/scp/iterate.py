"""One iterate of the sequential convex programming, in the words of the problem.

Notation:
    X (N+1, nx)     states              s       (M,)    sizes of the ellipsoids
    U (N, nu)       inputs              slack   (M, C)  violation per obstacle and node [m]
    C               collision nodes: K in each of N intervals
    nb              states with a finite bound, `Problem.bounded_states`
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from scp_mpc.arrays import BoolArray, FloatArray, frozen, require_finite
from scp_mpc.errors import InvalidArgumentError, ShapeError
from scp_mpc.models.model import Model
from scp_mpc.problem import Problem
from scp_mpc.trajectory import Trajectory

NEGLIGIBLE = 1e-6  # [cost / m, or per unit of input]; interior points leave none exactly zero


@dataclass(frozen=True, eq=False)
class Multipliers:
    """Multipliers of the constraints: negative at lower, positive at upper bounds.

    Attributes:
        dynamics: (N, nx) of x_{i+1} - A x_i - B u_i = 0.
        inputs: (N, nu) of the input bounds.
        margin: (M,) of the bounds on s.
        obstacles: (M, C) of the obstacles' constraints, never positive.
        slack: (M, C) of slack = 0, or of slack >= 0 where it is free.
        states: (N, nb) of the bounds of states, at most `Problem.state_slack_weight`; empty where
            the problem has none, or where they are unknown.
        rates: (N, nu) of the bounds of u_i - u_{i-1}; empty likewise.
    """

    dynamics: FloatArray
    inputs: FloatArray
    margin: FloatArray
    obstacles: FloatArray
    slack: FloatArray
    states: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    rates: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def shifted(self) -> "Multipliers":
        """Move every stage one step earlier and repeat the last one."""
        return Multipliers(
            _shifted(self.dynamics, 0),
            _shifted(self.inputs, 0),
            self.margin,
            _shifted(self.obstacles, 1, len(self.inputs)),
            _shifted(self.slack, 1, len(self.inputs)),
            _shifted(self.states, 0),
            _shifted(self.rates, 0),
        )


@dataclass(frozen=True, eq=False)
class Iterate:
    """A primal-dual point. Without multipliers only the primal part is warm-started.

    Attributes:
        states: X.
        inputs: U.
        s: Sizes.
        slack: Violations.
        multipliers: Those of all constraints, or None.
        obstacle_free: The plan that ignores the obstacles, where another one was found.
        alternatives: Multipliers (N, nu) of the input bounds and (M, C) of the obstacles, of the
            programs of other ways past them, by obstacle and number; see `multi_start.py`.
    """

    states: FloatArray
    inputs: FloatArray
    s: FloatArray
    slack: FloatArray
    multipliers: Multipliers | None = None
    obstacle_free: "Iterate | None" = None
    alternatives: Mapping[tuple[int, int], tuple[FloatArray, FloatArray]] = field(
        default_factory=dict
    )

    @property
    def touches(self) -> bool:
        """Whether an obstacle may shape this point: an active constraint, or no multipliers."""
        return self.multipliers is None or bool(self.touched.any())

    @property
    def touched(self) -> BoolArray:
        """Which obstacles push this point, at which nodes: (M, C)."""
        duals = self.multipliers
        if duals is None:
            return np.zeros(self.slack.shape, dtype=np.bool_)
        touched: BoolArray = duals.obstacles < -NEGLIGIBLE
        return touched

    def frozen(self) -> "Iterate":
        """Mark the arrays read-only: a plan shares them with the next step's guess."""
        duals = () if self.multipliers is None else vars(self.multipliers).values()
        for array in (self.states, self.inputs, self.s, self.slack, *duals):
            array.setflags(write=False)
        return self

    def unwrapped(self, model: Model, x0: FloatArray) -> "Iterate":
        """Return the iterate with its heading within half a turn of that of a state (nx,) now."""
        if model.heading is None:
            return self
        turns = np.rint((x0[model.heading] - self.states[0, model.heading]) / (2 * np.pi))
        if not turns:
            return self
        states, free = self.states.copy(), self.obstacle_free
        states[:, model.heading] += 2 * np.pi * turns
        free = None if free is None else free.unwrapped(model, x0)
        return replace(self, states=frozen(states), obstacle_free=free)

    def shifted(self, model: Model) -> "Iterate":
        """Return the iterate one step later: the last input is held, its end state appended."""
        last, N = model.step(self.states[-1], self.inputs[-1]), len(self.inputs)
        alternatives = {
            key: (_shifted(bounds, 0), _shifted(obstacles, 1, N))
            for key, (bounds, obstacles) in self.alternatives.items()
        }
        return Iterate(
            np.concatenate([self.states[1:], last[None]]),
            _shifted(self.inputs, 0),
            self.s,
            _shifted(self.slack, 1, N),
            None if self.multipliers is None else self.multipliers.shifted(),
            None if self.obstacle_free is None else self.obstacle_free.shifted(model),
            alternatives,
        )


def _shifted(values: FloatArray, axis: int, stages: int = 0) -> FloatArray:
    """Drop the first stage along `axis` and repeat the last; a stage may have several entries."""
    size = values.shape[axis]
    if not size:
        return values
    count = size // stages if stages else 1
    places = np.arange(size) + count
    places[size - count :] -= count
    return values.take(places, axis=axis)


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
            _check(guess.multipliers, {"states": (N, len(problem.state_rows))})
        if guess.multipliers.rates.size:
            _check(guess.multipliers, {"rates": (N, model.nu)})
    return replace(guess, alternatives={})  # what a caller cannot see does not count


def _check(owner: Iterate | Multipliers, shapes: dict[str, tuple[int, ...]]) -> None:
    for name, shape in shapes.items():
        array = getattr(owner, name)
        if array.shape != shape:
            raise ShapeError(f"guess.{name}", f"shape {array.shape} is not {shape}")
        if not np.isfinite(array.sum()):  # the quick way to know that all is well
            require_finite(f"guess.{name}", array)
