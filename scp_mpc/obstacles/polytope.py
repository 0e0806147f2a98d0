"""Shapes of obstacles: convex polygons and polyhedra, from corners, half-spaces or measures."""

from collections.abc import Hashable

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection

from scp_mpc.arrays import FloatArray, as_array, as_number
from scp_mpc.errors import BoundsError, GeometryError, ShapeError
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.obstacles.solid import Solid

_THIN = 1e-9  # of the body's size: what is thinner is none
_UNBOUNDED, _EMPTY = 3, 2  # statuses of `linprog`


class Polytope(Solid):
    """A convex polygon (d = 2) or polyhedron (d = 3) in its own frame.

    The frame's axes are the world's, its origin is at the obstacle's position: corners in world
    coordinates go with a position of zero, as by `static`, or are counted twice. Walls with a bend,
    rooms and other bodies that are not convex are several obstacles.

    Args:
        vertices: (nv, d) its corners [m], in any order. Points on a face are let go.

    Raises:
        ShapeError: Not (nv, 2) or (nv, 3), or fewer than d + 1 points.
        GeometryError: The points coincide, are flat, or one of them is inside the others' hull.
        NotFiniteError: NaN or infinity.
    """

    def __init__(self, vertices: ArrayLike) -> None:
        """Copy, check and freeze."""
        self._take("vertices", as_array("vertices", vertices, (-1, 2), (-1, 3)))

    def __repr__(self) -> str:
        """Say how many corners and faces there are."""
        return f"Polytope({len(self.vertices)} vertices, {len(self.normals)} faces, {self.dim}-D)"

    @classmethod
    def from_half_spaces(cls, A: ArrayLike, b: ArrayLike) -> "Polytope":
        """Return {y: A y <= b} for A (nf, d) of any row lengths and b (nf,).

        Raises:
            ShapeError: The shapes do not belong together.
            GeometryError: A row of zeros; the set is empty, flat or unbounded.
            NotFiniteError: NaN or infinity.
        """
        rows = as_array("A", A, (-1, 2), (-1, 3))
        limits = as_array("b", b, (len(rows),))
        length = np.linalg.norm(rows, axis=1)
        if not len(rows) or not length.all():
            raise GeometryError("A", f"row {int(length.argmin()) if len(rows) else 0} is zero")
        rows, limits = rows / length[:, None], limits / length
        size = _extent(rows, limits)
        # The centre of the largest ball within: max rho  s.t.  a'y + rho <= b
        ball = linprog(
            np.append(np.zeros(rows.shape[1]), -1.0),
            np.column_stack([rows, np.ones(len(rows))]),
            limits,
            bounds=(None, None),
        )
        if ball.x is None or ball.x[-1] <= _THIN * size:
            depth = np.nan if ball.x is None else ball.x[-1]
            raise GeometryError("b", f"the set is flat: a ball of {depth:.3g} m fills it")
        centre = ball.x[:-1]
        corners = HalfspaceIntersection(np.column_stack([rows, -limits]), centre).intersections
        return cls(_distinct(corners, _THIN * 10 * size))

    @classmethod
    def box(
        cls,
        size: ArrayLike,
        angle: float = 0.0,
        rotation: ArrayLike | None = None,
        centre: ArrayLike | None = None,
    ) -> "Polytope":
        """Return a rectangle or cuboid.

        Args:
            size: (d,) whole lengths along its axes [m].
            angle: By which a rectangle is turned, counter-clockwise [rad].
            rotation: (d, d) orthogonal matrix that turns it, instead.
            centre: (d,) its centre in the frame; None for the origin.

        Raises:
            BoundsError: A length is not positive.
            GeometryError: The matrix is not orthogonal, or an angle is given in space.
        """
        lengths = as_array("size", size, (2,), (3,))
        dim = len(lengths)
        if (lengths <= 0).any():
            raise BoundsError("size", f"{lengths.min()} m is not positive")
        angle = as_number("angle", angle)
        if rotation is None:
            turn = np.eye(dim)
            turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        else:
            turn = as_array("rotation", rotation, (dim, dim))
            if np.abs(turn @ turn.T - np.eye(dim)).max() > 1e-9:
                raise GeometryError("rotation", "the matrix is not orthogonal")
        if angle and (rotation is not None or dim == 3):
            raise GeometryError("angle", f"{angle} rad without an axis: give a rotation alone")
        at = np.zeros(dim) if centre is None else as_array("centre", centre, (dim,))
        signs = np.stack(np.meshgrid(*[[-0.5, 0.5]] * dim, indexing="ij"), axis=-1).reshape(-1, dim)
        return cls(at + signs * lengths @ turn.T)

    def static(
        self,
        horizon: int,
        at: ArrayLike | None = None,
        radius: float = 0.0,
        name: Hashable = None,
    ) -> ObstaclePrediction:
        """Return the prediction of a body that stays where it is, for certain.

        Args:
            horizon: N, as in the problem.
            at: (d,) where its frame's origin is [m]; None for the world's.
            radius: By which it is rounded [m].
            name: Who it is.
        """
        at = np.zeros(self.dim) if at is None else at
        return ObstaclePrediction.static(horizon, at, radius, name, self)


def _extent(rows: FloatArray, limits: FloatArray) -> float:
    """Half the longest side of the bounding box of {y: rows y <= limits}."""
    longest = 0.0
    for axis in np.eye(rows.shape[1]):
        ends = []
        for sign in (1.0, -1.0):
            found = linprog(sign * axis, rows, limits, bounds=(None, None))
            if found.status == _EMPTY:
                raise GeometryError("b", "no point meets all of the half-spaces")
            if found.status == _UNBOUNDED or found.x is None:
                raise GeometryError("A", f"the set is unbounded along {(-sign * axis).tolist()}")
            ends.append(float(axis @ found.x))
        longest = max(longest, abs(ends[1] - ends[0]) / 2)
    return longest


def _distinct(points: FloatArray, least: float) -> FloatArray:
    """The points without those that an earlier one stands for, and without those on a face."""
    near = np.linalg.norm(points[:, None] - points, axis=2) <= least
    points = points[near.argmax(axis=1) == np.arange(len(points))]
    if len(points) <= points.shape[1]:
        raise ShapeError("b", f"only {len(points)} corner(s) are left")
    return points[ConvexHull(points).vertices]
