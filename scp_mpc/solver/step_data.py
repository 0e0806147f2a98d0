"""What one control step brings, checked before the solver is touched."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray, as_array
from scp_mpc.errors import InvalidArgumentError, ShapeError, TooManyObstaclesError
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.safety.halfspaces import HalfSpaces
from scp_mpc.safety.no_go import NoGoSets


@dataclass(frozen=True, eq=False)
class StepData:
    """The validated state, reference and obstacles of one control step.

    Attributes:
        x0: (nx,) state now.
        x_ref: (N+1, nx) reference, row 0 not weighted.
        sets: The obstacles' ellipsoids at stages 1 .. N.
        start: (M, d) offsets p_0 - mu_0 now [m].
        count: Number of obstacles.
    """

    x0: FloatArray
    x_ref: FloatArray
    sets: NoGoSets
    start: FloatArray
    count: int

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
        reference = np.ascontiguousarray(np.broadcast_to(reference, (N + 1, model.nx)))
        if isinstance(obstacles, ObstaclePrediction) or not isinstance(obstacles, Iterable):
            raise InvalidArgumentError("obstacles", f"{obstacles!r} is not a list of predictions")
        obstacles = list(obstacles)
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
        sets = NoGoSets.from_predictions(obstacles, problem.robot_radius, M, N, model.dim)
        start = np.ones((M, model.dim))
        if obstacles:
            now = np.stack([o.means[0] for o in obstacles])
            start[: len(obstacles)] = state[model.position] - now
        return cls(state, reference, sets, start, len(obstacles))

    def half_spaces(self, problem: Problem, states: FloatArray, s: FloatArray) -> HalfSpaces:
        """Linearise the obstacles' constraints about states (N+1, nx) and sizes s (M,)."""
        positions = states[1:, problem.model.position]
        return problem.no_go.linearise(self.sets, positions, s, self.start)
