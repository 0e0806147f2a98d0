"""Risk and size: what a half-space at s standard deviations promises, and the other way round.

Notation:
    n       unit normal             s       size of the ellipsoid [standard deviations]
    mu      mean of the obstacle    delta   risk: a probability
    r       sum of the radii [m]

For o ~ N(mu, Sigma) the half-space n'(p - mu) >= r + s sqrt(n' Sigma n) means

    P(|p - o| <= r)  <=  P(n'(p - o) <= r)  =  Phi(-s)

so that s = Phi^-1(1 - delta) bounds the probability of a collision by delta (Blackmore, Ono and
Williams, 2011). Several events together are at most as likely as the sum of all (Boole).
"""

import numpy as np
from scipy.special import gammaincinv, ndtr, ndtri

from scp_mpc.arrays import FloatArray
from scp_mpc.geometry.ellipsoid import signed_distance
from scp_mpc.geometry.inflation import largest, wall_clearance
from scp_mpc.geometry.no_go import NoGoSets

LEAST_RISK = 1e-12  # smaller risks are not told apart: s stays below 7.04
_NEWTON = 20  # steps at most; each is a sound bound
_CLOSE = 1e-9  # change of a size that ends them
_TOUCH = 1e-6  # [m] the settings' tolerance: a certified plan may be so deep in what is certain


def size_at_risk(risk: float | FloatArray) -> FloatArray:
    """Size s = Phi^-1(1 - risk) of a half-space that is missed with this probability."""
    sizes: FloatArray = -ndtri(np.maximum(risk, LEAST_RISK))
    return sizes


def containment_size(level: float, dim: int) -> float:
    """Size of the ellipsoid that contains this share of a Gaussian: root of a chi-square quantile.

    Args:
        level: Probability that the obstacle's centre is within.
        dim: Degrees of freedom, the dimension of the workspace.
    """
    return float(np.sqrt(2 * gammaincinv(dim / 2, level)))


def risk_bound(sets: NoGoSets, positions: FloatArray) -> FloatArray:
    """Smallest half-space bound (M, N) of the probability of a collision at positions (N, d).

    The best half-space is tangent to the largest ellipsoid (+) ball that leaves p outside: its
    size solves sd(p, s) = r, by Newton's method from s = 0. sd is convex and falls with s, so
    that each step ends short of the root, and its half-space is a bound by itself. Of a polytope it
    is the half-space at its nearest point, Phi(-(sd - r) / sigma) with the largest sigma, as the
    plan was promised.
    """
    if sets.shapes is None:
        return _ellipsoids_risk(sets, positions)
    positions = np.broadcast_to(positions, sets.means.shape)
    risk = np.zeros(sets.means.shape[:2])
    j = sets.shapes.others
    if len(j):
        risk[j] = _ellipsoids_risk(sets.taken(j), positions[j])
    j = sets.shapes.slots
    if len(j):
        walls = sets.taken(j)
        room, sigma = wall_clearance(walls, positions[j], 0.0), largest(walls)
        risk[j] = ndtr(-_over(room, sigma))
    return risk


def _over(room: FloatArray, width: FloatArray) -> FloatArray:
    """Standard deviations that fit into the room: all or none where there is no deviation."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        return np.where(width > 0, room / width, np.where(room >= -_TOUCH, np.inf, -np.inf))


def _ellipsoids_risk(sets: NoGoSets, positions: FloatArray) -> FloatArray:
    y = sets.to_eigenframe(positions - sets.means)
    s = np.zeros(y.shape[:-1])
    bound = np.full(s.shape, -np.inf)
    for _ in range(_NEWTON):
        _, n = signed_distance(y, s[..., None] * sets.deviations)
        room = np.add.reduce(n * y, axis=-1) - sets.radii
        across = sets.deviations * n
        width = np.sqrt(np.add.reduce(across * across, axis=-1))
        reached = _over(room, width)
        better = reached > bound + _CLOSE
        bound = np.maximum(bound, reached)
        if not better.any():
            break
        s = np.clip(bound, 0.0, 1e3)
    risk: FloatArray = np.where(sets.active[:, None], ndtr(-bound), 0.0)
    return risk
