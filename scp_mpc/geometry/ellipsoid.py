"""Signed distance to an ellipsoid and its outward normal, for whole stacks of points.

Notation:
    y   (..., d)    point in the ellipsoid's own axes [m]
    e   (..., d)    semi-axes [m]
    n   (..., d)    unit outward normal at the nearest boundary point
    sd  (...)       signed distance, negative inside [m]

    sd(y) = max_{|n|=1}  n'y - |diag(e) n|

The nearest point is q_l = e_l^2 y_l / (t + e_l^2), and n_l is proportional to y_l / (t + e_l^2),
where t solves |w(t)| = 1 with w_l = e_l y_l / (t + e_l^2). As in trust-region methods (More and
Sorensen, 1983), 1/|w(t)| is concave and almost linear, so that Newton's method on 1/|w| = 1
converges monotonically from the left, in a handful of steps. Inside and outside are one case.
"""

from collections.abc import Callable

import numpy as np

from scp_mpc.arrays import FloatArray

Side = Callable[[], FloatArray]

_MAX_NEWTON = 30
_CLOSE = 1e-8  # |w|^2 - 1 from which one more step of Newton's method reaches rounding
_TINY = 1e-13  # relative; below it a coordinate or semi-axis counts as zero
_LEAST = float(np.finfo(np.float64).tiny) ** 0.25


def signed_distance(
    y: FloatArray, semi_axes: FloatArray, side: Side | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the signed distance (...) and the unit outward normal (..., d).

    Where the nearest point is not unique (on the medial axis, or at the centre), `side` decides:
    the normal is the one that points towards it.

    Args:
        y: (..., d) points in the frame of the ellipsoid's axes [m].
        semi_axes: (..., d) non-negative semi-axes [m].
        side: Returns (..., d) vectors in the same frame, asked for only where it matters; None
            stands for the positive orthant.

    Returns:
        The signed distances and the normals. n'y - |diag(e) n| underestimates the signed distance
        for any unit n, so that whatever rounding does to n errs on the safe side.
    """
    size = np.abs(y).max(axis=-1, keepdims=True) + semi_axes.max(axis=-1, keepdims=True)
    tiny = np.maximum(_TINY * size, _LEAST)
    e = np.maximum(semi_axes, tiny)
    z = _off_the_medial_axis(y, tiny, side)
    e2 = e * e
    least = e2.min(axis=-1, keepdims=True)
    gap = e2 - least  # tau = t + least keeps the smallest denominator free of cancellation
    ez = e * np.abs(z)
    ez2 = ez * ez
    tau = (ez - gap).max(axis=-1, keepdims=True)
    for _ in range(_MAX_NEWTON):
        denominator = tau + gap
        w2 = ez2 / (denominator * denominator)
        norm2 = np.add.reduce(w2, axis=-1, keepdims=True)
        descent = np.add.reduce(w2 / denominator, axis=-1, keepdims=True)
        tau = tau + (np.sqrt(norm2) - 1) * norm2 / descent
        if norm2.max(initial=1.0) < 1 + _CLOSE:
            break
    n = z / (tau + gap)
    n /= np.sqrt(np.add.reduce(n * n, axis=-1, keepdims=True))
    en = semi_axes * n
    return np.add.reduce(n * y, axis=-1) - np.sqrt(np.add.reduce(en * en, axis=-1)), n


def _off_the_medial_axis(y: FloatArray, tiny: FloatArray, side: Side | None) -> FloatArray:
    """Replace vanishing coordinates by tiny ones with the sign of `side`."""
    vanishing = np.abs(y) < tiny
    if not vanishing.any():
        return y
    hint = np.ones_like(y) if side is None else side()
    return np.where(vanishing, np.where(hint < 0, -tiny, tiny), y)
