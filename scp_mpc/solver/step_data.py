"""What one control step brings, checked before the solver is touched."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import BoolArray, FloatArray, as_array
from scp_mpc.errors import InvalidArgumentError, ShapeError, TooManyObstaclesError
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.safety.halfspaces import HalfSpaces
from scp_mpc.safety.no_go import NoGoSets


@dataclass(frozen=True, eq=False)
class StepData:
    """The validated state, reference and obstacles of one control step; J obstacles, M slots.

    Attributes:
        problem: The problem to which they belong.
        x0: (nx,) state now.
        x_ref: (N+1, nx) reference, row 0 not weighted.
        obstacles: The J predictions.
        means: (J, N+1, d) expected positions [m].
        radii: (J,) robot radius + obstacle radius [m].
    """

    problem: Problem
    x0: FloatArray
    x_ref: FloatArray
    obstacles: tuple[ObstaclePrediction, ...]
    means: FloatArray
    radii: FloatArray

    @classmethod
    def read(
        cls,
        problem: Problem,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
    ) -> "StepData":
        """Check everything and stack the predictions.

        Raises:
            InvalidArgumentError: Or one of its subclasses, with the argument and the number.
        """
        model, N, M = problem.model, problem.horizon, problem.max_obstacles
        state = as_array("x0", x0, (model.nx,))
        reference = as_array("x_ref", x_ref, (N + 1, model.nx), (model.nx,))
        if reference.ndim == 1:
            reference = np.tile(reference, (N + 1, 1))
        if isinstance(obstacles, ObstaclePrediction) or not isinstance(obstacles, Iterable):
            raise InvalidArgumentError("obstacles", f"{obstacles!r} is not a list of predictions")
        obstacles = tuple(obstacles)
        if len(obstacles) > M:
            raise TooManyObstaclesError("obstacles", f"{len(obstacles)} exceed max_obstacles = {M}")
        for j, obstacle in enumerate(obstacles):
            if not isinstance(obstacle, ObstaclePrediction):
                raise InvalidArgumentError(
                    f"obstacles[{j}]", f"{obstacle!r} is not an ObstaclePrediction"
                )
            if obstacle.means.shape != (N + 1, model.dim):
                raise ShapeError(
                    f"obstacles[{j}].means",
                    f"shape {obstacle.means.shape} is not {(N + 1, model.dim)}",
                )
        means = np.array([o.means for o in obstacles]).reshape(-1, N + 1, model.dim)
        radii = problem.robot_radius + np.array([o.radius for o in obstacles])
        return cls(problem, state, reference, obstacles, means, radii)

    @property
    def count(self) -> int:
        """Number of obstacles J."""
        return len(self.obstacles)

    @cached_property
    def covariances(self) -> FloatArray:
        """(J, N+1, d, d) position covariances [m^2]."""
        return np.array([o.covariances for o in self.obstacles])

    @cached_property
    def spreads(self) -> FloatArray:
        """(J, N+1) largest standard deviations [m]."""
        return np.array([o.spread for o in self.obstacles])

    @cached_property
    def sets(self) -> NoGoSets:
        """The obstacles' ellipsoids at stages 1 .. N, in all M slots."""
        problem = self.problem
        return NoGoSets.from_predictions(
            self.obstacles,
            problem.robot_radius,
            problem.max_obstacles,
            problem.horizon,
            problem.model.dim,
        )

    @cached_property
    def start(self) -> FloatArray:
        """(M, d) offsets p_0 - mu_0 now [m]; ones in empty slots."""
        start = np.ones((self.problem.max_obstacles, self.problem.model.dim))
        start[: self.count] = self.x0[self.problem.model.position] - self.means[:, 0]
        return start

    def path(self, deviations: FloatArray) -> FloatArray:
        """Positions (N+1, d) [m] from now on, given their deviations (N d,) from the reference."""
        position = self.problem.model.position
        path = self.x_ref[:, position]
        path[0] = self.x0[position]
        path[1:] += deviations.reshape(-1, len(position))
        return path

    def half_spaces(self, states: FloatArray, s: FloatArray) -> HalfSpaces:
        """Linearise the obstacles' constraints about states (N+1, nx) and sizes s (M,)."""
        positions = states[1:, self.problem.model.position]
        return self.problem.no_go.linearise(self.sets, positions, s, self.start)

    def within(
        self,
        positions: FloatArray,
        s: FloatArray,
        distance: float,
        known: BoolArray | None = None,
    ) -> BoolArray | None:
        """Which obstacles may be nearer than a distance, (J, N) for stages 1 .. N; None for none.

        The direction n from the mean to p gives a lower bound of the signed distance to the
        s-sigma ellipsoid, n'(p - mu) - s sqrt(n' Sigma n), and n' Sigma n is at most the largest
        variance. Who is clear by these bounds is clear of either inflation's no-go set.

        Args:
            positions: (N+1, d) of the robot [m].
            s: (M,) sizes of the ellipsoids.
            distance: Beyond the radii [m].
            known: (J, N) pairs that need no answer.
        """
        if not self.obstacles:
            return None
        y = positions[1:] - self.means[:, 1:]
        length2 = np.add.reduce(y * y, axis=2)
        reach = (self.radii + distance)[:, None]
        size = s[: self.count, None]
        least = size * self.spreads[:, 1:] + reach
        unclear = length2 <= least * least
        if known is not None:
            unclear &= ~known
        if not unclear.any():
            return None
        y = y[unclear]
        width2 = np.add.reduce(
            (self.covariances[:, 1:][unclear] @ y[..., None])[..., 0] * y, axis=1
        )
        size, reach = (np.broadcast_to(v, unclear.shape)[unclear] for v in (size, reach))
        length2 = length2[unclear]
        close = length2 - size * np.sqrt(np.maximum(width2, 0.0)) <= reach * np.sqrt(length2)
        if not close.any():
            return None
        unclear[unclear] = close
        return unclear

    def conflicts(self, path: FloatArray, s: FloatArray) -> BoolArray:
        """Which no-go sets a path (N, d) enters at sizes s (M,): (J, N)."""
        now = self.x0[self.problem.model.position]
        inside = np.zeros((self.count, self.problem.horizon), dtype=np.bool_)
        near = self.within(np.concatenate([now[None], path]), s, 0.0)
        if near is not None:
            j, i = np.nonzero(near)
            sets = NoGoSets.pairs(self.means[j, i + 1], self.covariances[j, i + 1], self.radii[j])
            before = path[i - 1] - self.means[j, i]
            g = self.problem.no_go.linearise(sets, path[i][:, None], s[j], before).value
            inside[j, i] = g[:, 0] < 0
        return inside
