"""The pairs of obstacle and point that can matter in one control step; all others stay out.

Notation:
    K           number of pairs (j, i); i counts points: samples, and those between them
    y           outputs of the condensed problem, see `condensed.py`
    g   (K,)    constraint function, to be non-negative [m]
    a   (K, w)  its gradient with respect to y[at]: position and size, w = d + 1
    L   (K, w, d-1)     factor of its second derivative, L L'
"""

from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import BoolArray, FloatArray
from scp_mpc.safety.halfspaces import HalfSpaces
from scp_mpc.safety.no_go import NoGoSets
from scp_mpc.solver.chart import Chart
from scp_mpc.solver.layout import Layout
from scp_mpc.solver.step_data import StepData


@dataclass(frozen=True, eq=False)
class Tangent:
    """The constraints of all pairs, linearised about one point.

    Attributes:
        y: (ny,) the point.
        g: (K,) values there.
        a: (K, w) gradients.
        spaces: The half-spaces.
    """

    y: FloatArray
    g: FloatArray
    a: FloatArray
    spaces: HalfSpaces


class Conflicts:
    """Geometry of some pairs of obstacle and point in one control step.

    Attributes:
        obstacle: (K,) j; likewise `point`, i, counted from 0.
        at: (K, w) where position and size stand in y.

    Args:
        step: The control step.
        layout: Where positions and sizes stand in y.
        near: (J, C) the pairs.
    """

    def __init__(self, step: StepData, layout: Layout, near: BoolArray) -> None:
        """Gather the pairs' predictions."""
        self.obstacle, self.point = j, i = np.nonzero(near)
        d = step.problem.model.dim
        self.at = np.empty((len(j), d + 1), dtype=np.intp)
        self.at[:, :d] = i[:, None] * d + np.arange(d)
        self.at[:, d] = layout.s.start + j
        self._step, self._p = step, layout.p
        self._chart: Chart | None = None
        covariances = step.covariances[j, i + 1]
        shapes = None if step.shapes is None else step.shapes.taken(j)
        self._sets = NoGoSets.pairs(step.means[j, i + 1], covariances, step.radii[j, i], shapes)
        self._means_before = step.means[j, i]

    def response(self, chart: Chart) -> FloatArray:
        """(K, w, nv) rows of the chart's response."""
        if self._chart is not chart:
            self._chart, self._response = chart, chart.response[self.at]
        return self._response

    def about(self, paths: FloatArray, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Linearise about several paths (c, C+1, d) at sizes s (M,) at once.

        Returns:
            Gradients a (c, K, w) and right-hand sides b (c, K) of a' (p, s) >= b, where p is the
            deviation from the track.
        """
        count, K = len(paths), len(self.point)
        tiled = self._sets.taken(np.tile(np.arange(K), count))
        positions = paths[:, self.point + 1]
        before = paths[:, self.point] - self._means_before
        d = positions.shape[-1]
        sizes = np.tile(s[self.obstacle], count)
        spaces = self._step.problem.no_go.linearise(
            tiled, positions.reshape(-1, 1, d), sizes, before.reshape(-1, d)
        )
        normal = spaces.normal.reshape(count, K, d)
        b = spaces.offset.reshape(count, K) - (normal * self._step.track[self.point + 1]).sum(
            axis=2
        )
        return np.concatenate([normal, spaces.slope.reshape(count, K, 1)], axis=2), b

    def tangent(self, y: FloatArray) -> Tangent:
        """Linearise about y."""
        path = self._step.path(y[self._p])
        positions, s = path[self.point + 1][:, None], y[self.at[:, -1]]
        spaces = self._step.problem.no_go.linearise(
            self._sets, positions, s, path[self.point] - self._means_before
        )
        a = np.concatenate([spaces.normal[:, 0], spaces.slope], axis=1)
        return Tangent(y, spaces.value[:, 0], a, spaces)

    def bend(self, tangent: Tangent) -> FloatArray:
        """Factor L (K, w, d-1) of the second derivatives at the tangent's point."""
        s = tangent.y[self.at[:, -1]]
        no_go = self._step.problem.no_go
        return no_go.bend(self._sets, s, tangent.spaces)[:, 0]

    def table(self, marked: BoolArray, slots: int, points: int) -> BoolArray:
        """Return which pairs are marked (K,) as (slots, points)."""
        table = np.zeros((slots, points), dtype=np.bool_)
        table[self.obstacle, self.point] = marked
        return table
