"""Sequential convex programming for the problem of `scp_mpc.problem`.

    free plan, which ignores the obstacles: if it is clear of them, nothing can be better
    nominal = previous plan, shifted (or the free plan)
    descend:  half-spaces about the nominal -> quadratic program -> new nominal, until the KKT
              residual of the original problem is below the tolerance, or the time is up
    sides:    where an obstacle shapes the plan, the same from paths on its other sides;
              the best plan wins, if by enough
    allocate: where a joint risk is promised, give it to those who need it, and descend again
    ladder:   without a plan that meets every constraint, the previous one, or braking

Where the robot is fast, constraints hold at points between the samples, too (`resolution.py`).
"""

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from threading import Lock

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import frozen
from scp_mpc.errors import ConcurrentUseError, InvalidArgumentError
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.settings import Settings
from scp_mpc.solver.allocate import allocate
from scp_mpc.solver.challenge import Challenge, Found
from scp_mpc.solver.commitment import plan_risk
from scp_mpc.solver.engine import Engine
from scp_mpc.solver.guess import as_iterate
from scp_mpc.solver.iterate import Iterate
from scp_mpc.solver.ladder import Ladder
from scp_mpc.solver.plan import Plan, Status, Timing
from scp_mpc.solver.resolution import Resolution, exposed
from scp_mpc.solver.step_data import StepData
from scp_mpc.solver.stopwatch import Pace, Stopwatch
from scp_mpc.trajectory import Trajectory

_log = logging.getLogger(__name__)

