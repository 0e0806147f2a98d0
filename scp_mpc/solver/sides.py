"""Candidates that pass an obstacle on either side.

One linearisation keeps to one side; a plan that trails behind an obstacle is a local optimum. A
candidate is a path that need not obey the dynamics: where the plan that ignores the obstacles
would enter a no-go set, it is moved to the point of the exact inflation's boundary whose normal is
square to the relative motion. For an obstacle that crosses, these are before it and behind it.
Linearising about the path gives half-spaces on that side, sound as any.

Notation:
    p       (N, d)      positions of the plan that ignores the obstacles
    v       (d,)        motion relative to the obstacle over the conflict
    n       (d,)        side: a unit vector square to v
"""

from dataclasses import dataclass, replace

import numpy as np

from scp_mpc.arrays import FloatArray, IntArray
from scp_mpc.problem import Problem
from scp_mpc.solver.iterate import Iterate
from scp_mpc.solver.step_data import StepData


MAX_CANDIDATES = 4  # in one control step, whatever the number of obstacles


@dataclass(frozen=True, eq=False)
class Side:
    """Where to pass which obstacle.

    Attributes:
        obstacle: Its index.
        normal: (d,) from the obstacle to where the path passes.
        path: (N, d) positions to linearise about.
    """

    obstacle: int
    normal: FloatArray
    path: FloatArray


def candidates(
    step: StepData, path: FloatArray, s: FloatArray, limit: int = MAX_CANDIDATES
) -> list[Side]:
    """Return the sides of the obstacles in conflict, the first conflict first; none without any.

    Args:
        step: The control step.
        path: (N, d) positions of the plan that ignores the obstacles.
        s: (M,) sizes of the ellipsoids.
        limit: How many at most.
    """
    conflict = step.conflicts(path, s)
    first = np.where(conflict.any(axis=1), conflict.argmax(axis=1), conflict.shape[1])
    found: list[Side] = []
    for j in np.argsort(first, kind="stable")[: np.count_nonzero(first < conflict.shape[1])]:
        stages = np.flatnonzero(conflict[j])
        for n in _normals(path - step.means[j, 1:], stages):
            moved = path.copy()
            moved[stages] = _boundary_points(step, float(s[j]), int(j), stages, n)
            found.append(Side(int(j), n, moved))
        if len(found) >= limit:
            break
    return found[:limit]


def along(free: Iterate, problem: Problem, path: FloatArray) -> Iterate:
    """The free plan, moved to a path (N, d)."""
    states = free.states.copy()
    states[1:, problem.model.position] = path
    return replace(free, states=states)


def _normals(relative: FloatArray, stages: IntArray) -> list[FloatArray]:
    begin, end = max(stages[0] - 1, 0), min(stages[-1] + 1, len(relative) - 1)
    v = relative[end] - relative[begin]
    if not v.any():
        v = relative[begin] if relative[begin].any() else np.eye(len(v))[0]
    # The rows of the rotation that takes v onto the first axis: the others are square to it.
    square = np.linalg.svd(v[None])[2][1:]
    return [sign * n for n in square for sign in (1.0, -1.0)]


def _boundary_points(
    step: StepData, s: float, j: int, stages: IntArray, n: FloatArray
) -> FloatArray:
    """Boundary points of ellipsoid (+) ball with outward normal n: mu + s Sigma n / |.| + r n."""
    pull = step.covariances[j, stages + 1] @ n
    half_width = np.sqrt(np.maximum(pull @ n, 0.0))[:, None]
    return step.means[j, stages + 1] + s * pull / np.maximum(half_width, 1e-12) + step.radii[j] * n
