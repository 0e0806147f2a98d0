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

from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import FloatArray, IntArray
from scp_mpc.settings import Settings
from scp_mpc.solver.active_set import CondensedProgram, Held
from scp_mpc.solver.certificate import Point
from scp_mpc.solver.condensed_step import CondensedStep
from scp_mpc.solver.conflicts import Conflicts, Tangent
from scp_mpc.solver.curvature import summed
from scp_mpc.solver.descent import Descent, hopeless
from scp_mpc.solver.iterate import NEGLIGIBLE
from scp_mpc.solver.sides import Passing, same_way

_STRIDE = 4.0  # steps to look ahead where they lead away; its powers if they still do
_ALIKE = 0.01  # relative difference of cost of plans that may become the same
_SURPLUS = 0.01  # of the tolerance: worth one more iteration, whose convergence is quadratic
_ROUNDING = 1e-9  # violation of a linearised constraint that is none


@dataclass(frozen=True, eq=False)
class End:
    """Where the descent about some pairs ended.

    Attributes:
        point: The plan, with its residuals.
        active: (nf + K,) its active set.
        cap: Largest force on a pair: finite where they may yield.
        iterations: Convex programs solved.
    """

    point: Point
    active: IntArray
    cap: float
    iterations: int


class Newton:
    """Descends about some pairs of obstacle and point in one control step.

    Args:
        step: The control step.
        conflicts: The pairs.
        settings: How to solve.
        goal: Give up when it is plain that this plan will not be reached; None to go on.
    """

    def __init__(
        self,
        step: CondensedStep,
        conflicts: Conflicts,
        settings: Settings,
        goal: Descent | None = None,
    ) -> None:
        """Begin without slack: no pair may yield."""
        self._step, self._conflicts, self._goal = step, conflicts, goal
        self._tolerance = settings.tolerance
        self._cap = np.inf

    def descend(
        self, y: FloatArray, active: IntArray, limit: int, began: float = 0.0
    ) -> End | None:
        """Descend from y (ny,), for at most `limit` programs; None if given up or unsolved.

        `began` is when the step's clock showed the work for the first one to begin.
        """
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
            if residual <= _SURPLUS * self._tolerance or max(residual, before) <= self._tolerance:
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
        """Solve the convex program, with slack only if nobody found a plan without."""
        with self._step.watch.solving:
            program = self._step.convex(self._conflicts, tangent)
            held = self._step.solve(program, active, self._cap)
            firm = self._goal is not None and self._goal.status.ok  # slack would not beat it
            firm = firm or self._step.watch.remaining < 0  # it was the time that ran out
            if held is None and not firm and np.isinf(self._cap):
                self._cap = self._step.problem.slack_weight
                held = self._step.solve(program, active, self._cap)
        return None if held is None else (program, held)

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
        bends = np.einsum("kwm,kwn->kmn", L, conflicts.response[pairs])
        reached = self._step.y(held.v)
        moved = reached - tangent.y
        turned = np.einsum("kwm,kw->km", L, moved[conflicts.at[pairs]])
        whole = summed(held, bends.reshape(-1, bends.shape[-1]), turned.ravel())
        if whole is None:
            reached += _STRIDE ** (leaps + 1) * moved
        elif self._step.consistent(program, whole, _ROUNDING):
            return whole
        else:
            reached = self._step.y(whole.v)
        c = self._step.condensed
        return np.minimum(np.maximum(reached, c.lower), c.upper)

    def _vain(self, iteration: int, point: Point, goal: Descent) -> bool:
        """Whether a descent is too far above the goal, or about to end just there."""
        if hopeless(iteration, point.cost, goal):
            return True
        if abs(point.cost - goal.cost) > _ALIKE * goal.cost or point.pushed is None:
            return False
        count = self._step.data.count
        sampling, other = self._step.data.sampling, goal.iterate
        pushes = self._conflicts.table(point.pushed.force > NEGLIGIBLE, count, sampling.points)
        mine = Passing(self._step.path(point.y)[1:], pushes)
        theirs = sampling.positions(other.states, other.inputs)
        return same_way(self._step.data, mine, Passing(theirs, other.touched[:count]))

    def _merit(self, point: Point) -> float:
        return point.cost + self._step.problem.slack_weight * point.slack
