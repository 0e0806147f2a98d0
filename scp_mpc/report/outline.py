"""No-go sets and half-planes in the plane, as polygons to be drawn.

Notation, in the frame of the ellipse's axes:
    sigma   (2,)    standard deviations [m]
    n       (K, 2)  unit normals, all around
    r               robot radius + obstacle radius [m]
"""

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.geometry.no_go import NoGoSets
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.obstacles.solid import Solid
from scp_mpc.problem import Problem

_POINTS = 361


def no_go_outline(
    problem: Problem, prediction: ObstaclePrediction, stage: int, s: float
) -> FloatArray:
    """Return a closed polygon (K, 2) [m] around the no-go set of a stage, 0 being now.

    Raises:
        ValueError: The prediction is not planar.
    """
    if prediction.dim != 2:
        raise ValueError(f"a prediction in {prediction.dim} dimensions has no outline in the plane")
    means, Sigma = prediction.means[[stage]], prediction.covariances[[stage]]
    sets = NoGoSets.pairs(means, Sigma, np.array([prediction.radius + problem.robot_radius]))
    return outline(sets, 0, s, problem.inflation, prediction.shape)


def outline(
    sets: NoGoSets, slot: int, s: float, inflation: str, shape: Solid | None = None
) -> FloatArray:
    """Return a closed polygon (K, 2) [m] around the set in a slot, at its first stage.

    With the exact inflation, the boundary of ellipse (+) disc is sampled by its normals,

        mu + s Sigma n / sqrt(n' Sigma n) + r n;

    with the axes' inflation it is the ellipse with semi-axes s sigma_l + r. Around a polygon it is
    the corner that lies farthest along n, plus (s sigma_max + r) n.
    """
    mean, rotation, sigma, r = (
        part[slot, 0] for part in (sets.means, sets.rotations, sets.deviations, sets.radii)
    )
    angle = np.linspace(0.0, 2 * np.pi, _POINTS)
    n = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    if shape is not None:
        corners = shape.vertices
        return mean + corners[(n @ corners.T).argmax(axis=1)] + (s * sigma.max() + r) * n
    if inflation == "axes":
        return mean + ((s * sigma + r) * n) @ rotation.T
    support = np.maximum(np.linalg.norm(sigma * n, axis=-1, keepdims=True), 1e-300)
    return mean + (s * sigma**2 * n / support + r * n) @ rotation.T


def half_plane_strips(
    points: FloatArray, normals: FloatArray, values: FloatArray, half_length: float, depth: float
) -> FloatArray:
    """Return the strips (n, 4, 2) [m] along the edges of the half-planes n'(x - p) + v >= 0.

    Two corners on the edge, about the foot of the point, then two on the forbidden side.

    Args:
        points: p, (n, 2) [m].
        normals: n, (n, 2).
        values: v, (n,).
        half_length: Of each edge [m].
        depth: Of each strip [m].
    """
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    n = normals / length
    feet = points - values[:, None] / length * n
    along = half_length * np.stack([-n[:, 1], n[:, 0]], axis=1)
    edges = np.stack([feet - along, feet + along], axis=1)
    return np.concatenate([edges, edges[:, ::-1] - depth * n[:, None]], axis=1)
