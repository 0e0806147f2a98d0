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

from scp_mpc.arrays import FloatArray
from scp_mpc.safety.polytopes import Polytopes
from scp_mpc.solver.step_data import StepData

_COSINE = 0.9  # of the angle between two directions that count as one
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
    def of(cls, step: StepData, s: float, j: int, reach: slice) -> "Ellipsoids":
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
    """Polytopes; where a path leaves them, their faces are put forward by rho."""

    shape: Polytopes
    means: FloatArray
    rho: FloatArray

    @classmethod
    def of(cls, step: StepData, s: float, j: int, reach: slice) -> "Walls":
        """Those of obstacle j at some points, at size s."""
        assert step.shapes is not None
        variances = np.linalg.eigvalsh(step.covariances[j, 1:][reach])[:, -1]
        rho = step.radii[j, reach] + s * np.sqrt(np.maximum(variances, 0.0))
        return cls(step.shapes.taken(np.array([j])), step.means[j, 1:][reach], rho)

    def faces(self, known: list[FloatArray]) -> list[FloatArray]:
        """Normals of faces that are not nearly those known, nor each other: at most two a axis."""
        found: list[FloatArray] = []
        for n in self.shape.normals[self.shape.kind[0]]:
            if len(found) < 2 * len(n) and all(n @ other < _COSINE for other in known + found):
                found.append(n)
        return found

    def aside(self, path: FloatArray, n: FloatArray) -> FloatArray:
        """See `Body`."""
        return self._out(path, np.broadcast_to(n, path.shape))

    def outward(self, path: FloatArray, n: FloatArray) -> FloatArray:
        """See `Body`."""
        away = self.shape.nearest((path - self.means)[None]).normal[0] + 0.5 * n
        return self._out(path, away / np.linalg.norm(away, axis=1, keepdims=True))

    def _out(self, path: FloatArray, along: FloatArray) -> FloatArray:
        """Move what is within along unit vectors (k, d), through the first face on the way."""
        y = (path - self.means)[None]
        within = self.shape.distance(y)[0] < self.rho
        speed = along @ self.shape.normals[self.shape.kind[0]].T
        ahead = speed > _PARALLEL
        room = self.rho[:, None] - self.shape.depths(y)[0]
        way = np.where(ahead, room / np.where(ahead, speed, 1.0), np.inf).min(axis=1)
        return path + np.where(within, way, 0.0)[:, None] * along


# tau, and how to leave the no-go set: as the free plan would, one stage later or earlier, two later
WAYS: tuple[tuple[float, Callable[[Body, FloatArray, FloatArray], FloatArray]], ...] = (
    (0.0, lambda body, path, n: body.aside(path, n)),
    (-1.0, lambda body, path, n: body.aside(path, n)),
    (1.0, lambda body, path, n: body.aside(path, n)),
    (-2.0, lambda body, path, n: body.outward(path, n)),
)
