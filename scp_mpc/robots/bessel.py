"""Spherical Bessel functions j_n: what integrals along an arc of constant turn rate come to.

Notation:
    mu      half the angle turned, any sign
    j_n     (1/2) integral over [-1, 1] of exp(i mu t) P_n(t) dt = i^n j_n(mu)
    k_n     j_n / mu^n, even in mu and entire: Horner's scheme in mu^2 has no 0/0

Source: NIST Digital Library of Mathematical Functions, 10.51 and 10.53.
"""

from math import cos, factorial, prod, sin

import numpy as np

from scp_mpc.arrays import FloatArray

_NARROW = 0.5
# the coefficients of k_2 and k_3; eight reach rounding errors where mu^2 <= _NARROW
_LAST, *_SERIES = (
    np.array(
        [[(-0.5) ** k / (factorial(k) * prod(range(1, 2 * n + 2 * k + 2, 2)))] for n in (2, 3)]
    )
    for k in range(7, -1, -1)
)


def bessel(mu: FloatArray) -> FloatArray:
    """Return j_0, j_1, j_2 and j_3 (4, ...) of mu (...), to rounding errors."""
    shape, mu = np.shape(mu), np.reshape(mu, -1)
    square = mu * mu
    wide = square.max(initial=0.0) > _NARROW
    m = np.minimum(square, _NARROW) if wide else square
    k = m * _LAST
    for coefficient in _SERIES[:-1]:
        k += coefficient
        k *= m
    k += _SERIES[-1]
    k2, k3 = k
    # downwards the recurrence j_(n-1) = (2n+1)/mu j_n - j_(n+1) is stable
    j0, j1, j2, j3 = j = np.empty((4, len(mu)))
    k1 = 5.0 * k2 - square * k3
    np.multiply(mu, k1, out=j1)
    np.multiply(square, k2, out=j2)
    np.multiply(square * mu, k3, out=j3)
    np.subtract(3.0 * k1, j2, out=j0)
    if wide:
        # and upwards where mu is not small
        far = square > _NARROW
        x = mu[far]
        j0[far] = np.sin(x) / x
        j1[far] = (j0[far] - np.cos(x)) / x
        j2[far] = 3 * j1[far] / x - j0[far]
        j3[far] = 5 * j2[far] / x - j1[far]
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
