"""Model predictive control: the solver with a memory of its last plan and of the obstacles.

what is known of the obstacles now: reports brought up to the present, vanished ones kept
the most dangerous of them, where there are more than slots
nominal = previous plan, shifted
plan = SCP (or braking, where a report is too old)
backup = the plan, then braking to rest beyond its horizon; the last one, where this has none
u0 within its bounds and a rate's reach, checked last; only then is anything remembered
"""

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from threading import Lock
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray, as_array, frozen
from scp_mpc.control.backup import Backup
from scp_mpc.control.obstacle_memory import ObstacleMemory, Recall
from scp_mpc.control.selection import most_dangerous
from scp_mpc.deadline import Clock, Timer
from scp_mpc.errors import ConcurrentUseError, TooManyObstaclesError
from scp_mpc.obstacles.prediction import ObstaclePrediction, require_fitting
from scp_mpc.problem import ROUNDING, Problem
from scp_mpc.scp.braking import stands
from scp_mpc.scp.iterate import Iterate
from scp_mpc.scp.plan import Plan, Status
from scp_mpc.scp.solver import SCP
from scp_mpc.scp.step import Step
from scp_mpc.settings import Settings

if TYPE_CHECKING:
    from scp_mpc.scp.native import NativeEngine

_log = logging.getLogger(__name__)

_AFRESH = 10  # steps of standing where it is not to be, after which a plan is sought afresh
_BETTER = 0.999  # of the cost of standing: less than that is better


