"""Which measurement belongs to which track, where nothing but the place tells.

Notation:
    T, n        number of tracks and of measurements
    d2  (T, n)  squared Mahalanobis distance of measurement and predicted position
    S   (T, n, d, d)    covariance of their difference

A pair is possible where d2 is below the chi-square quantile of the gate. Among all ways to pair
them off, each track and measurement at most once, the nearest is taken: the one with the most
likelihood, the sum of d2 + log det S being least, where leaving a pair out costs as much as one at
the gate with the widest S of these pairs (global nearest neighbour: Blackman and Popoli, 1999).
"""

import numpy as np
from scipy.optimize import linear_sum_assignment

from scp_mpc.arrays import FloatArray, IntArray
from scp_mpc.tracking.kalman import Gaussians, mahalanobis


def associate(
    tracks: Gaussians, measured: FloatArray, noise: FloatArray, gate: float
) -> tuple[IntArray, IntArray]:
    """Return indices of tracks and, in the same order, of the measurements that belong to them.

    Args:
        tracks: T states at the time of the measurements.
        measured: (n, d) [m].
        noise: (n, d, d) covariances of the measurements' errors [m^2].
        gate: Largest squared Mahalanobis distance of a pair.
    """
    m, P = tracks
    d = measured.shape[1]
    e = measured - m[:, None, :d]
    widest = np.trace(P[:, None, :d, :d] + noise, axis1=-2, axis2=-1)
    i, k = np.nonzero(np.square(e).sum(axis=-1) <= gate * widest)  # d2 >= |e|^2 / trace S
    square, logdet = mahalanobis(e[i, k], P[i, :d, :d] + noise[k])
    possible = square <= gate
    if not possible.any():
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    i, k, cost = i[possible], k[possible], (square + logdet)[possible]
    excess = np.zeros(e.shape[:2])
    excess[i, k] = cost - gate - logdet[possible].max()
    near = np.zeros(e.shape[:2], np.bool_)
    near[i, k] = True
    old, new = linear_sum_assignment(excess)
    return old[near[old, new]], new[near[old, new]]
