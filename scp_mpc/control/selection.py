"""Which obstacles a step is planned with where there are more than the problem has room for.

Those with the least predicted clearance along the paths that the robot may take:

    c_j = min over paths and stages i of   |p_i - mu_ji| - s std_ji - r_j

with the largest standard deviation in any direction, as far as it counts for the plan
(`Problem.growth_time`), and the distance to the shape for a polytope.
"""

from collections.abc import Sequence

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.geometry.polytopes import Polytopes
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem


def most_dangerous(
    problem: Problem, obstacles: Sequence[ObstaclePrediction], paths: FloatArray
) -> tuple[ObstaclePrediction, ...]:
    """Return as many as there are slots for, in their order, the nearest to paths (P, N+1, d)."""
    nearest = np.argsort(clearances(problem, obstacles, paths), kind="stable")
    return tuple(obstacles[j] for j in np.sort(nearest[: problem.max_obstacles]))


def clearances(
    problem: Problem, obstacles: Sequence[ObstaclePrediction], paths: FloatArray
) -> FloatArray:
    """Least clearances (J,) of the robot's position along paths (P, N+1, d) [m]; see the file."""
    away = paths[:, None] - np.array([o.means for o in obstacles])  # (P, J, N+1, d)
    gaps = np.linalg.norm(away, axis=-1)
    shapes = Polytopes.of(obstacles)
    if shapes is not None:
        for path, gap in zip(away, gaps, strict=True):
            gap[shapes.slots] = shapes.taken(shapes.slots).distance(path[shapes.slots])
    stds = np.array([o.largest_std for o in obstacles])
    if problem.growth_time is not None:
        last = min(int(np.ceil(problem.growth_time / problem.model.dt - 1e-9)), problem.horizon)
        stds[:, last:] = np.minimum(stds[:, last:], stds[:, last, None])
    reach = problem.size.reference * stds + np.array([[o.radius] for o in obstacles])
    return np.asarray((gaps - reach).min(axis=(0, 2)))