class MPC:
    """Receding-horizon controller: each step starts from the last plan, shifted by one stage.

    Args:
        problem: What to solve at each step.
        settings: How to solve it.
        timer: Tells the time [s] to deadlines; None for the machine's clock.

    Attributes:
        overruns: Steps whose plan took longer than the deadline, since `reset`.
        replayed: Steps in a row, up to now, that live on an old plan or brake for want of time.
    """

    def __init__(
        self, problem: Problem, settings: Settings | None = None, timer: Timer | None = None
    ) -> None:
        """Set up the solver; there is no plan yet."""
        self._solver = SCP(problem, settings, timer, problem.model.dt)
        self._deadline = self.settings.time_limit(self.problem.model.dt)
        self._memory = ObstacleMemory(self.settings.staleness, problem.model.dt)
        self._backups = Backup(self.problem, self.settings.tolerance)
        self._busy = Lock()
        self._counts: Counter[Status] = Counter()
        self._forget()

    def __getstate__(self) -> dict[str, object]:
        """All but the lock: a copy goes on from the same plan."""
        return {name: value for name, value in self.__dict__.items() if name != "_busy"}

    def __setstate__(self, state: dict[str, object]) -> None:
        """Make a lock of its own."""
        self.__dict__.update(state, _busy=Lock())

    def _forget(self) -> None:
        self._last: Iterate | None = None
        self._made: Plan | None = None  # by the native core
        self._applied: FloatArray | None = None
        self._backup: FloatArray | None = None
        self._steps_touching = self._steps_standing = 0
        self._obstacles: Sequence[ObstaclePrediction] = ()
        self._counts.clear()
        self.overruns = self.replayed = self._left_out = 0
        self._memory.reset()
        if self._solver.native is not None:
            self._solver.native.core.reset()

    @property
    def problem(self) -> Problem:
        """The problem solved at each step."""
        return self._solver.problem

    @property
    def settings(self) -> Settings:
        """The solver's settings."""
        return self._solver.settings

    @property
    def counts(self) -> Counter[Status]:
        """How many steps ended in which status, since `reset`."""
        return self._counts.copy()

    @property
    def obstacles(self) -> tuple[ObstaclePrediction, ...]:
        """What the last plan was made with: the predictions given, as of then, then those kept.

        `plan.s` and `plan.slack` are in this order.
        """
        return tuple(self._obstacles)

    def nominal(self) -> Iterate | None:
        """The guess from which the next step starts; None before the first step."""
        if self._made is not None:
            return self._made.iterate.shifted(self.problem.model)
        return None if self._last is None else self._shifted()

    def step(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction] = (),
        *,
        time: float | None = None,
        robot_covariance: ArrayLike | None = None,
        u_last: ArrayLike | None = None,
    ) -> Plan:
        """Return the plan for this control step; apply `plan.u0`.

        Args:
            x0: (nx,) state now.
            x_ref: (N+1, nx) reference, or (nx,) to be held; row 0 is not weighted.
            obstacles: Predictions over the same horizon. What happens to late ones, and to named
                ones that are no longer given, is said by `settings.staleness`. Of more than
                `max_obstacles` the nearest to the last plan and its backup count, and
                `plan.left_out` says how many did not.
            time: Now [s], on the clock of the predictions' stamps; None for one interval after the
                last step that returned a plan, or 0 at the first. Where stamps are not of such a
                clock, or steps before had a time, a missing one is refused.
            robot_covariance: (d, d) or (N+1, d, d) of the robot's own position [m^2].
            u_last: (nu,) input last applied, from which the first rate counts. None for `u0` of the
                last plan that this controller returned; at the first step, and at the first after
                `reset`, for unknown: then the first input has no rate.

        Raises:
            InvalidArgumentError: Or one of its subclasses. The controller is then as before.
            ConcurrentUseError: Another thread is using this controller.
        """
        native = self._solver.native
        if native is not None:
            return self._native_step(
                *(native, perf_counter(), x0, x_ref, obstacles, time, robot_covariance, u_last)
            )
        clock = self._solver.timed(self._deadline)
        self._enter()
        try:
            recall = self._memory.recall(time, obstacles)
            last = self._last_input(u_last)
            known = len(recall.obstacles)
            if known > self.problem.max_obstacles:
                recall = recall._replace(obstacles=self._chosen(x0, x_ref, recall.obstacles, last))
            plan = self._plan(x0, x_ref, recall, robot_covariance, clock, last)
            backup = None
            ahead = bool(recall.obstacles) or self._backups.always
            if recall.stale is None and ahead and clock.allows("backup"):
                with clock.task("backup"):
                    given = x0, x_ref, recall.obstacles, robot_covariance, last
                    plan, backup = self._backed(plan, *given)
                plan = replace(plan, timing=replace(plan.timing, total=clock.elapsed()))
            sound = self._within(plan, last)
            if not sound:
                plan = self._bounded(plan, x0, x_ref, last)
            left_out = max(known - self.problem.max_obstacles, 0)
            if left_out:
                plan = replace(plan, left_out=left_out)
            self._tell(left_out)
            self._memory.commit(recall)
            self._keep(plan, recall, plan.iterate if sound else None)
            self._backup = backup if sound else None
            return plan
        finally:
            self._busy.release()

    def reset(self) -> None:
        """Forget all steps: the next one is bit for bit that of a new controller.

        Raises:
            ConcurrentUseError: Another thread is using this controller.
        """
        self._enter()
        try:
            self._forget()
        finally:
            self._busy.release()

    def _enter(self) -> None:
        if not self._busy.acquire(blocking=False):
            raise ConcurrentUseError(
                "this controller is at work in another thread; give each its own"
            )

    def _chosen(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        last: FloatArray | None,
    ) -> tuple[ObstaclePrediction, ...]:
        """As many as there are slots for: nearest to the nominal plan and to the last backup."""
        problem = self.problem
        if not problem.max_obstacles:
            raise TooManyObstaclesError("obstacles", f"{len(obstacles)} exceed max_obstacles = 0")
        require_fitting(obstacles, problem.horizon, problem.model.dim, problem.model.dt)
        step, nominal = Step.read(problem, x0, x_ref, (), u_last=last), self.nominal()
        ahead = step.x_ref if nominal is None else nominal.states + (step.x0 - nominal.states[0])
        native, inputs = self._solver.native, self._backup
        if native is not None:
            inputs = native.core.backup()
        backup = self._backups.path(step.x0, inputs, last)
        paths = np.stack([ahead, backup])[..., problem.model.position]
        return most_dangerous(obstacles, paths, problem.max_obstacles)

    def _last_input(self, u_last: ArrayLike | None) -> FloatArray | None:
        """The input (nu,) from which the first rate counts; None for unknown, or none that does."""
        if u_last is not None:
            return as_array("u_last", u_last, (self.problem.model.nu,))
        return self._applied if self.problem.limits_rates else None

    def _tell(self, left_out: int) -> None:
        """Say once that some of the known obstacles are left out."""
        if left_out and not self._left_out:
            slots = self.problem.max_obstacles
            _log.warning(
                "%d obstacles, but max_obstacles = %d: the nearest to the plan are kept",
                *(left_out + slots, slots),
            )
        self._left_out = left_out

    def _native_step(
        self,
        native: "NativeEngine",
        began: float,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        time: float | None,
        robot_covariance: ArrayLike | None,
        u_last: ArrayLike | None,
    ) -> Plan:
        """`step` with the native core, which remembers by itself what is remembered here."""
        self._enter()
        try:
            recall = self._memory.recall(time, obstacles)
            left_out = max(len(recall.obstacles) - self.problem.max_obstacles, 0)
            if left_out:
                last = self._last_input(u_last)
                recall = recall._replace(obstacles=self._chosen(x0, x_ref, recall.obstacles, last))
            if recall.stale is None:
                given = x0, x_ref, recall.obstacles, robot_covariance, u_last
                plan = native.step(began, *given, left_out)
            else:
                self._require_brakeable(x0, x_ref, recall, robot_covariance)
                plan = native.brake(began, x0, x_ref, u_last, left_out)
            self._tell(left_out)
            self._memory.commit(recall)
            self._made, self._applied, self._obstacles = plan, plan.u0, recall.obstacles
            self._counts[plan.status] += 1
            self.replayed = native.core.outputs.replayed
            if self._deadline is not None and plan.timing.total > self._deadline:
                self.overruns += 1
            return plan
        finally:
            self._busy.release()

    def _plan(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        recall: Recall,
        robot_covariance: ArrayLike | None,
        clock: Clock,
        last: FloatArray | None,
    ) -> Plan:
        if recall.stale is None:
            due = self._steps_touching % self.settings.multi_start_interval == 0
            given, rest = (x0, x_ref, recall.obstacles), (robot_covariance, clock, last)
            late = self.replayed >= self.settings.max_replayed
            plan = self._solver.solve_from(*given, self.nominal(), due, *rest, brake_first=late)
            if self._is_stuck(plan) and clock.allows("iteration"):
                other = self._solver.solve_from(*given, None, True, *rest)
                if other.ok and (not plan.ok or other.cost < _BETTER * plan.cost):
                    return other
            return plan
        self._require_brakeable(x0, x_ref, recall, robot_covariance)
        return self._solver.brake(x0, x_ref, Status.STALE, last)

    def _require_brakeable(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        recall: Recall,
        robot_covariance: ArrayLike | None,
    ) -> None:
        """Where predictions are too old: raise, or say that the robot brakes."""
        if recall.stale is not None and self.settings.staleness.beyond == "refuse":
            raise recall.stale
        # Bad arguments are refused before the robot brakes.
        Step.read(self.problem, x0, x_ref, recall.obstacles, robot_covariance)
        _log.warning("%s: braking", recall.stale)

    def _backed(
        self,
        plan: Plan,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        robot_covariance: ArrayLike | None,
        last: FloatArray | None,
    ) -> tuple[Plan, FloatArray | None]:
        """A plan and its backup; or that of an earlier plan, where it is clear and this is not."""
        backup = self._backups.of(plan.X, plan.U, obstacles) if plan.status.ok else None
        if backup is not None or self._backup is None:
            return plan, backup
        inputs = self._backups.continued(plan.X[0], self._backup, last, obstacles)
        if inputs is None:
            return plan, None
        other = self._solver.follow(x0, x_ref, obstacles, inputs, robot_covariance, last)
        if not other.status.ok:
            return plan, None
        free = plan.iterate.obstacle_free or plan.iterate
        other = replace(other, iterate=replace(other.iterate, obstacle_free=free))
        return replace(other, qps=plan.qps, timing=plan.timing), self._backup[1:]

    def _is_stuck(self, plan: Plan) -> bool:
        """Whether to look for a plan from nothing: the last one may be a bad optimum to stand in.

        After so many steps of standing, and after twice as many each time.
        """
        times, rest = divmod(self._steps_standing, _AFRESH)
        return times > 0 and not rest and times & (times - 1) == 0 and self._stands(plan)

    def _stands(self, plan: Plan) -> bool:
        return stands(self.problem, plan.X, plan.step.x_ref)

    def _within(self, plan: Plan, last: FloatArray | None) -> bool:
        lower, upper = self.problem.u_min, self.problem.u_max
        within = (lower <= plan.u0) & (plan.u0 <= upper)  # False for NaN
        if self.problem.limits_rates:
            lower, upper = self.problem.reach(last)
            within &= (lower - ROUNDING <= plan.u0) & (plan.u0 <= upper + ROUNDING)
        return bool(within.all())

    def _bounded(
        self, plan: Plan, x0: ArrayLike, x_ref: ArrayLike, last: FloatArray | None
    ) -> Plan:
        """The last guard: brake instead of an input that must not be applied."""
        lower, upper = self.problem.u_min, self.problem.u_max
        _log.error("input %s is outside [%s, %s] or its rates: braking", plan.u0, lower, upper)
        plan = self._solver.brake(x0, x_ref, Status.FALLBACK, last)
        return replace(plan, U=frozen(self.problem.limited(np.nan_to_num(plan.U), last)))

    def _keep(self, plan: Plan, recall: Recall, start: Iterate | None) -> None:
        self._last, self._applied = start, plan.u0
        self._obstacles = recall.obstacles
        self._steps_touching = self._steps_touching + 1 if plan.iterate.touches else 0
        standing = plan.iterate.touches and self._stands(plan)
        self._steps_standing = self._steps_standing + 1 if standing else 0
        self._counts[plan.status] += 1
        old = plan.status in (Status.PREVIOUS, Status.BRAKING)
        self.replayed = self.replayed + 1 if old else 0
        if self._deadline is not None and plan.timing.total > self._deadline:
            self.overruns += 1

    def _shifted(self) -> Iterate:
        assert self._last is not None
        return self._last.shifted(self.problem.model)
