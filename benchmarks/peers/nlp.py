"""The order of the unknowns in the full-space nonlinear program that the peers solve.

Notation:
    z = [x_1 .. x_N, u_0 .. u_{N-1}, s_1 .. s_M]

    minimise   cost(z)
    subject to x_{i+1} - A x_i - B u_i = 0,  g_{j,i}(z) >= 0,  lower <= z <= upper

For the report's "axes" g is the left side of (14) less 1, its square form as printed:
|R'(p - mu) / (s sigma + r)|^2 - 1. For "exact" it is the signed distance of `scp_mpc.geometry`,
which each peer writes in the way that suits it.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.geometry.no_go import NoGoSets
from scp_mpc.models.linear import LinearModel, as_linear
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.scp.iterate import Iterate
from scp_mpc.scp.step import Step


def linear_model(problem: Problem) -> LinearModel:
    """The problem's model, which peers need to be linear.

    Raises:
        InvalidArgumentError: It is not.
    """
    return as_linear("problem.model", problem.model)


class Unknowns:
    """Packs and unpacks z.

    Args:
        problem: Whose unknowns.

    Attributes:
        size: Length of z.
        lower: (size,) lower bounds, minus infinity for states.
        upper: (size,) upper bounds, infinity for states.

    Raises:
        InvalidArgumentError: The problem has what `refuse_limits` refuses.
    """

    def __init__(self, problem: Problem) -> None:
        """Lay out z and its bounds."""
        refuse_limits(problem)
        N, nx, nu = problem.horizon, problem.model.nx, problem.model.nu
        self._shapes = (N, nx), (N, nu)
        self.ends = N * nx, N * (nx + nu)
        free, sizes = np.full(N * nx, np.inf), np.ones(problem.max_obstacles)
        margin = problem.size
        self.lower = np.concatenate([-free, np.tile(problem.u_min, N), margin.lower * sizes])
        self.upper = np.concatenate([free, np.tile(problem.u_max, N), margin.upper * sizes])
        self.size = len(self.lower)

    def pack(self, guess: Iterate) -> FloatArray:
        """Return z of a guess, moved into the bounds."""
        z = np.concatenate([guess.states[1:].ravel(), guess.inputs.ravel(), guess.s])
        return np.clip(z, self.lower, self.upper)

    def unpack(self, z: FloatArray, x0: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return states (N+1, nx) with row 0 = x0, inputs (N, nu) and sizes (M,)."""
        later, inputs, s = np.split(z, self.ends)
        states = np.concatenate([x0[None], later.reshape(self._shapes[0])])
        return states, inputs.reshape(self._shapes[1]), s


def read(
    problem: Problem,
    x0: ArrayLike,
    x_ref: ArrayLike,
    obstacles: Sequence[ObstaclePrediction],
) -> tuple[Step, NoGoSets]:
    """Check a control step, and stack its ellipsoids at all stages in all slots.

    Raises:
        InvalidArgumentError: Or one of its subclasses; also where an obstacle is a polytope.
    """
    step = Step.read(problem, x0, x_ref, obstacles)
    require_round(step.obstacles)
    covariances = step.covariances[:, 1:] if step.count else np.zeros(0)
    slots = problem.max_obstacles
    return step, NoGoSets.stacked(step.means[:, 1:], covariances, step.radii, slots)


def require_round(obstacles: Sequence[ObstaclePrediction]) -> None:
    """Refuse obstacles that are polytopes: the peers' programs know ellipsoids only.

    Raises:
        InvalidArgumentError: With the first one that has a shape.
    """
    for j, obstacle in enumerate(obstacles):
        if obstacle.shape is not None:
            raise InvalidArgumentError(
                f"obstacles[{j}].shape", f"{obstacle.shape!r}, but peers know ellipsoids only"
            )


def refuse_limits(problem: Problem) -> None:
    """Refuse bounds of states and rates and nodes between samples: the peers' programs have none.

    Raises:
        InvalidArgumentError: There are some.
    """
    if problem.nodes_per_interval > 1:
        raise InvalidArgumentError(
            "problem.nodes_per_interval",
            f"{problem.nodes_per_interval}, but peers constrain the samples only",
        )
    if problem.speed_max is not None:
        raise InvalidArgumentError(
            "problem.speed_max", f"{problem.speed_max}, but peers do not bound the speed"
        )
    if problem.limits_states:
        at = int(problem.bounded_states[0])
        name = "x_max" if np.isfinite(problem.x_max[at]) else "x_min"
        bound = getattr(problem, name)[at]
        raise InvalidArgumentError(
            f"problem.{name}", f"{bound} for state {at}, but peers do not bound states"
        )
    if problem.limits_rates:
        name = "du_max" if np.isfinite(problem.du_max).any() else "du_min"
        raise InvalidArgumentError(
            f"problem.{name}", f"{getattr(problem, name)}, but peers do not bound rates"
        )
