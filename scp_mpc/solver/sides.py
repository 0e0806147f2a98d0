"""Candidates that pass an obstacle on either side.

One linearisation keeps to one side; a plan that trails behind an obstacle is a local optimum. A
candidate is a path that need not obey the dynamics: where the plan that ignores the obstacles
would enter a no-go set, it is moved to the point of the exact inflation's boundary whose normal is
square to the relative motion. Linearising about it gives half-spaces on that side, sound as any.

Notation:
    p       (N, d)      positions of the plan that ignores the obstacles
    v       (d,)        motion relative to the obstacle over the conflict
    n       (d,)        side: a unit vector square to v
"""

from dataclasses import replace

import numpy as np

from scp_mpc.arrays import FloatArray, IntArray
from scp_mpc.safety.no_go import NoGoSets
from scp_mpc.solver.iterate import Iterate


def candidates(
    free: Iterate, position: IntArray, sets: NoGoSets, value: FloatArray
) -> list[Iterate]:
    """Return starts that pass the first conflicting obstacle on its sides; none if none conflicts.

    Args:
        free: The plan that ignores the obstacles.
        position: (d,) indices of the position within the state.
        sets: The obstacles' ellipsoids.
        value: (M, N) constraint function along `free`; negative means conflict.
    """
    conflict = value < 0
    if not conflict.any():
        return []
    first = np.where(conflict.any(axis=1), conflict.argmax(axis=1), conflict.shape[1])
    j = int(first.argmin())
    stages = np.flatnonzero(conflict[j])
    return [
        _moved(free, position, stages, _boundary_points(sets, free.s, j, stages, n))
        for n in _sides(free.states[1:, position], sets.means[j], stages)
    ]


def _sides(positions: FloatArray, means: FloatArray, stages: IntArray) -> list[FloatArray]:
    relative = positions - means
    begin, end = max(stages[0] - 1, 0), min(stages[-1] + 1, len(means) - 1)
    v = relative[end] - relative[begin]
    if not v.any():
        v = relative[begin] if relative[begin].any() else np.eye(len(v))[0]
    # The rows of the rotation that takes v onto the first axis: the others are square to it.
    square = np.linalg.svd(v[None])[2][1:]
    return [sign * n for n in square for sign in (1.0, -1.0)]


def _boundary_points(
    sets: NoGoSets, s: FloatArray, j: int, stages: IntArray, n: FloatArray
) -> FloatArray:
    """Boundary points of ellipsoid (+) ball with outward normal n: mu + s Sigma n / |.| + r n."""
    rotation, deviation = sets.rotations[j, stages], sets.deviations[j, stages]
    local = np.einsum("kji,j->ki", rotation, n)
    half_width = np.sqrt(np.square(deviation * local).sum(axis=-1, keepdims=True))
    reach = deviation**2 * local / np.maximum(half_width, 1e-12)
    ellipsoid = np.einsum("kij,kj->ki", rotation, s[j] * reach)
    return sets.means[j, stages] + ellipsoid + sets.radii[j] * n


def _moved(free: Iterate, position: IntArray, stages: IntArray, points: FloatArray) -> Iterate:
    states = free.states.copy()
    states[np.ix_(stages + 1, position)] = points
    return replace(free, states=states)
