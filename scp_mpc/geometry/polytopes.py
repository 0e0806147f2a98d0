"""Signed distance to convex polytopes and its outward normal, for whole stacks of points.

Notation:
    y   (..., d)        point in the polytope's frame [m]
    A, b                unit normals of its faces and their offsets; V its corners
    n   (..., d)        unit outward normal at the nearest boundary point
    h(n)                max_v n'v, the support function [m]
    sd  (...)           signed distance, negative inside [m]
    L   (..., d, d-1)   factor of its second derivative: L L'

    sd(y) = max_{|n|=1}  n'y - h(n)

Inside, and wherever the nearest point is on a face, the maximiser is the normal of the face with
the largest a'y - b. Elsewhere it is that of the ridge next to y (a corner, or in space an edge),
and to call it by the wrong name does no harm: no unit n exceeds sd, so the larger value is right.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from scp_mpc.arrays import FloatArray, IntArray
from scp_mpc.geometry.tangent_basis import tangents
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.obstacles.solid import Solid

_NONE = -1
_TIE = 1e-9  # [m] of depths below two faces that count as one
_ON_FACE = 1e-9  # relative; nearer to a face than that is on it
_RIM = 0.9  # of the way from a face's middle to its rim
_POINT = 1e-9  # [m] nearer than that to a corner counts as no nearer


class Nearest(NamedTuple):
    """Signed distance (M, N), unit outward normal (M, N, d) and L (M, N, d, d-1)."""

    distance: FloatArray
    normal: FloatArray
    curvature: FloatArray


@dataclass(frozen=True, eq=False)
class Polytopes:
    """The shapes of M obstacles: P different polytopes, padded to the same numbers of everything.

    Attributes:
        kind: (M,) which polytope an obstacle is; -1 for an ellipsoid.
        vertices: (P, V, d) corners [m].
        normals: (P, F, d) unit outward normals.
        offsets: (P, F) of the faces [m].
        begin: (P, E, d) one end of each ridge.
        along: (P, E, d) from there to its other end; zero for corners.
    """

    kind: IntArray
    vertices: FloatArray
    normals: FloatArray
    offsets: FloatArray
    begin: FloatArray
    along: FloatArray

    @classmethod
    def of(cls, predictions: Sequence[ObstaclePrediction]) -> "Polytopes | None":
        """Stack the shapes of some obstacles; None if all are round."""
        for o in predictions:  # in every control step
            if o.shape is not None:
                break
        else:
            return None
        number: dict[int, int] = {}
        solids: list[Solid] = []
        kind = np.full(len(predictions), _NONE, dtype=np.intp)
        for j, shape in enumerate(o.shape for o in predictions):
            if shape is not None:
                kind[j] = number.setdefault(id(shape), len(solids))
                solids += [shape] if kind[j] == len(solids) else []
        ridges = [_ridges(solid) for solid in solids]
        return cls(
            kind,
            _padded([solid.vertices for solid in solids]),
            _padded([solid.normals for solid in solids]),
            _padded([solid.offsets for solid in solids]),
            _padded([begin for begin, _ in ridges]),
            _padded([along for _, along in ridges]),
        )

    @property
    def slots(self) -> IntArray:
        """Which obstacles are polytopes."""
        return np.flatnonzero(self.kind != _NONE)

    @property
    def others(self) -> IntArray:
        """Which are not."""
        return np.flatnonzero(self.kind == _NONE)

    def taken(self, slots: IntArray) -> "Polytopes":
        """The shapes of the given obstacles, in that order."""
        return replace(self, kind=self.kind[slots])

    def padded(self, slots: int) -> "Polytopes":
        """The same with further slots, that are no polytopes."""
        more = np.full(slots - len(self.kind), _NONE, dtype=np.intp)
        return replace(self, kind=np.concatenate([self.kind, more]))

    def depths(self, y: FloatArray) -> FloatArray:
        """Values a'y - b (M, N, F) of all faces at points (M, N, d), for polytopes alone [m]."""
        across: FloatArray = y @ np.swapaxes(self.normals[self.kind], 1, 2)
        return across - self.offsets[self.kind][:, None]

    def distance(self, y: FloatArray) -> FloatArray:
        """Signed distance (M, N) of points (M, N, d) in the frames of polytopes [m]."""
        return self.nearest(y).distance

    def over(self, face: int, y: FloatArray) -> FloatArray:
        """Points (K, d) on a face of the first polytope, near to points (K, d), off its rim."""
        k = self.kind[0]
        n, b, V = self.normals[k], self.offsets[k], self.vertices[k]
        centre = np.unique(V[b[face] - V @ n[face] <= _ON_FACE * np.abs(V).max()], axis=0).mean(0)
        way = y - centre
        way -= (way @ n[face])[:, None] * n[face]
        speed, room = way @ n.T, b - n @ centre
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.where(speed > 0, room / speed, np.inf)
        share[:, (n @ n[face]) > 1 - _ON_FACE] = np.inf
        return centre + np.minimum(1.0, _RIM * share.min(axis=1))[:, None] * way

    def nearest(self, y: FloatArray, side: Callable[[], FloatArray] | None = None) -> Nearest:
        """Return signed distance, normal and curvature at points (M, N, d), for polytopes alone.

        n'y - h(n) underestimates the signed distance for any n, so that whatever rounding does to
        n errs on the safe side.

        Args:
            y: Points in the polytopes' frames.
            side: Returns (M, N, d) vectors, asked for only where several faces are equally near
                from within: then the normal is the one that points most towards them.
        """
        depths = self.depths(y)
        face = depths.argmax(axis=2)
        if side is not None:
            face = self._towards(depths, face, side)
        sd = np.take_along_axis(depths, face[..., None], 2)[..., 0]
        n = self.normals[self.kind[:, None], face]
        L = np.zeros((*y.shape, y.shape[-1] - 1))
        j, i = np.nonzero(sd > 0)
        if len(j):
            ridge, normal, curvature = self._from_ridges(self.kind[j], y[j, i])
            nearer = ridge > sd[j, i]
            j, i = j[nearer], i[nearer]
            sd[j, i], n[j, i], L[j, i] = ridge[nearer], normal[nearer], curvature[nearer]
        return Nearest(sd, n, L)

    def _towards(
        self, depths: FloatArray, face: IntArray, side: Callable[[], FloatArray]
    ) -> IntArray:
        top = np.take_along_axis(depths, face[..., None], 2)
        ties = (depths >= top - _TIE) & (top <= 0)
        if (ties.sum(axis=2) <= 1).all():
            return face
        facing = side() @ np.swapaxes(self.normals[self.kind], 1, 2)
        return np.where(ties.any(axis=2), np.where(ties, facing, -np.inf).argmax(axis=2), face)

    def _from_ridges(
        self, kind: IntArray, y: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """N'y - h(n) (K,), n and L for the direction n from the nearest ridge to outside points."""
        away, along = y[:, None] - self.begin[kind], self.along[kind]
        length2 = np.add.reduce(along * along, axis=-1)
        reach = np.add.reduce(away * along, axis=-1)
        share = np.clip(reach / np.where(length2 > 0, length2, 1.0), 0.0, 1.0)
        away = away - share[..., None] * along
        distance2 = np.add.reduce(away * away, axis=-1)
        at = (np.arange(len(y)), distance2.argmin(axis=1))
        rho = np.maximum(np.sqrt(distance2[at]), np.finfo(np.float64).tiny)
        n = away[at] / rho[:, None]
        h = (self.vertices[kind] @ n[..., None])[..., 0].max(axis=1)
        L = tangents(n)
        on_edge = (share[at] > 0) & (share[at] < 1)
        if on_edge.any():  # the distance is that to a line, flat along it
            e = along[at][on_edge] / np.sqrt(length2[at][on_edge])[:, None]
            L[on_edge] = 0.0
            L[on_edge, :, 0] = np.cross(n[on_edge], e)
        L /= np.sqrt(np.maximum(rho, _POINT))[:, None, None]
        return np.add.reduce(n * y, axis=1) - h, n, L


def _ridges(solid: Solid) -> tuple[FloatArray, FloatArray]:
    """Where the distance is curved outside: corners in the plane, edges in space."""
    if solid.dim == 2:
        return solid.vertices, np.zeros_like(solid.vertices)
    begin, end = solid.vertices[solid.edges[:, 0]], solid.vertices[solid.edges[:, 1]]
    return begin, end - begin


def _padded(parts: Sequence[FloatArray]) -> FloatArray:
    """Stack arrays of different lengths: the first entry again and again does no harm."""
    most = max(len(part) for part in parts)
    return np.stack(
        [np.concatenate([part, part[:1].repeat(most - len(part), 0)]) for part in parts]
    )
