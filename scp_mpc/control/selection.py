"""Which obstacles a step is planned with where there are more than the problem has room for.

Those with the least expected clearance along the paths that the robot may take:

    c_j = min over paths and stages i of   |p_i - mu_ji| - r_j

with the distance to the shape for a polytope. Uncertainty does not count: by it, whoever is vague
far ahead would come before whoever is near, and more people are touched.
"""

from collections.abc import Sequence

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.geometry.polytopes import Polytopes
from scp_mpc.obstacles.prediction import ObstaclePrediction


def most_dangerous(
    obstacles: Sequence[ObstaclePrediction], paths: FloatArray, slots: int
) -> tuple[ObstaclePrediction, ...]:
    """Return as many as there are slots for, in their order, the nearest to paths (P, N+1, d)."""
    nearest = np.argsort(clearances(obstacles, paths), kind="stable")
    return tuple(obstacles[j] for j in np.sort(nearest[:slots]))


def clearances(obstacles: Sequence[ObstaclePrediction], paths: FloatArray) -> FloatArray:
    """Least clearances (J,) of the robot's position along paths (P, N+1, d) [m]; see the file."""
    away = paths[:, None] - np.array([o.means for o in obstacles])  # (P, J, N+1, d)
    gaps = np.linalg.norm(away, axis=-1)
    shapes = Polytopes.of(obstacles)
    if shapes is not None:
        for path, gap in zip(away, gaps, strict=True):
            gap[shapes.slots] = shapes.taken(shapes.slots).distance(path[shapes.slots])
    return np.asarray((gaps - np.array([[o.radius] for o in obstacles])).min(axis=(0, 2)))
