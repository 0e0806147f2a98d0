"""A convex body with corners, as its faces and its corners.

Notation:
    V   (nv, d)     corners [m], d = 2 or 3
    A   (nf, d)     unit outward normals of the faces
    b   (nf,)       their offsets [m]: the body is {y: A y <= b}
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from scp_mpc.arrays import FloatArray, IntArray, frozen
from scp_mpc.errors import GeometryError, ShapeError

_SAME = 1e-9  # of the body's size: points closer than that are one, angles smaller are none


@dataclass(frozen=True, eq=False)
class Solid:
    """A polygon or polyhedron in its own frame, all corners of it and no more.

    Attributes:
        vertices: (nv, d) corners [m]; counter-clockwise in the plane.
        normals: (nf, d) unit outward normals of its faces.
        offsets: (nf,) of the faces [m]: normals' y <= offsets inside.
        edges: (ne, 2) pairs of corners that an edge joins.
    """

    vertices: FloatArray = field(repr=False)
    normals: FloatArray = field(repr=False)
    offsets: FloatArray = field(repr=False)
    edges: IntArray = field(repr=False)

    @property
    def dim(self) -> int:
        """Dimension of the workspace."""
        return int(self.vertices.shape[1])

    @property
    def size(self) -> float:
        """Distance of its farthest corner from the origin of its frame [m]."""
        return float(np.linalg.norm(self.vertices, axis=1).max())

    def _take(self, argument: str, points: FloatArray) -> None:
        """Find faces and edges of points (n, d) in convex position; freeze them.

        Raises:
            ShapeError: Fewer than d + 1 points.
            GeometryError: The points coincide, lie in a plane, or are not all on their hull.
        """
        count, dim = points.shape
        if count <= dim:
            raise ShapeError(argument, f"{count} point(s) span no body in {dim} dimensions")
        centre = points.mean(axis=0)
        width = np.linalg.svd(points - centre, compute_uv=False)
        if width[-1] <= _SAME * max(width[0], np.abs(points).max()):
            raise GeometryError(argument, f"the points are flat: {width[-1]:.3g} m across")
        near = np.linalg.norm(points[:, None] - points, axis=2) + np.diag(np.full(count, np.inf))
        if near.min() <= _SAME * width[0]:
            i, j = sorted(int(k) for k in np.unravel_index(near.argmin(), near.shape))
            raise GeometryError(argument, f"points {i} and {j} are {near.min():.3g} m apart")
        try:
            hull = ConvexHull(points - centre)
        except QhullError as error:
            reason = str(error).splitlines()[0]
            raise GeometryError(argument, f"the points have no hull ({reason})") from None
        depth = -(hull.equations[:, :-1] @ (points - centre).T + hull.equations[:, -1:]).max(axis=0)
        if depth.max() > _SAME * width[0]:
            at = int(depth.argmax())
            raise GeometryError(argument, f"point {at} is {depth[at]:.3g} m inside their hull")
        corners, normals, edges = _planar(points, hull) if dim == 2 else _spatial(points, hull)
        # What the corners reach is the offset: then no corner is outside by rounding.
        offsets = (normals @ corners.T).max(axis=1)
        for name, array in (("vertices", corners), ("normals", normals), ("offsets", offsets)):
            object.__setattr__(self, name, frozen(np.ascontiguousarray(array)))
        edges.setflags(write=False)
        object.__setattr__(self, "edges", edges)


def _planar(points: FloatArray, hull: ConvexHull) -> tuple[FloatArray, FloatArray, IntArray]:
    corners = points[hull.vertices]  # counter-clockwise
    way = np.roll(corners, -1, axis=0) - corners
    normals = np.stack([way[:, 1], -way[:, 0]], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    k = np.arange(len(corners))
    return corners, normals, np.stack([k, (k + 1) % len(k)], axis=1)


def _spatial(points: FloatArray, hull: ConvexHull) -> tuple[FloatArray, FloatArray, IntArray]:
    """Triangles in one plane are one face, and what is between them is no edge."""
    n = hull.equations[:, :-1]
    first = (np.linalg.norm(n[:, None] - n, axis=2) <= 1e3 * _SAME).argmax(axis=1)
    number = np.full(len(points), -1)
    number[hull.vertices] = np.arange(len(hull.vertices))
    edges = {
        tuple(sorted(number[v] for v in np.delete(triangle, opposite)))
        for t, triangle in enumerate(hull.simplices)
        for opposite, other in enumerate(hull.neighbors[t])
        if first[t] != first[other]
    }
    faces = np.unique(first)
    return points[hull.vertices], n[faces], np.array(sorted(edges), dtype=np.intp)