_CORRECTIONS = 4  # of what was assumed about the motion between points
_WARM_UP = 3  # steps


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
        self._busy, self._pace = Lock(), Pace()
        self._resolution = Resolution(problem, self.settings)
        self._challenge = Challenge(problem, self.settings)
        self._ladder = Ladder(problem, self.settings.tolerance)
        if self.settings.deadline is not None:
            self._warm_up()

    def solve(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction] = (),
        guess: Trajectory | Iterate | None = None,
        challenge: bool = True,
        robot_covariance: ArrayLike | None = None,
        u_last: ArrayLike | None = None,
    ) -> Plan:
        """Plan from the state x0 along the reference and around the obstacles.

        Args:
            x0: (nx,) state now.
            x_ref: (N+1, nx) reference, or (nx,) to be held; row 0 is not weighted.
            obstacles: At most `max_obstacles` predictions over the same horizon.
            guess: Where to linearise first; None for the plan that ignores the obstacles.
            challenge: Try the other sides even if this one works, unless `settings.multi_start` is
                off.
            robot_covariance: (d, d) or (N+1, d, d) of the robot's own position [m^2]; adds to the
                obstacles'.
            u_last: (nu,) input last applied, from which the first rate counts. None for unknown:
                then the first input has no rate.

        Raises:
            InvalidArgumentError: Or one of its subclasses, before anything is changed.
            ConcurrentUseError: Another thread is using this solver.
        """
        nominal = None if guess is None else as_iterate(guess, self.problem)
        shifted = None if nominal is None else lambda: nominal
        return self.solve_from(
            x0, x_ref, obstacles, shifted, challenge, robot_covariance, u_last=u_last
        )

    def solve_from(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        nominal: Callable[[], Iterate] | None,
        challenge: bool,
        robot_covariance: ArrayLike | None = None,
        watch: Stopwatch | None = None,
        u_last: ArrayLike | None = None,
    ) -> Plan:
        """`solve`, with a nominal plan made only where it is needed, and a clock that may run."""
        if not self._busy.acquire(blocking=False):
            raise ConcurrentUseError("this solver is at work in another thread; give each its own")
        try:
            watch = self.stopwatch() if watch is None else watch
            sampling = self._resolution.coarse.sampling
            step = StepData.read(
                self.problem, x0, x_ref, obstacles, robot_covariance, sampling, u_last
            )
            try:
                return self._solve(step, watch, nominal, challenge)
            except (ArithmeticError, np.linalg.LinAlgError):
                _log.exception("a computation broke down: the last plan, or braking")
                self.forget()
                found = Found(self._ladder.resort(step, nominal() if nominal else None))
                return self._plan(step, found, watch, {})
        finally:
            self._busy.release()

    def brake(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        status: Status = Status.BRAKING,
        u_last: ArrayLike | None = None,
    ) -> Plan:
        """Bring the robot to rest at the model's limits, whatever is in the way."""
        watch = Stopwatch()
        step = StepData.read(self.problem, x0, x_ref, (), u_last=u_last)
        found = Found(self._ladder.brake(step, status))
        return self._plan(step, found, watch, {})

    def stopwatch(self) -> Stopwatch:
        """The clock of a step that begins now."""
        return Stopwatch(self.settings.deadline, self._pace)

    def forget(self) -> None:
        """Forget what earlier programs left behind: the next step is that of a new solver."""
        self._resolution.forget()

    def _warm_up(self) -> None:
        """Solve some steps with everybody in the way: first calls are slow, and paces unknown."""
        problem, model = self.problem, self.problem.model
        M, rows = problem.max_obstacles, problem.horizon + 1
        fast, slow = np.zeros((2, rows, model.nx))
        fast[:, model.position[0]] = np.linspace(0.0, 4.0 * problem.robot_radius * rows, rows)
        slow[:, model.position[0]] = np.linspace(0.0, 4.0, rows)
        for way in (fast, slow) * _WARM_UP:
            means = np.zeros((M, rows, model.dim))
            means[..., 0] = np.linspace(0.3, 0.9, M)[:, None] * way[-1, model.position[0]]
            means[..., 1] = 0.1 * (-1.0) ** np.arange(M)[:, None]
            self.solve(
                way[0], way, [ObstaclePrediction(m, 0.01 * np.eye(model.dim), 0.1) for m in means]
            )

    def _solve(
        self,
        step: StepData,
        watch: Stopwatch,
        nominal: Callable[[], Iterate] | None,
        challenge: bool,
    ) -> Plan:
        if nominal is None:
            self.forget()
        last = None
        if nominal is not None and self._resolution.wants_nominal:
            last = nominal()
        engine, step, free = self._resolution.begin(step, watch, last)
        if free is None:
            last = nominal() if last is None and nominal is not None else last
            engine, step, free = self._resolution.refined(step, watch, last)
        if free is not None:
            return self._plan(step, Found(free), watch, self._resolution.finished(engine))
        start = engine.free() if last is None else last
        for _ in range(_CORRECTIONS):
            start = start.resampled(engine.sampling.count)
            sweep = self._resolution.assumed(engine, step, start)
            wide = self._resolution.widened(engine, step, sweep)
            found = Found(engine.descend(start) or self._ladder.resort(wide, last))
            if self._challenge.wanted(found.best, challenge):
                found = self._challenge.run(engine, wide, watch, found.best, last is None)
            found = replace(found, best=allocate(engine, wide, watch, found.best))
            ending = watch.elapsed
            found = self._rescue(engine, wide, last, found)
            if self._resolution.kept(engine, step, sweep, found.best):
                break
            start = found.best.iterate
            engine, step = self._resolution.finer(engine, step, watch)
        else:
            found = replace(found, best=exposed(engine, step, found.best))
        plan = self._plan(wide, found, watch, self._resolution.finished(engine))
        watch.learn("ending", ending)
        return plan

    def _rescue(self, engine: Engine, step: StepData, last: Iterate | None, found: Found) -> Found:
        """Without a plan that meets every constraint: descend from one that does, if known."""
        if found.best.status.ok or found.best.status is Status.FALLBACK:
            return found
        known = self._ladder.resort(step, last)
        if not known.status.ok:
            return replace(found, best=self._ladder.lesser(found.best, known))
        better = engine.descend(known.iterate)
        return replace(found, best=better if better and better.status.ok else known)

    def _plan(self, step: StepData, found: Found, watch: Stopwatch, qps: Mapping[str, int]) -> Plan:
        best, inside = found.best, watch.inside.seconds
        iterate = best.iterate
        slack = iterate.slack[: step.count]
        if step.sampling.count > 1:
            slack = frozen(step.sampling.stages(slack).max(axis=2, initial=0.0))
        return Plan(
            X=iterate.states,
            U=iterate.inputs,
            s=iterate.s[: step.count],
            slack=slack,
            x_slack=frozen(self.problem.excess(iterate.states)),
            cost=best.cost,
            status=best.status,
            kkt=best.residuals,
            iterations=best.iterations,
            qps=dict(qps),
            candidates=found.tried,
            switched=found.switched,
            timing=Timing(
                linearise=watch.linearising.seconds,
                update=watch.solving.seconds - inside,
                solve=inside,
                total=watch.elapsed,
            ),
            iterate=iterate,
            commitment=partial(plan_risk, step, iterate),
        )
