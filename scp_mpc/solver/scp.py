"""Sequential convex programming for the problem of `scp_mpc.problem`.

    free plan, which ignores the obstacles: if it is clear of them, nothing can be better
    nominal = previous plan, shifted (or the free plan)
    descend:  half-spaces about the nominal -> quadratic program -> new nominal, until the KKT
              residual of the original problem is below the tolerance
    sides:    where an obstacle shapes the plan, the same from paths on its other sides;
              the best plan wins, if by enough

Descents run on the condensed problem (`condensed_scp.py`). Where that has no answer, or the
settings say so, they run on the sparse one (`sparse_scp.py`).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from threading import Lock

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import BoolArray
from scp_mpc.errors import ConcurrentUseError, InvalidArgumentError
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.settings import Settings
from scp_mpc.solver.condensed_scp import CondensedSCP
from scp_mpc.solver.descent import Descent
from scp_mpc.solver.guess import as_iterate
from scp_mpc.solver.iterate import Iterate
from scp_mpc.solver.plan import Candidate, Plan, Status, Timing
from scp_mpc.solver.sides import Passing, candidates, same_way
from scp_mpc.solver.sparse_scp import SparseSCP
from scp_mpc.solver.step_data import StepData
from scp_mpc.solver.stopwatch import Stopwatch
from scp_mpc.trajectory import Trajectory

# A rival must be better by this share, or the plan flickers between sides of equal cost.
_HYSTERESIS = 0.001
_SHARE = 0.5  # of the deadline, after which no other side is tried


class SCP:
    """Solves one control step at a time, without memory of the last plan.

    Args:
        problem: What to solve.
        settings: How to solve it.
    """

    def __init__(self, problem: Problem, settings: Settings | None = None) -> None:
        """Condense the problem, lay out the sparse one and set up the solvers."""
        self.problem = problem
        self.settings = Settings() if settings is None else settings
        if not isinstance(self.settings, Settings):
            raise InvalidArgumentError("settings", f"{settings!r} is not a Settings")
        self._busy = Lock()
        self._sparse = SparseSCP(problem, self.settings)
        self._condensed = (
            CondensedSCP.of(problem, self.settings) if self.settings.condense else None
        )
        self._engine: CondensedSCP | SparseSCP = self._condensed or self._sparse

    def solve(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction] = (),
        guess: Trajectory | Iterate | None = None,
        challenge: bool = True,
    ) -> Plan:
        """Plan from the state x0 along the reference and around the obstacles.

        Args:
            x0: (nx,) state now.
            x_ref: (N+1, nx) reference, or (nx,) to be held; row 0 is not weighted.
            obstacles: At most `max_obstacles` predictions over the same horizon.
            guess: Where to linearise first; None for the plan that ignores the obstacles.
            challenge: Try the other sides even if this one works, unless `settings.sides` is off.

        Raises:
            InvalidArgumentError: Or one of its subclasses, before anything is changed.
            ConcurrentUseError: Another thread is using this solver.
        """
        nominal = None if guess is None else as_iterate(guess, self.problem)
        return self.solve_from(
            x0, x_ref, obstacles, None if nominal is None else lambda: nominal, challenge
        )

    def solve_from(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        nominal: Callable[[], Iterate] | None,
        challenge: bool,
    ) -> Plan:
        """`solve`, with a nominal plan that is made only where it is needed."""
        if not self._busy.acquire(blocking=False):
            raise ConcurrentUseError("this solver is at work in another thread; give each its own")
        try:
            return self._solve(x0, x_ref, obstacles, nominal, challenge)
        finally:
            self._busy.release()

    def forget(self) -> None:
        """Forget what earlier programs left behind: the next step is that of a new solver."""
        self._sparse.forget()

    def _solve(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        nominal: Callable[[], Iterate] | None,
        challenge: bool,
    ) -> Plan:
        watch = Stopwatch(self.settings.deadline)
        step = StepData.read(self.problem, x0, x_ref, obstacles)
        if nominal is None:
            self.forget()
        self._engine.begin(step, watch)
        tried: tuple[Candidate, ...] = ()
        switched = False
        best = self._engine.unhindered()
        if best is None:
            start = self._engine.free() if nominal is None else nominal()
            best = self._descend(step, watch, start)
            wanted = not best.status.ok or (challenge and best.iterate.touches)
            if self.settings.sides and wanted and not watch.overdue(_SHARE):
                best, tried, switched = self._challenge(step, best)
        return self._plan(step, best, tried, switched, watch)

    def _descend(self, step: StepData, watch: Stopwatch, nominal: Iterate) -> Descent:
        """Descend on the condensed problem; on the sparse one where that has no answer."""
        limit = self.settings.max_iterations
        if self._condensed is None:
            return self._sparse.descend(nominal, limit)
        best = self._condensed.descend(nominal, limit)
        if best is not None and (best.status is not Status.VIOLATING or watch.overdue()):
            return best
        self._sparse.begin(step, watch)
        other = self._sparse.descend(nominal, limit)
        return other if best is None or other.beats(best, lead=0.0) else best

    def _challenge(
        self, step: StepData, best: Descent
    ) -> tuple[Descent, tuple[Candidate, ...], bool]:
        """Rank the ways past the obstacles by one program each; descend from the best of them."""
        full = np.full(self.problem.max_obstacles, self.problem.margin.reference)
        here = self._passing(best.iterate, best.iterate.touched[: step.count])
        sides = candidates(step, self._engine.free_path(), here.path, full)
        present = replace(best.iterate, s=full)
        safe = best.status.ok
        starts = self._engine.glimpses(present, [side.path for side in sides], firm=safe)
        tried = tuple(
            Candidate(side.obstacle, side.normal, side.time, start.merit)
            for side, start in zip(sides, starts, strict=False)  # none if they are too many
        )
        goal, switched = best, False
        ranked = sorted(starts, key=lambda start: start.merit)  # ties keep their order
        # A plan with slack is followed by any without: then all ways are worth their time.
        for start in ranked[: self.settings.rivals] if safe else ranked:
            if not safe and goal.status.ok:
                break
            if safe and same_way(step, self._passing(start.iterate, start.touched), here):
                continue  # this way leads to where we are
            rival = self._engine.descend(start.iterate, self.settings.max_iterations, goal)
            if rival is not None and rival.beats(goal, _HYSTERESIS * goal.merit):
                goal, switched = rival, True
        return goal, tried, switched

    def _passing(self, iterate: Iterate, touched: BoolArray) -> Passing:
        return Passing(iterate.states[1:, self.problem.model.position], touched)

    def _plan(
        self,
        step: StepData,
        best: Descent,
        tried: tuple[Candidate, ...],
        switched: bool,
        watch: Stopwatch,
    ) -> Plan:
        iterate, inside = best.iterate, watch.inside.seconds
        timing = Timing(
            linearise=watch.linearising.seconds,
            update=watch.solving.seconds - inside,
            solve=inside,
            total=watch.elapsed,
        )
        qps = self._engine.finished
        if self._condensed is not None and self._sparse.watch is watch:
            qps = qps + self._sparse.finished
        return Plan(
            X=iterate.states,
            U=iterate.inputs,
            s=iterate.s[: step.count],
            slack=iterate.slack[: step.count],
            cost=best.cost,
            status=best.status,
            kkt=best.residuals,
            iterations=best.iterations,
            qps=dict(qps),
            candidates=tried,
            switched=switched,
            timing=timing,
            iterate=iterate,
        )
