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
from dataclasses import dataclass, replace
from functools import partial
from threading import Lock

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import frozen
from scp_mpc.errors import ConcurrentUseError, InvalidArgumentError
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.safety.allocation import reallocated
from scp_mpc.safety.margin import JointRisk
from scp_mpc.safety.risk import size_at_risk
from scp_mpc.settings import Settings
from scp_mpc.solver.commitment import plan_risk, point_risks
from scp_mpc.solver.descent import Descent
from scp_mpc.solver.engine import Engine
from scp_mpc.solver.guess import as_iterate
from scp_mpc.solver.iterate import Iterate
from scp_mpc.solver.ladder import Ladder
from scp_mpc.solver.plan import Candidate, Plan, Status, Timing
from scp_mpc.solver.resolution import Resolution, exposed
from scp_mpc.solver.sides import MAX_CANDIDATES, Passing, candidates, same_way
from scp_mpc.solver.step_data import StepData
from scp_mpc.solver.stopwatch import Pace, Stopwatch
from scp_mpc.trajectory import Trajectory

_log = logging.getLogger(__name__)

# A rival must be better by this share, or the plan flickers between sides of equal cost.
_HYSTERESIS = 0.001
_CORRECTIONS = 4  # of what was assumed about the motion between points
_WARM_UP = 3  # steps
_ROUNDS = 6  # of risk allocation at most
_GAIN = 0.001  # share of the cost that makes another round worth while


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
    ) -> Plan:
        """Plan from the state x0 along the reference and around the obstacles.

        Args:
            x0: (nx,) state now.
            x_ref: (N+1, nx) reference, or (nx,) to be held; row 0 is not weighted.
            obstacles: At most `max_obstacles` predictions over the same horizon.
            guess: Where to linearise first; None for the plan that ignores the obstacles.
            challenge: Try the other sides even if this one works, unless `settings.sides` is off.
            robot_covariance: (d, d) or (N+1, d, d) of the robot's own position [m^2]; adds to the
                obstacles'.

        Raises:
            InvalidArgumentError: Or one of its subclasses, before anything is changed.
            ConcurrentUseError: Another thread is using this solver.
        """
        nominal = None if guess is None else as_iterate(guess, self.problem)
        shifted = None if nominal is None else lambda: nominal
        return self.solve_from(x0, x_ref, obstacles, shifted, challenge, robot_covariance)

    def solve_from(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        nominal: Callable[[], Iterate] | None,
        challenge: bool,
        robot_covariance: ArrayLike | None = None,
        watch: Stopwatch | None = None,
    ) -> Plan:
        """`solve`, with a nominal plan made only where it is needed, and a clock that may run."""
        if not self._busy.acquire(blocking=False):
            raise ConcurrentUseError("this solver is at work in another thread; give each its own")
        try:
            watch = self.stopwatch() if watch is None else watch
            sampling = self._resolution.coarse.sampling
            step = StepData.read(self.problem, x0, x_ref, obstacles, robot_covariance, sampling)
            try:
                return self._solve(step, watch, nominal, challenge)
            except (ArithmeticError, np.linalg.LinAlgError):
                _log.exception("a computation broke down: the last plan, or braking")
                found = _Found(self._ladder.resort(step, nominal() if nominal else None))
                return self._plan(step, found, watch, {})
        finally:
            self._busy.release()

    def brake(self, x0: ArrayLike, x_ref: ArrayLike, status: Status = Status.BRAKING) -> Plan:
        """Bring the robot to rest at the model's limits, whatever is in the way."""
        watch = Stopwatch()
        step = StepData.read(self.problem, x0, x_ref, ())
        found = _Found(self._ladder.brake(step, status))
        return self._plan(step, found, watch, {})

    def stopwatch(self) -> Stopwatch:
        """The clock of a step that begins now."""
        return Stopwatch(self.settings.deadline, self._pace)

    def forget(self) -> None:
        """Forget what earlier programs left behind: the next step is that of a new solver."""
        self._resolution.forget()

    def _warm_up(self) -> None:
        """Solve a step with an obstacle in the way: first calls are slow, and paces unknown."""
        problem, model = self.problem, self.problem.model
        way = np.zeros((problem.horizon + 1, model.nx))
        way[:, model.position[0]] = np.linspace(0.0, 4.0, len(way))
        means = np.full((len(way), model.dim), 0.1)
        means[:, 0] += 2.0
        block = ObstaclePrediction(means, 0.01 * np.eye(model.dim), 0.1)
        for _ in range(_WARM_UP):
            self.solve(way[0], way, [block] * min(problem.max_obstacles, 1))

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
        engine, step, free = self._resolution.begin(step, watch)
        if free is None:
            last = None if nominal is None else nominal()
            engine, step, free = self._resolution.refined(step, watch, last)
        if free is not None:
            return self._plan(step, _Found(free), watch, self._resolution.finished(engine))
        start = engine.free() if last is None else last
        for _ in range(_CORRECTIONS):
            start = start.resampled(engine.sampling.count)
            sweep = self._resolution.assumed(engine, start)
            wide = self._resolution.widened(engine, step, sweep)
            found = _Found(engine.descend(start) or self._ladder.resort(wide, last))
            if self._contested(found.best, challenge):
                found = self._challenge(engine, wide, watch, found.best)
            found = self._allocate(engine, wide, watch, found)
            ending = watch.elapsed
            found = self._rescue(engine, wide, last, found)
            if self._resolution.kept(engine, step, sweep, found.best):
                break
            start = found.best.iterate
            engine, step = self._resolution.finer(engine, step, watch)
        else:
            found = replace(found, best=exposed(found.best))
        plan = self._plan(wide, found, watch, self._resolution.finished(engine))
        watch.learn("ending", ending)
        return plan

    def _contested(self, best: Descent, challenge: bool) -> bool:
        """Whether other ways past the obstacles are worth a look."""
        wanted = not best.status.ok or (challenge and best.iterate.touches)
        return self.settings.sides and wanted

    def _challenge(
        self, engine: Engine, step: StepData, watch: Stopwatch, best: Descent
    ) -> "_Found":
        """Rank the ways past the obstacles by one program each; descend from the best of them."""
        most = watch.room("way", MAX_CANDIDATES, then="first program")
        if not most:
            return _Found(best)
        began = watch.elapsed
        full = np.full(self.problem.max_obstacles, self.problem.size.reference)
        here = Passing(engine.path(best.iterate), best.iterate.touched[: step.count])
        sides = candidates(step, engine.free_path(), here.path, full, most)
        present = replace(best.iterate, s=full)
        safe = best.status.ok
        starts = engine.glimpses(present, [side.path for side in sides], firm=safe)
        watch.learn("way", began, len(sides))
        tried = tuple(
            Candidate(side.obstacle, side.normal, side.time, start.merit)
            for side, start in zip(sides, starts, strict=False)  # none if they are too many
        )
        goal, switched = best, False
        ranked = sorted(starts, key=lambda start: start.merit)  # ties keep their order
        # A plan with slack is followed by any without: then all ways are worth their time.
        for start in ranked[: self.settings.rivals] if safe else ranked:
            if (not safe and goal.status.ok) or not watch.affords("first program"):
                break
            if safe and same_way(step, Passing(start.path, start.touched), here):
                continue  # this way leads to where we are
            rival = engine.follow(start.iterate, goal)
            if rival is not None and rival.beats(goal, _HYSTERESIS * goal.merit):
                goal, switched = rival, True
        return _Found(goal, tried, switched)

    def _allocate(
        self, engine: Engine, step: StepData, watch: Stopwatch, found: "_Found"
    ) -> "_Found":
        """Iterative risk allocation: the plan stays feasible, so that its cost cannot rise."""
        margin, best = self.problem.margin, found.best
        if not isinstance(margin, JointRisk) or margin.allocation == "uniform":
            return found
        allocated = np.full(step.radii.shape, margin.delta / step.radii.size)
        for _ in range(_ROUNDS):
            if not (best.status.ok and best.iterate.touches and watch.affords("first program")):
                break
            wanted = reallocated(allocated, point_risks(step, engine.path(best.iterate)))
            engine.widen(step.scaled(size_at_risk(wanted)))
            other = engine.descend(best.iterate)
            if other is None or not other.beats(best, 0.0):
                break
            gain, best, allocated = best.merit - other.merit, other, wanted
            if gain <= _GAIN * best.merit:
                break
        engine.widen(step)
        return replace(found, best=best)

    def _rescue(
        self, engine: Engine, step: StepData, last: Iterate | None, found: "_Found"
    ) -> "_Found":
        """Without a plan that meets every constraint: descend from one that does, if known."""
        if found.best.status.ok or found.best.status is Status.FALLBACK:
            return found
        known = self._ladder.resort(step, last)
        if not known.status.ok:
            return replace(found, best=self._ladder.lesser(found.best, known))
        better = engine.descend(known.iterate)
        return replace(found, best=better if better and better.status.ok else known)

    def _plan(
        self, step: StepData, found: "_Found", watch: Stopwatch, qps: Mapping[str, int]
    ) -> Plan:
        best, inside = found.best, watch.inside.seconds
        iterate = best.iterate
        path = step.sampling.positions(iterate.states, iterate.inputs)
        slack = step.sampling.stages(iterate.slack[: step.count]).max(axis=2, initial=0.0)
        return Plan(
            X=iterate.states,
            U=iterate.inputs,
            s=iterate.s[: step.count],
            slack=frozen(slack),
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
            commitment=partial(plan_risk, step, path),
        )


@dataclass(frozen=True, eq=False)
class _Found:
    """The best plan, the rivals that were tried, and whether one of them won."""

    best: Descent
    tried: tuple[Candidate, ...] = ()
    switched: bool = False
