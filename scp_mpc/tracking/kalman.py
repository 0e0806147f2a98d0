"""The Kalman filter on stacks: any number of tracks and motions at once.

Notation:
    m       (..., nx)       mean of x = [p, v]          z   (..., d)        measured position
    P       (..., nx, nx)   covariance of x             R   (..., d, d)     its error's covariance
    S       (..., d, d)     covariance of the innovation z - p
    K       (..., nx, d)    gain

    predict     m <- F m,   P <- F P F' + Q
    correct     K = P H' S^-1,  m <- m + K (z - H m),  P <- (I - K H) P (I - K H)' + K R K'

with H = [I, 0]. The last is Joseph's form: symmetric and positive semi-definite by construction.
"""

from typing import NamedTuple

import numpy as np

from scp_mpc.arrays import FloatArray


class Gaussians(NamedTuple):
    """A stack of states [p, v]: means (..., nx) and covariances (..., nx, nx)."""

    means: FloatArray
    covariances: FloatArray


def predicted(states: Gaussians, F: FloatArray, Q: FloatArray) -> Gaussians:
    """Return the states one transition later; F and Q (..., nx, nx) broadcast."""
    means = (F @ states.means[..., None])[..., 0]
    return Gaussians(means, F @ states.covariances @ np.swapaxes(F, -2, -1) + Q)


def corrected(
    states: Gaussians, measured: FloatArray, noise: FloatArray
) -> tuple[Gaussians, FloatArray]:
    """Return the states given measured positions, and the logarithm (...) of their likelihood.

    Args:
        states: Before the measurement.
        measured: (..., d) [m].
        noise: (..., d, d) covariance of the measurement's error, positive definite [m^2].
    """
    m, P = states
    d = measured.shape[-1]
    innovation = measured - m[..., :d]
    S = P[..., :d, :d] + noise
    square, logdet = mahalanobis(innovation, S)
    # K = P H' S^-1, from S K' = H P
    Kt = np.linalg.solve(S, P[..., :d, :])
    K = np.swapaxes(Kt, -2, -1)
    A = np.broadcast_to(np.eye(m.shape[-1]), P.shape).copy()
    A[..., :d] -= K
    P = A @ P @ np.swapaxes(A, -2, -1) + K @ noise @ Kt
    m = m + (K @ innovation[..., None])[..., 0]
    return Gaussians(m, P), -0.5 * (square + logdet + d * np.log(2 * np.pi))


def mahalanobis(error: FloatArray, covariances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return e' S^-1 e and log det S, each (...), of errors (..., d) and covariances (..., d, d).

    By Cholesky's S = L L': e' S^-1 e = |L^-1 e|^2.
    """
    L = np.linalg.cholesky(covariances)
    y = np.linalg.solve(L, error[..., None])[..., 0]
    logdet = 2 * np.log(np.diagonal(L, axis1=-2, axis2=-1)).sum(axis=-1)
    return np.square(y).sum(axis=-1), logdet
