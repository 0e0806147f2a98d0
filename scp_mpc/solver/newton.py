"""The descent on the condensed problem: convex steps, summed up where they tend somewhere.

    repeat:  half-spaces about y -> convex program, from the last active set
             -> the sum of the convex steps to come: Newton's step (curvature.py)
             -> KKT residual of the original problem
    until    that residual is below the tolerance, or the iterations run out

Two cases have no such sum. Where it would break a constraint, the active set is about to change,
and its end is only where to linearise next. Where the convex steps lead away from here, for they
grow from one to the next, the next linearisation is about a point several steps ahead, and farther
each time. Half-spaces are sound about any point; a leap that costs more is taken back.
"""

import numpy as np

from scp_mpc.arrays import FloatArray, IntArray
from scp_mpc.solver.active_set import CondensedProgram, Held
from scp_mpc.solver.certificate import Point
from scp_mpc.solver.conflicts import Conflicts, Tangent
from scp_mpc.solver.curvature import summed
from scp_mpc.solver.iterate import NEGLIGIBLE
from scp_mpc.solver.search import ROUNDING, SURPLUS, End, Search

_STRIDE = 4.0  # steps to look ahead where they lead away; its powers if they still do


class Newton(Search):
    """Descends about some pairs of obstacle and point of a linear robot; see `Search`."""

    _conflicts: Conflicts

    def descend(
        self,
        y: FloatArray,
        active: IntArray,
        limit: int,
        began: float = 0.0,
        guess: FloatArray | None = None,  # noqa: ARG002
    ) -> End | None:
        """See the base class."""
        tangent, end, leaps, bold = self._conflicts.tangent(y), None, 0, True
        watch = self._step.watch
        for iteration in range(1, limit + 1):
            task = self._step.condensed.sampling.first if iteration == 1 else "program"
            if iteration > 1:
                if not watch.affords(task):
                    break
                began = watch.elapsed
            solved = self._solve(tangent, active)
            if solved is None:
                watch.learn(task, began)  # it takes at least as long
                if watch.remaining < 0:
                    break
                return None
            program, held = solved
            ahead = self._ahead(tangent, program, held, leaps) if bold else None
            point = self._step.point(self._conflicts, ahead if isinstance(ahead, Held) else held)
            watch.learn(task, began)
            if not np.isfinite(point.cost):
                return end
            if leaps and end is not None and self._merit(point) > self._merit(end.point):
                tangent, leaps, bold = end.point.tangent, 0, False  # take the leap back
                continue
            before = np.inf if end is None else end.point.residuals.worst
            end = End(point, held.active, self._cap, iteration)
            active, residual = held.active, point.residuals.worst
            if residual <= SURPLUS * self._tolerance or max(residual, before) <= self._tolerance:
                break
            if self._goal is not None and self._vain(iteration, point, self._goal):
                return None
            if isinstance(ahead, np.ndarray):
                tangent, leaps, bold = self._conflicts.tangent(ahead), leaps + 1, True
            else:
                bold = ahead is None or residual < before / 2
                tangent, leaps = point.tangent, 0
        return end

    def _solve(self, tangent: Tangent, active: IntArray) -> tuple[CondensedProgram, Held] | None:
        """Solve the convex program about a tangent."""
        with self._step.watch.solving:
            return self._solved(*self._step.convex(self._conflicts, tangent), active)

    def _ahead(
        self, tangent: Tangent, program: CondensedProgram, held: Held, leaps: int
    ) -> Held | FloatArray | None:
        """The sum of the convex steps to come; or only where to linearise next."""
        conflicts, bounds = self._conflicts, len(program.lower)
        pairs = (held.force[bounds:] > NEGLIGIBLE).nonzero()[0]
        if not len(pairs):
            return None
        root = np.sqrt(held.force[bounds + pairs])
        L = conflicts.bend(tangent)[pairs] * root[:, None, None]
        bends = np.einsum("kwm,kwn->kmn", L, conflicts.response(self._step.chart)[pairs])
        reached = self._step.chart.y(held.v)
        moved = reached - tangent.y
        turned = np.einsum("kwm,kw->km", L, moved[conflicts.at[pairs]])
        whole = summed(held, bends.reshape(-1, bends.shape[-1]), turned.ravel())
        if whole is None:
            reached += _STRIDE ** (leaps + 1) * moved
        elif self._step.consistent(program, whole, ROUNDING):
            return whole
        else:
            reached = self._step.chart.y(whole.v)
        lower, upper = self._step.bounds
        return np.minimum(np.maximum(reached, lower), upper)

    def _merit(self, point: Point) -> float:
        return self._step.merit(point.cost, point.slack, point.excess)
