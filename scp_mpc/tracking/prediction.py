"""The horizon of all tracks at once: what the motions predict is linear in what is known now.

Notation:
    w, m, P     as in `imm`, of one track           N       number of intervals
    W_j         w_j                                 M       number of motions
    m~_j        w_j m_j  (nx,)                      e       (d,) position of all motions together
    S_j         w_j (P_j + m_j m_j')  (nx, nx)

Mixing and predicting, without measurements, are

    W_j+  = sum_i Pi_ij W_i,    m~_j+ = F_j sum_i Pi_ij m~_i,
    S_j+  = F_j (sum_i Pi_ij S_i) F_j' + W_j+ Q_j,

which is linear with constant coefficients. So the mean and the second moment of the position at
all stages are two constant matrices times (m~) and (S, W), set up once; the covariance is the
second moment less the square of the mean. Positions are taken relative to e, which changes
nothing, as F moves all positions alike, and keeps that difference from losing digits.
"""

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.tracking.imm import Beliefs, MotionBank


class HorizonPredictor:
    """Predicts positions over N intervals of `dt` seconds.

    Args:
        bank: How obstacles move.
        horizon: N.
        dt: Interval between stages [s].
    """

    def __init__(self, bank: MotionBank, horizon: int, dt: float) -> None:
        """Set up the two matrices."""
        self._dim, self._horizon = bank.dim, horizon
        F, Q, Pi = bank.transition(dt)
        (M, nx), d = F.shape[:2], bank.dim
        split = M * nx * nx
        place = np.eye(nx)[:d]
        whole = np.zeros((split + M, split + M))
        whole[:split, :split] = _blocks(np.array([np.kron(f, f) for f in F]), Pi)
        whole[:split, split:] = np.einsum("ij,jab->jabi", Pi, Q).reshape(split, M)
        whole[split:, split:] = Pi.T
        squares = np.zeros((d * d, split + M))
        squares[:, :split] = np.tile(np.kron(place, place), M)
        self._first = _powers(np.tile(place, M), _blocks(F, Pi), horizon)
        self._second = _powers(squares, whole, horizon)

    def positions(self, beliefs: Beliefs) -> tuple[FloatArray, FloatArray]:
        """Return means (n, N+1, d) and covariances (n, N+1, d, d); row 0 is now."""
        w, (m, P) = beliefs
        (n, M, nx), d, stages = m.shape, self._dim, self._horizon + 1
        e = (w[:, None] @ m)[:, 0, :d]
        m = m.copy()
        m[..., :d] -= e[:, None]
        weighted = w[..., None] * m
        S = w[..., None, None] * P + weighted[..., :, None] * m[..., None, :]
        mean = (weighted.reshape(n, M * nx) @ self._first).reshape(n, stages, d)
        known = np.concatenate([S.reshape(n, M * nx * nx), w], axis=1)
        second = (known @ self._second).reshape(n, stages, d, d)
        Sigma = second - mean[..., :, None] * mean[..., None, :]
        return mean + e[:, None], (Sigma + np.swapaxes(Sigma, -2, -1)) / 2


def _blocks(maps: FloatArray, Pi: FloatArray) -> FloatArray:
    """The matrix of block rows j and columns i, Pi_ij maps_j."""
    M, size = maps.shape[:2]
    return np.einsum("ij,jab->jaib", Pi, maps).reshape(M * size, M * size)


def _powers(rows: FloatArray, matrix: FloatArray, count: int) -> FloatArray:
    """Columns rows', (rows matrix)', (rows matrix^2)', ... for a product from the left."""
    found = [rows]
    for _ in range(count):
        found.append(found[-1] @ matrix)
    return np.ascontiguousarray(np.concatenate(found).T)
