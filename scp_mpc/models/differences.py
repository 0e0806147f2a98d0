"""Derivatives by differences, and whether given ones agree with them.

Steps are powers of two, so that z + h and z - h are that far apart exactly. They grow with the
root of |z|, whose scale is not known: a coordinate far from its origin need not change on that
scale. And with the function's own size F where it is added to what changes, since it is rounded to
eps F: for first derivatives with its cubic, for second ones with its fourth root.

Notation:
    z (..., n)      state and input together        h (..., n)      steps
    eps             2^-52
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from scp_mpc.arrays import FloatArray

_EPS = float(np.finfo(np.float64).eps)
_DOUBT = 10.0  # times the spread of three differences, within which a derivative may be right
_WILD = 1e3  # times the usual largest derivative: no place to judge
_SWEEP = 4.0 ** np.arange(-4, 7)  # of steps
_ROUNDINGS = 2.0  # of a value, in units of eps, likewise


def steps(z: FloatArray, order: int, size: Any = 1.0) -> FloatArray:
    """Return h (..., n) for derivatives of order 1 or 2 of a function of values of a size."""
    root = 1 / (order + 2)
    scale = np.maximum(np.sqrt(np.abs(z)), np.maximum(1.0, size) ** root)
    h: FloatArray = np.exp2(np.round(np.log2(_EPS**root * np.maximum(1.0, scale))))
    return h


def differences(function: Any, z: FloatArray, size: Any = 1.0, factor: float = 1.0) -> FloatArray:
    """Central differences (..., m, n) of a batched function (..., m) of z (..., n).

    Args:
        function: Takes any leading axes.
        z: Where.
        size: Of the values, (..., 1) or a number.
        factor: Of the steps, a power of two.
    """
    n, h = z.shape[-1], factor * steps(z, 1, size)
    aside = np.moveaxis(h[..., None] * np.eye(n), -2, 0)
    values = function(np.stack([z + aside, z - aside]))
    slopes = (values[0] - values[1]) / (2 * np.moveaxis(h, -1, 0)[..., None])
    return np.moveaxis(slopes, 0, -1)


def second_differences(function: Any, z: FloatArray, size: Any = 1.0) -> FloatArray:
    """Second differences (..., n, n), symmetric, of a batched scalar function (...) of z (..., n).

    From f at z, z +- h_i and z +- (h_i + h_j): n^2 + n + 1 values. Arguments as above.
    """
    h = steps(z, 2, size)
    ways, weights = _stencil(z.shape[-1])
    aside = ways.reshape(-1, *[1] * (z.ndim - 1), z.shape[-1]) * h
    bent = np.moveaxis(np.tensordot(weights, function(z + aside), axes=1), (0, 1), (-2, -1))
    return bent / (h[..., :, None] * h[..., None, :])


@cache
def _stencil(n: int) -> tuple[FloatArray, FloatArray]:
    """Where to go, (P, n) in steps, and the weights (n, n, P) of the values there."""
    one = np.eye(n)
    pairs = [(i, j) for i in range(n) for j in range(i)]
    both = np.array([one[i] + one[j] for i, j in pairs]).reshape(-1, n)
    ways = np.concatenate([np.zeros((1, n)), one, -one, both, -both])
    weights = np.zeros((n, n, len(ways)))
    for i in range(n):
        weights[i, i, [0, 1 + i, 1 + n + i]] = -2.0, 1.0, 1.0
    for k, (i, j) in enumerate(pairs):
        at = [0, 1 + i, 1 + j, 1 + n + i, 1 + n + j, 1 + 2 * n + k, 1 + 2 * n + len(pairs) + k]
        weights[i, j, at] = weights[j, i, at] = 1.0, -0.5, -0.5, -0.5, -0.5, 0.5, 0.5
    return ways, weights


def disagreement(
    function: Callable[[FloatArray], FloatArray],
    z: FloatArray,
    given: FloatArray,
    tolerance: float,
) -> tuple[tuple[int, ...], float] | None:
    """Return where given derivatives are wrong by most, and what differences say; None if nowhere.

    Steps go through six decades. For each entry, those count about which three differences agree
    best at most points, and with those of smaller steps at all. There an entry is wrong if it is
    off by more than `tolerance` of itself, and by more than rounding of the values and ten times
    the spread of the three explain. Nothing is said of points next to poles.

    Args:
        function: Batched, (..., m).
        z: (..., n).
        given: (..., m, n).
        tolerance: Relative.
    """
    found = np.stack([differences(function, z, 1.0, factor) for factor in _SWEEP])
    spread = np.abs(found[:-2] - found[1:-1]) + np.abs(found[2:] - found[1:-1])
    h = _SWEEP[1:-1].reshape(-1, *[1] * (z.ndim + 1)) * steps(z, 1)[..., None, :]
    doubt = _DOUBT * spread + _ROUNDINGS * _EPS * np.abs(function(z))[..., :, None] / h
    doubt[~np.isfinite(doubt)] = np.inf
    points = tuple(range(1, z.ndim))  # a single spread may be small by chance
    usual = np.median(doubt, axis=points, keepdims=True) if points else doubt
    doubt, middle = np.maximum(doubt, usual), found[1:-1]
    for k in range(1, len(doubt)):  # too large a step sees nothing, and agrees with others like it
        apart = np.abs(middle[k] - middle[:k]) > doubt[:k]
        usual[k][apart.any(axis=(0, *points), keepdims=True)[0]] = np.inf
    best = np.broadcast_to(np.argmin(usual, axis=0), (1, *given.shape))
    slope, doubt = (np.take_along_axis(part, best, 0)[0] for part in (middle, doubt))
    allowed = tolerance * np.abs(slope) + doubt
    most = np.abs(slope).max(axis=(-2, -1), keepdims=True)
    allowed[np.broadcast_to(most > _WILD * np.median(most), slope.shape)] = np.inf
    excess = np.nan_to_num(np.abs(given - slope) / (allowed + 1e-300), nan=0.0)
    at = tuple(int(i) for i in np.unravel_index(np.argmax(excess), excess.shape))
    return (at, float(slope[at])) if excess[at] > 1 else None
