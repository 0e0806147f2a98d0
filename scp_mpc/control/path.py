"""Paths: curves in the plane or in space, measured by their arc length.

Notation:
    s       progress: arc length from the beginning [m]; counts on over the laps of a closed path
    p(s)    (d,) position, t = dp/ds tangent, c = d2p/ds2
    x       (d,) point to be projected: minimise |p(s) - x|, that is (p - x)' t = 0
"""

from math import floor

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray, IntArray, as_array, frozen
from scp_mpc.control.curves import Pieces, circle, polyline, spline

_ITERATIONS = 20  # of Newton's method for the nearest point; two or three are used
_SMALL = 1e-4  # [m] a step after which the next would be of the order of its square
_FLAT = 1e-3  # least curvature of the squared distance that it divides by
_FLATTEST = 0.2  # the same for where it begins


class Path:
    """A curve, open or closed, made by `Path.circle`, `Path.polyline` or `Path.spline`.

    Attributes:
        closed: Whether it ends where it begins.
        length: Of all of it, or of one lap [m].
        knots: (K+1,) arc lengths at which its pieces meet [m].
    """

    def __init__(self, pieces: Pieces, closed: bool) -> None:
        """Differentiate, and evaluate both ends of each piece."""
        self.closed = closed
        self.knots = frozen(pieces.knots)
        self.length = float(self.knots[-1])
        c, order = pieces.coefficients, np.arange(len(pieces.coefficients))[:, None, None]
        self._powers = np.zeros((len(c), 3, *c.shape[1:]))  # of p, t and c
        self._powers[:, 0] = c
        self._powers[:-1, 1] = (order * c)[1:]
        self._powers[:-1, 2] = (order * self._powers[:, 1])[1:]
        self._begin, self._way = c[0], np.diff(self.knots)
        end, self._leaving, _ = _horner(self._powers, self._way)
        # At both ends of each piece, (p - x)' t = slope - tangent' x.
        self._tangents = np.stack([self._powers[0, 1], self._leaving], axis=1)
        self._slopes = np.sum(np.stack([c[0], end], axis=1) * self._tangents, axis=2)

    @classmethod
    def circle(
        cls,
        radius: float,
        centre: ArrayLike = (0.0, 0.0),
        start: float = 0.0,
        clockwise: bool = False,
    ) -> "Path":
        """A closed circle.

        Args:
            radius: [m].
            centre: (2,) or (3,) [m]; in 3-D the circle lies level at the centre's height.
            start: Angle from the first axis at which it begins [rad].
            clockwise: Its sense, seen from above.

        Raises:
            InvalidArgumentError: Or a subclass: no positive radius, no such centre.
        """
        return cls(circle(radius, centre, start, clockwise), closed=True)

    @classmethod
    def polyline(cls, points: ArrayLike, closed: bool = False) -> "Path":
        """Straight lines from point to point (count, 2) or (count, 3) [m].

        Raises:
            InvalidArgumentError: Or a subclass: too few points, repeated ones, NaN.
        """
        return cls(polyline(points, closed), closed)

    @classmethod
    def spline(cls, points: ArrayLike, closed: bool = False) -> "Path":
        """The cubic spline through points (count, 2) or (count, 3) [m]; curvature does not jump.

        Raises:
            InvalidArgumentError: Or a subclass: too few points, repeated ones, NaN.
        """
        return cls(spline(points, closed), closed)

    @property
    def dim(self) -> int:
        """Dimension of the workspace, 2 or 3."""
        return int(self._begin.shape[1])

    def positions(self, s: ArrayLike) -> FloatArray:
        """Positions (..., d) at progress s (...) [m]; an open path stays at its ends."""
        return self.derivatives(s, 1)[0]

    def tangents(self, s: ArrayLike) -> FloatArray:
        """Unit tangents (..., d) at progress s (...); the one after a corner, at a corner."""
        return self.derivatives(s, 2)[1]

    def curvatures(self, s: ArrayLike) -> FloatArray:
        """Curvatures (...) [1/m], not negative; zero at corners, which `corners` tells of."""
        return np.asarray(np.linalg.norm(self.derivatives(s)[2], axis=-1))

    def derivatives(self, s: ArrayLike, count: int = 3) -> FloatArray:
        """Positions, tangents and curvature vectors (3, ..., d) at progress s (...), or the first.

        Args:
            s: [m].
            count: How many of the three.
        """
        k, h = self.pieces(s)
        return _horner(self._powers[:, :count, k], h)

    def corners(self) -> FloatArray:
        """Angles (K+1,) by which the tangent jumps at the knots [rad]."""
        before, after = self._leaving, self._powers[0, 1]
        angles = np.zeros(len(self.knots))
        angles[1:-1] = _angle(before[:-1], after[1:])
        if self.closed:
            angles[[0, -1]] = _angle(before[-1], after[0])
        return angles

    def pieces(self, s: ArrayLike) -> tuple[IntArray, FloatArray]:
        """The piece in which s (...) lies, and how far from its beginning [m]."""
        s = np.asarray(s, dtype=np.float64)
        s = s % self.length if self.closed else np.minimum(np.maximum(s, 0.0), self.length)
        k = np.minimum(self.knots.searchsorted(s, "right") - 1, len(self._begin) - 1)
        return k, s - self.knots[k]

    def project(self, point: ArrayLike, between: tuple[float, float] | None = None) -> float:
        """Return the progress s of the nearest point on the path [m].

        Args:
            point: (d,) [m].
            between: Least and greatest s to be looked at, for a path that meets itself; the result
                lies within. None: all of it, or one lap from 0.

        Raises:
            InvalidArgumentError: Or a subclass: not a point of this dimension.
        """
        x = as_array("point", point, (self.dim,))
        low, high = (0.0, self.length) if between is None else between
        if not self.closed:
            low, high = (min(max(end, 0.0), self.length) for end in (low, high))
        if high <= low:
            return low
        k, start = self._within(low, high)
        # Between two knots at which the distance falls and rises, it has a minimum.
        falls, rises = (self._slopes[k] - self._tangents[k] @ x).T
        near = (falls <= 0) & (rises >= 0)
        near[:-1] |= (falls[:-1] <= 0) & (falls[1:] >= 0)  # at a corner
        near[0] = near[-1] = True
        k, start, falls, rises = k[near], start[near], falls[near], rises[near]
        way = self._way[k]
        h = -falls / np.maximum(rises - falls, _FLATTEST * way) * way
        h, gap2 = self._nearest(
            x, k, h, np.maximum(low - start, 0.0), np.minimum(high - start, way)
        )
        best = int(gap2.argmin())
        # Where the distance has a maximum in the window, one of its ends may be nearer.
        ends = ((self.positions([low, high]) - x) ** 2).sum(axis=1)
        if ends.min() < gap2[best]:
            return (low, high)[int(ends.argmin())]
        return min(max(float(start[best] + h[best]), low), high)

    def _within(self, low: float, high: float) -> tuple[IntArray, FloatArray]:
        """The pieces that touch a window, and the progress at which each begins."""
        K, L = len(self._begin), self.length
        if not self.closed:
            first = int(self.knots.searchsorted(low, "right")) - 1
            k = np.arange(min(first, K - 1), min(int(self.knots.searchsorted(high)), K))
            return k, self.knots[k]
        laps = floor(low / L)
        first = int(self.knots.searchsorted(low - laps * L, "right")) - 1
        more = floor(high / L)
        last = (more - laps) * K + int(self.knots.searchsorted(high - more * L, "right"))
        index = np.arange(first, last)
        turn, k = np.divmod(index, K)
        return k, (laps + turn) * L + self.knots[k]

    def _nearest(
        self, x: FloatArray, k: IntArray, h: FloatArray, low: FloatArray, high: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """The nearest point of each piece k between low and high: h and |p - x|^2."""
        powers, gap2 = self._powers[:, :, k], h
        h = np.minimum(np.maximum(h, low), high)
        for _ in range(_ITERATIONS):
            terms = _horner(powers, h)
            terms[0] -= x
            gap2, slope, bend = np.add.reduce(terms * terms[0], axis=-1)
            after = h - slope / np.maximum(np.abs(1 + bend), _FLAT)
            after = np.minimum(np.maximum(after, low), high)
            moved, h = np.abs(after - h).max(), after
            if moved <= _SMALL:
                break
        return h, gap2


def _horner(powers: FloatArray, h: FloatArray) -> FloatArray:
    """Sum powers (n, 3, ..., d) of h (...), the highest first."""
    h = h[..., None]
    total: FloatArray = powers[-1] * h
    for power in powers[-2:0:-1]:
        total += power
        total *= h
    total += powers[0]
    return total


def _angle(before: FloatArray, after: FloatArray) -> FloatArray:
    """Angle between unit vectors (..., d), exact for small ones."""
    away = np.linalg.norm(after - before, axis=-1)
    together = np.linalg.norm(after + before, axis=-1)
    return np.asarray(2 * np.arctan2(away, together))
