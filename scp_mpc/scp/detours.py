"""How a path leaves one obstacle's no-go sets, towards a side: points to linearise about.

Notation:
    n       (d,)        where to: a unit vector
    e       (k, d)      semi-axes s sigma + r of ellipsoids; w and m: offset and n in units of them
    rho     (k,)        s sigma + r, by which polytopes are rounded, or their faces put forward [m]
    A, b                faces of a polytope
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from scp_mpc.arrays import BoolArray, FloatArray, IntArray
from scp_mpc.safety.polytopes import Polytopes
from scp_mpc.scp.step import Step

_COSINE = 0.9  # of the angle between two directions that count as one
_TOUCH = 1e-9  # [m] less than that within is not within
_PARALLEL = 1e-9  # cosine below which a face is never reached


class Body(Protocol):
    """One obstacle's no-go sets at some points of a plan."""

    def aside(self, path: FloatArray, n: FloatArray) -> FloatArray:
        """Move the points of a path (k, d) that lie within along n to the boundary."""
        ...

    def outward(self, path: FloatArray, n: FloatArray) -> FloatArray:
        """Move them away from the middle, and half as much towards n, to the boundary."""
        ...


@dataclass(frozen=True, eq=False)
class Ellipsoids:
    """Ellipsoids, their axes lengthened by the radii."""

    means: FloatArray
    scaling: FloatArray  # (k, d, d) takes offsets to units of the semi-axes

    @classmethod
    def of(cls, step: Step, s: float, j: int, reach: slice) -> "Ellipsoids":
        """Those of obstacle j at some points, at size s."""
        variances, rotations = np.linalg.eigh(step.covariances[j, 1:][reach])
        radii = step.radii[j, reach, None]
        e = np.maximum(s * np.sqrt(np.maximum(variances, 0.0)) + radii, 1e-9)
        return cls(step.means[j, 1:][reach], np.swapaxes(rotations, 1, 2) / e[..., None])

    def aside(self, path: FloatArray, n: FloatArray) -> FloatArray:
        """See `Body`."""
        w = (self.scaling @ (path - self.means)[..., None])[..., 0]
        m = self.scaling @ n
        mm, wm = (m * m).sum(axis=1), (w * m).sum(axis=1)
        room = 1 - (w * w).sum(axis=1)  # positive inside
        shift = np.where(room > 0, (np.sqrt(wm**2 + mm * np.maximum(room, 0.0)) - wm) / mm, 0.0)
        return path + shift[:, None] * n

    def outward(self, path: FloatArray, n: FloatArray) -> FloatArray:
        """See `Body`."""
        w = (self.scaling @ (path - self.means)[..., None])[..., 0]
        m = self.scaling @ n
        within = (w * w).sum(axis=1) < 1
        w[within] += 0.5 * m[within] / np.linalg.norm(m[within], axis=1, keepdims=True)
        w[within] /= np.maximum(np.linalg.norm(w[within], axis=1, keepdims=True), 1e-12)
        boundary: FloatArray = self.means + np.linalg.solve(self.scaling, w[..., None])[..., 0]
        return boundary


@dataclass(frozen=True, eq=False)
class Walls:
    """One or several polytopes (w of them), left together; their faces are put forward by rho."""

    shapes: Polytopes
    means: FloatArray  # (w, k, d)
    rho: FloatArray  # (w, k)

    @classmethod
    def of(cls, step: Step, s: FloatArray, slots: IntArray, reach: slice) -> "Walls":
        """Those of some obstacles at some points, at sizes s (M,)."""
        assert step.shapes is not None
        variances = np.linalg.eigvalsh(step.covariances[slots, 1:][:, reach])[..., -1]
        rho = step.radii[slots, reach] + s[slots, None] * np.sqrt(np.maximum(variances, 0.0))
        return cls(step.shapes.taken(slots), step.means[slots, 1:][:, reach], rho)

    def faces(self, known: list[FloatArray]) -> list[FloatArray]:
        """Normals of faces that are not nearly those known, nor each other: at most two an axis."""
        found: list[FloatArray] = []
        for n in self.shapes.normals[self.shapes.kind[0]]:
            if len(found) < 2 * len(n) and all(n @ other < _COSINE for other in known + found):
                found.append(n)
        return found

    def aside(self, path: FloatArray, n: FloatArray) -> FloatArray:
        """See `Body`."""
        return self._out(path, n)

    def apart(self, path: FloatArray, normals: FloatArray) -> FloatArray:
        """The same, but out of each polytope towards a side of its own (w, d)."""
        return self._out(path, normals[:, None])

    def outward(self, path: FloatArray, n: FloatArray) -> FloatArray:
        """See `Body`; away from the first one."""
        first = self.shapes.taken(np.zeros(1, dtype=np.intp))
        away = first.nearest((path - self.means[0])[None]).normal[0] + 0.5 * n
        return self._out(path, away / np.linalg.norm(away, axis=1, keepdims=True))

    def _out(self, path: FloatArray, along: FloatArray) -> FloatArray:
        """Move what is within along unit vectors (w, k, d): out of one, and of what comes next."""
        along = np.broadcast_to(along, self.means.shape)
        speed = along @ np.swapaxes(self.shapes.normals[self.shapes.kind], 1, 2)
        ahead, points = speed > _PARALLEL, np.arange(len(path))
        for _ in self.means:
            y = path - self.means
            within = self.shapes.distance(y) < self.rho - _TOUCH
            if not within.any():
                break
            room = self.rho[..., None] - self.shapes.depths(y)
            way = np.where(ahead, room / np.where(ahead, speed, 1.0), np.inf).min(axis=2)
            way = np.where(within, way, 0.0)
            which = way.argmax(axis=0)
            path = path + way[which, points][:, None] * along[which, points]
        return path

    def flips(self, path: FloatArray, touched: BoolArray, count: int) -> list[FloatArray]:
        """Paths that pass one polytope at one stage by another face than a path (k, d) does.

        What does not push the path need not be moved: to give it more room would gain nothing.

        Args:
            path: Positions.
            touched: (w, k) which polytopes push it, at which points.
            count: Points in a stage.
        """
        y = path - self.means
        stages = touched.reshape(len(y), -1, count).any(axis=2)
        found = []
        for w, i in np.argwhere(stages).tolist():
            at = slice(i * count, (i + 1) * count)
            one = self.shapes.taken(np.array([w]))
            normals = one.normals[one.kind[0]]
            here = one.nearest(y[None, w, at]).normal[0, -1]
            for f in np.unique(normals, axis=0, return_index=True)[1].tolist():
                if normals[f] @ here < _COSINE:
                    new = path.copy()
                    over = one.over(f, y[w, at]) + self.rho[w, at, None] * normals[f]
                    new[at] = self.means[w, at] + over
                    found.append(new)
        return found


# tau, and how to leave the no-go set: as the free plan would, one stage later or earlier, two later
WAYS: tuple[tuple[float, Callable[[Body, FloatArray, FloatArray], FloatArray]], ...] = (
    (0.0, lambda body, path, n: body.aside(path, n)),
    (-1.0, lambda body, path, n: body.aside(path, n)),
    (1.0, lambda body, path, n: body.aside(path, n)),
    (-2.0, lambda body, path, n: body.outward(path, n)),
)
