"""The boundary of a no-go set in the plane, as a polygon to be drawn.

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
    if stage == 0:
        sets = NoGoSets.now([prediction], problem.robot_radius)
    else:
        sets = NoGoSets.from_predictions(
            [prediction], problem.robot_radius, 1, prediction.horizon, 2
        )
    at = max(stage - 1, 0)
    return outline(sets, (0, at), s, problem.inflation, prediction.shape)


def outline(
    sets: NoGoSets, at: tuple[int, int], s: float, inflation: str, shape: Solid | None = None
) -> FloatArray:
    """Return a closed polygon (K, 2) [m] around one of the sets, `at` (slot, stage).

    With the exact inflation, the boundary of ellipse (+) disc is sampled by its normals,

        mu + s Sigma n / sqrt(n' Sigma n) + r n;

    with the axes' inflation it is the ellipse with semi-axes s sigma_l + r. Around a polygon it is
    the corner that lies farthest along n, plus (s sigma_max + r) n.
    """
    mean, rotation, sigma, r = (
        part[at] for part in (sets.means, sets.rotations, sets.deviations, sets.radii)
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
