"""The constraint of obstacles that are polytopes, whatever the inflation of the others.

    g(p, s) = sd(p - mu) - s sigma - r,     sigma^2 the largest eigenvalue of Sigma

is the distance to polytope (+) ball(s sigma + r): jointly convex in (p, s), so that

    n'(p - mu) - h(n) - s sigma >= r

lies inside the true feasible set for every unit n. The obstacle touches only if n'(p - o) - h(n)
<= r, and n'o has a standard deviation of sigma at most: so s = Phi^-1(1 - delta) bounds the
probability of a collision by delta here, too.

Notation as in `polytopes.py`, `no_go.py` and `inflation.py`; all slots are polytopes.
"""

from collections.abc import Callable

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.safety.halfspaces import HalfSpaces
from scp_mpc.safety.no_go import NoGoSets
from scp_mpc.safety.polytopes import Polytopes


def linearise(
    sets: NoGoSets, positions: FloatArray, s: FloatArray, side: Callable[[], FloatArray]
) -> HalfSpaces:
    """Linearise g about positions (M, N, d) and s (M,); see `Inflation.linearise`."""
    y = positions - sets.means
    near = _shapes(sets).nearest(y, side)
    sigma = largest(sets)
    value = near.distance - s[:, None] * sigma - sets.radii
    offset = np.add.reduce(near.normal * positions, axis=-1) - near.distance + sets.radii
    return HalfSpaces(near.normal, -sigma, offset, value, near.bend)


def clearance(sets: NoGoSets, positions: FloatArray, s: float) -> FloatArray:
    """G (M, N) at positions (M, N, d) and one size for all."""
    distance = _shapes(sets).distance(positions - sets.means)
    return distance - s * largest(sets) - sets.radii


def largest(sets: NoGoSets) -> FloatArray:
    """Largest standard deviations sigma (M, N) [m]."""
    sigma: FloatArray = sets.deviations.max(axis=-1)
    return sigma


def _shapes(sets: NoGoSets) -> Polytopes:
    assert sets.shapes is not None
    return sets.shapes
