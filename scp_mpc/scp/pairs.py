"""The pairs of obstacle and node that can matter in one control step; all others stay out.

Notation:
    K           number of pairs (j, i): obstacle and node
    y           outputs of a plan, see `layout.py`
    g   (K,)    constraint function, to be non-negative [m]
    a   (K, w)  its gradient with respect to y[at]: position and size, w = d + 1
    L   (K, w, d-1)     factor of its second derivative, L L'
"""

from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import BoolArray, FloatArray
from scp_mpc.geometry.no_go import HalfSpaces, NoGoSets
from scp_mpc.scp.layout import Layout
from scp_mpc.scp.step import Step


@dataclass(frozen=True, eq=False)
class Planes:
    """The half-spaces g + a'(y[at] - y0[at]) >= 0 of all pairs, linearised about one point y0.

    Attributes:
        y: (ny,) the point.
        g: (K,) values there.
        a: (K, w) gradients.
        spaces: The half-spaces as the geometry knows them.
    """

    y: FloatArray
    g: FloatArray
    a: FloatArray
    spaces: HalfSpaces


class Pairs:
    """Geometry of some pairs of obstacle and node in one control step.

    Attributes:
        near: (J, C) which pairs.
        obstacle: (K,) j; likewise `node`, i, counted from 0.
        at: (K, w) where position and size stand in y.

    Args:
        step: The control step.
        layout: Where positions and sizes stand in y.
        near: (J, C) the pairs.
    """

    def __init__(self, step: Step, layout: Layout, near: BoolArray) -> None:
        """Gather the pairs' predictions."""
        self.near, (self.obstacle, self.node) = near, np.nonzero(near)
        j, i, d = self.obstacle, self.node, step.problem.model.dim
        self.at = np.empty((len(j), d + 1), dtype=np.intp)
        self.at[:, :d] = i[:, None] * d + np.arange(d)
        self.at[:, d] = layout.s.start + j
        self._step, self._p = step, layout.p
        self._sensitivity: FloatArray | None = None
        if not len(j):  # most steps: no obstacle is near, and the geometry has nothing to say
            return
        covariances = step.covariances[j, i + 1]
        shapes = None if step.shapes is None else step.shapes.taken(j)
        self._sets = NoGoSets.pairs(step.means[j, i + 1], covariances, step.radii[j, i], shapes)
        self._means_before = step.means[j, i]

    def rows(self, sensitivity: FloatArray) -> FloatArray:
        """(K, w, nv) rows of a sensitivity (ny, nv), kept for the next call with the same one."""
        if self._sensitivity is not sensitivity:
            self._sensitivity, self._rows = sensitivity, sensitivity[self.at]
        return self._rows

    def planes(self, y: FloatArray) -> Planes:
        """Linearise about y."""
        if not len(self.node):
            none, d = np.zeros(0), self.at.shape[1] - 1
            return Planes(y, none, np.zeros((0, d + 1)), HalfSpaces.none(0, 1, d))
        path = self._step.path(y[self._p])
        positions, s = path[self.node + 1][:, None], y[self.at[:, -1]]
        spaces = self._step.problem.no_go.linearise(
            self._sets, positions, s, path[self.node] - self._means_before
        )
        a = np.concatenate([spaces.normal[:, 0], spaces.slope], axis=1)
        return Planes(y, spaces.value[:, 0], a, spaces)

    def about(self, ys: FloatArray) -> list[Planes]:
        """Linearise about several points (c, ny) at once."""
        count, K, d = len(ys), len(self.node), self._step.problem.model.dim
        paths = np.stack([self._step.path(y[self._p]) for y in ys])
        tiled = self._sets.taken(np.tile(np.arange(K), count))
        before = paths[:, self.node] - self._means_before
        s = ys[:, self.at[:, -1]]
        spaces = self._step.problem.no_go.linearise(
            tiled, paths[:, self.node + 1].reshape(-1, 1, d), s.ravel(), before.reshape(-1, d)
        )
        a = np.concatenate([spaces.normal[:, 0], spaces.slope], axis=1).reshape(count, K, d + 1)
        g = spaces.value.reshape(count, K)
        return [Planes(y, values, rows, spaces) for y, values, rows in zip(ys, g, a, strict=True)]

    def curvature_factor(self, planes: Planes) -> FloatArray:
        """Factor L (K, w, d-1) of the second derivatives at the planes' point."""
        s = planes.y[self.at[:, -1]]
        return self._step.problem.no_go.curvature_factor(self._sets, s, planes.spaces)[:, 0]

    def table(self, values: FloatArray) -> FloatArray:
        """Values (K,) of the pairs as (J, C); zero elsewhere."""
        table = np.zeros(self.near.shape, dtype=values.dtype)
        table[self.obstacle, self.node] = values
        return table
