"""Curves as polynomials of their own arc length: circle, polyline, spline.

A curve is cut into pieces; within one, p(s_k + h) = sum_n c_n h^n with |dp/dh| = 1. Curved pieces
are quintic: position, tangent and curvature agree where two of them meet, so the curve is twice
continuously differentiable, and unit speed holds to about 1e-8.

Notation:
    s, h    arc length [m], the same from the beginning of a piece
    p, t, c position, tangent, curvature vector: p, dp/ds, d2p/ds2
    g       (count,) parameter in which a spline is cubic
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from scp_mpc.arrays import FloatArray, as_array
from scp_mpc.errors import InvalidArgumentError, ShapeError
from scp_mpc.settings import require_positive

_CUTS = 64  # pieces of a circle
_UNIT = 1e-8  # how far |dp/ds| may be from one
_CUSP = 1e-5  # the same where a spline nearly turns on the spot
_FINEST = 512  # pieces between two points of a spline
_REPEATED = 1e-4  # of the mean distance between points, at which two are the same
_BACK = 0.5  # of the distances around it, below which a step back is a mistake
_BACKWARDS = -0.5  # sum of the cosines of both turns; -2 for there and back, 0 for a hairpin


@dataclass(frozen=True, eq=False)
class Pieces:
    """A curve cut into K pieces.

    Attributes:
        knots: (K+1,) arc lengths at which they begin and end [m].
        coefficients: (n, K, d) of the powers of h, the lowest first.
    """

    knots: FloatArray
    coefficients: FloatArray


def circle(radius: float, centre: ArrayLike, start: float, clockwise: bool) -> Pieces:
    """One turn about a centre (d,), level in 3-D, from the angle `start` [rad].

    Raises:
        BoundsError: The radius is not positive.
        ShapeError: The centre is not in 2-D or 3-D.
    """
    require_positive("radius", radius)
    middle = as_array("centre", centre, (2,), (3,))
    turn = -1.0 if clockwise else 1.0
    angle = float(as_array("start", start, ())) + turn * np.linspace(0, 2 * np.pi, _CUTS + 1)
    out, along = np.zeros((2, _CUTS + 1, len(middle)))
    out[:, 0], out[:, 1] = np.cos(angle), np.sin(angle)
    along[:, 0], along[:, 1] = -turn * out[:, 1], turn * out[:, 0]
    out[-1], along[-1] = out[0], along[0]
    knots = radius * np.linspace(0, 2 * np.pi, _CUTS + 1)
    return _quintic(knots, middle + radius * out, along, -out / radius)


def polyline(points: ArrayLike, closed: bool) -> Pieces:
    """Straight lines through points (count, d).

    Raises:
        InvalidArgumentError: Or a subclass, as `waypoints`.
    """
    p = waypoints(points, closed)
    way = np.diff(p, axis=0)
    length: FloatArray = np.linalg.norm(way, axis=1)
    knots = np.concatenate([[0.0], np.cumsum(length)])
    return Pieces(knots, np.stack([p[:-1], way / length[:, None]]))


def spline(points: ArrayLike, closed: bool) -> Pieces:
    """The cubic spline through points (count, d), parametrised anew by its arc length.

    Raises:
        InvalidArgumentError: Or a subclass, as `waypoints`; or the points step back, or the spline
            turns on the spot.
    """
    p = waypoints(points, closed)
    _require_onward(p, closed)
    g = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    curve = CubicSpline(g, p, bc_type="periodic" if closed else "not-a-knot")
    cuts = 8
    while True:
        pieces = _by_length(curve, g, cuts)
        unit = np.abs(np.linalg.norm(_middle_tangents(pieces), axis=1) - 1)
        if unit.max() <= (_UNIT if cuts < _FINEST else _CUSP):
            return pieces
        if cuts >= _FINEST:
            at = int(np.argmax(unit)) // (2 * cuts)
            raise InvalidArgumentError(
                "points", f"the spline turns on the spot between points {at} and {at + 1}"
            )
        cuts *= 2


def waypoints(points: ArrayLike, closed: bool) -> FloatArray:
    """Return points (count, d), the first one again at the end of a closed path.

    Raises:
        ShapeError: Not (count, 2) or (count, 3), or too few.
        NotFiniteError: NaN or infinity.
        InvalidArgumentError: A point is the same as the one before, or nearly: a spline or a corner
            would turn there and back.
    """
    p = as_array("points", points, (-1, 2), (-1, 3))
    least = 3 if closed else 2
    if len(p) < least:
        kind = "a closed" if closed else "an open"
        raise ShapeError("points", f"{len(p)} are too few: {kind} path needs {least}")
    if closed:
        p = np.concatenate([p, p[:1]])
    way = np.diff(p, axis=0)
    length = np.linalg.norm(way, axis=1)
    same = length <= np.maximum(1e-9 * np.abs(p).max(), _REPEATED * length.mean())
    if same.any():
        at = int(np.argmax(same))
        raise InvalidArgumentError(
            "points", f"{_pair(at, p, closed)} are the same: {length[at]:.3g} m apart at {p[at]}"
        )
    return p


def _require_onward(p: FloatArray, closed: bool) -> None:
    """Raise where a way (count, d) steps back by far less than it goes on before and after.

    A spline through such points makes loops as large as the steps around.
    """
    way = np.diff(p, axis=0)
    length = np.linalg.norm(way, axis=1)
    before, after = np.roll(length, 1), np.roll(length, -1)
    turn = (way * np.roll(way, 1, axis=0)).sum(axis=1) / (length * before)  # cosines, from the last
    turned = np.roll(turn, -1)  # to the next
    if not closed:
        before[0], after[-1] = np.inf, np.inf
        turn[0], turned[-1] = turned[0], turn[-1]
    back = (turn + turned < _BACKWARDS) & (length < _BACK * np.minimum(before, after))
    if back.any():
        at = int(np.argmax(back))
        step = float(np.linalg.norm(p[at + 1] - p[at]))
        raise InvalidArgumentError(
            "points", f"{_pair(at, p, closed)} are a step back of {step:.3g} m"
        )


def _pair(at: int, p: FloatArray, closed: bool) -> str:
    """Names of a point and the next one."""
    return f"{at} and {(at + 1) % (len(p) - 1) if closed else at + 1}"


def _by_length(curve: Any, g: FloatArray, cuts: int) -> Pieces:
    share = np.linspace(0, 1, cuts, endpoint=False)
    fine = np.append((g[:-1, None] + np.diff(g)[:, None] * share).ravel(), g[-1])
    node, weight = np.polynomial.legendre.leggauss(8)
    half = np.diff(fine)[:, None] / 2
    speed = np.linalg.norm(curve(fine[:-1, None] + half * (1 + node), 1), axis=-1)
    knots = np.concatenate([[0.0], np.cumsum(half[:, 0] * (speed @ weight))])
    p, dp, ddp = (np.asarray(curve(fine, n), dtype=np.float64) for n in range(3))
    fast = np.maximum(np.linalg.norm(dp, axis=1, keepdims=True), 1e-12)
    t = dp / fast
    c = (ddp - np.sum(ddp * t, axis=1, keepdims=True) * t) / fast**2
    return _quintic(knots, p, t, c)


def _quintic(knots: FloatArray, p: FloatArray, t: FloatArray, c: FloatArray) -> Pieces:
    h = np.diff(knots)[:, None]
    D = p[1:] - p[:-1] - t[:-1] * h - c[:-1] * h**2 / 2
    E = (t[1:] - t[:-1] - c[:-1] * h) * h
    F = (c[1:] - c[:-1]) * h**2 / 2
    third, fourth, fifth = 10 * D - 4 * E + F, -15 * D + 7 * E - 2 * F, 6 * D - 3 * E + F
    terms = [p[:-1], t[:-1], c[:-1] / 2, third / h**3, fourth / h**4, fifth / h**5]
    return Pieces(knots, np.stack(terms))


def _middle_tangents(pieces: Pieces) -> FloatArray:
    """Tangents (2 K, d) where a quintic that is right at both ends errs: a quarter from each."""
    order = np.arange(1, len(pieces.coefficients))
    h = (np.diff(pieces.knots)[:, None] * [0.25, 0.75]).ravel()
    c = np.repeat(pieces.coefficients[1:], 2, axis=1) * order[:, None, None]
    return np.asarray(np.sum(c * (h ** (order - 1)[:, None])[..., None], axis=0))
