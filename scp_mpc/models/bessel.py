"""Spherical Bessel functions j_n: what integrals along an arc of constant turn rate come to.

Notation:
    mu      half the angle turned, any sign
    j_n     (1/2) integral over [-1, 1] of exp(i mu t) P_n(t) dt = i^n j_n(mu)
    k_n     j_n / mu^n, even in mu and entire: its power series has no 0/0

Source: NIST Digital Library of Mathematical Functions, 10.51 and 10.53.
"""

from math import cos, factorial, prod, sin

import numpy as np

from scp_mpc.arrays import FloatArray

_NARROW = 0.5
# coefficients of k_0 .. k_3 in powers of mu^2: eight reach rounding errors up to _NARROW
_SERIES = np.array(
    [
        [(-0.5) ** k / (factorial(k) * prod(range(1, 2 * n + 2 * k + 2, 2))) for k in range(8)]
        for n in range(4)
    ]
)


def bessel(mu: FloatArray) -> FloatArray:
    """Return j_0, j_1, j_2 and j_3 (4, ...) of mu (...), to rounding errors."""
    shape, mu = np.shape(mu), np.reshape(mu, -1)
    square = mu * mu
    wide = square.max(initial=0.0) > _NARROW
    powers = np.empty((8, len(mu)))
    powers[0] = 1.0
    powers[1] = np.minimum(square, _NARROW) if wide else square
    np.multiply(powers[:2], powers[1] * powers[1], out=powers[2:4])
    np.multiply(powers[:4], powers[2] * powers[2], out=powers[4:])
    j: FloatArray = _SERIES @ powers
    j[1::2] *= mu
    j[2:] *= square
    if wide:
        # the recurrence j_(n+1) = (2n+1)/mu j_n - j_(n-1) is stable where mu is not small
        far = square > _NARROW
        x = mu[far]
        j[0, far] = np.sin(x) / x
        j[1, far] = (j[0, far] - np.cos(x)) / x
        for n in (1, 2):
            j[n + 1, far] = (2 * n + 1) / x * j[n, far] - j[n - 1, far]
    return j.reshape(4, *shape)


def bessel_pair(mu: float) -> tuple[float, float]:
    """Return j_0 and j_1 of one number, quickly."""
    if abs(mu) > 0.1:
        j0 = sin(mu) / mu
        return j0, (j0 - cos(mu)) / mu
    square = mu * mu
    j0 = 1 - square / 6 * (1 - square / 20 * (1 - square / 42 * (1 - square / 72)))
    j1 = mu / 3 * (1 - square / 10 * (1 - square / 28 * (1 - square / 54)))
    return j0, j1
