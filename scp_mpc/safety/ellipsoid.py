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

import numpy as np

from scp_mpc.arrays import FloatArray

_MAX_NEWTON = 30
_TINY = 1e-13  # relative; below it a coordinate or semi-axis counts as zero


def signed_distance(
    y: FloatArray, semi_axes: FloatArray, side: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the signed distance (...) and the unit outward normal (..., d).

    Where the nearest point is not unique (on the medial axis, or at the centre), `side` decides:
    the normal is the one that points towards it.

    Args:
        y: (..., d) points in the frame of the ellipsoid's axes [m].
        semi_axes: (..., d) non-negative semi-axes [m].
        side: (..., d) vectors in the same frame; None stands for the positive orthant.

    Returns:
        The signed distances and the normals. n'y - |diag(e) n| underestimates the signed distance
        for any unit n, so that whatever rounding does to n errs on the safe side.
    """
    size = np.abs(y).max(axis=-1, keepdims=True) + semi_axes.max(axis=-1, keepdims=True)
    tiny = np.maximum(_TINY * size, np.finfo(np.float64).tiny ** 0.25)
    e = np.maximum(semi_axes, tiny)
    z = _off_the_medial_axis(y, tiny, side)
    e2 = e * e
    least = e2.min(axis=-1, keepdims=True)
    gap = e2 - least  # tau = t + least keeps the smallest denominator free of cancellation
    ez = e * np.abs(z)
    tau = (ez - gap).max(axis=-1, keepdims=True)
    for _ in range(_MAX_NEWTON):
        denominator = tau + gap
        w = ez / denominator
        w2 = w * w
        norm2 = w2.sum(axis=-1, keepdims=True)
        norm = np.sqrt(norm2)
        if norm.max(initial=1.0) < 1 + 1e-14:
            break
        tau = tau + (norm - 1) * norm2 / (w2 / denominator).sum(axis=-1, keepdims=True)
    n = z / (tau + gap)
    n /= np.sqrt((n * n).sum(axis=-1, keepdims=True))
    en = semi_axes * n
    return (n * y).sum(axis=-1) - np.sqrt((en * en).sum(axis=-1)), n


def _off_the_medial_axis(y: FloatArray, tiny: FloatArray, side: FloatArray | None) -> FloatArray:
    """Replace vanishing coordinates by tiny ones with the sign of `side`."""
    hint = np.ones_like(y) if side is None else side
    return np.where(np.abs(y) < tiny, np.where(hint < 0, -tiny, tiny), y)
