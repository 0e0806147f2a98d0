"""The solver of one control step: puts the loop, its starts and what lies below it together.

    free plan, which ignores the obstacles: if it is clear of them, nothing can be better;
                 a nonlinear robot that would stand short of its goal tries some manoeuvres first
    nominal = previous plan, shifted (or the free plan)
    loop         half-spaces about the nominal -> quadratic program -> new nominal, until the KKT
                 residual of the original problem is below the tolerance, or the time is up
    multi-start  where an obstacle shapes the plan, the same from paths on its other sides;
                 the best plan wins, if by enough
    allocate     where a joint risk is promised, give it to those who need it, and go on
    fallback     without a plan that meets every constraint, the previous one, or braking, or what
                 is no faster than braking where it violates one

Between the nodes of a plan radii leave room for what its motion there is assumed to be; a plan that
moves otherwise is sought again, with what it does for the assumption.

With `Settings(solver="native")` the core in C does all that, `native.py`.
"""

import logging
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray, frozen
from scp_mpc.deadline import Clock, Pace, Timer
from scp_mpc.errors import ConcurrentUseError, InvalidArgumentError
from scp_mpc.geometry.margin import JointRisk
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.qp.program import QuadraticProgram
from scp_mpc.scp.braking import stands
from scp_mpc.scp.certificate import Nominal
from scp_mpc.scp.fallback import Fallback
from scp_mpc.scp.iterate import Iterate, as_iterate
from scp_mpc.scp.loop import Loop
from scp_mpc.scp.manoeuvres import manoeuvres
from scp_mpc.scp.multi_start import Found, MultiStart
from scp_mpc.scp.nodes import Motion, Nodes
from scp_mpc.scp.plan import Plan, Result, Status, Timing
from scp_mpc.scp.risk_allocation import allocate
from scp_mpc.scp.step import Step
from scp_mpc.scp.transcription import Relaxation, Transcription
from scp_mpc.settings import Settings
from scp_mpc.trajectory import Trajectory

if TYPE_CHECKING:
    from scp_mpc.scp.native import NativeEngine

_log = logging.getLogger(__name__)

_CORRECTIONS = 4  # of what was assumed about the motion between nodes
_WARM_UP = 3  # steps
_MANOEUVRES = 4  # that are followed
_BETTER = 1e-3  # share of the merit by which one has to win
_SPARE = 10  # iterations for which there has to be time


class SCP:
    """Solves one control step at a time, without memory of the last plan.

    Args:
        problem: What to solve.
        settings: How to solve it.
        timer: Tells the time [s] to deadlines; None for the machine's clock.
        dt: Interval [s] of the loop that it works in, which is the deadline "dt"; None for none.

    Attributes:
        native: The native core, where `Settings(solver="native")` asks for it; else None.

    Raises:
        InvalidArgumentError: There is no solver of that name, or it is not installed.
        MissingCoreError: The native core is asked for, and not there.
    """

    def __init__(
        self,
        problem: Problem,
        settings: Settings | None = None,
        timer: Timer | None = None,
        dt: float | None = None,
    ) -> None:
        """Condense the problem, lay the programs out and set the solvers up."""
        self.problem = problem
        self.settings = Settings() if settings is None else settings
        if not isinstance(self.settings, Settings):
            raise InvalidArgumentError("settings", f"{settings!r} is not a Settings")
        self._busy, self._pace, self._timer, self._dt = Lock(), Pace(), timer, dt
        self._nodes = Nodes.of(problem)
        self._fallback = Fallback(problem, self.settings.tolerance)
        self._between = problem.nodes_per_interval > 1
        self.native = self._engine() if self.settings.solver == "native" else None
        if self.native is None:
            self._multi_start = MultiStart(self._at, self._loop)
        if self.settings.time_limit() is not None:
            self._warm_up()

    def _engine(self) -> "NativeEngine":
        from scp_mpc.scp.native import NativeEngine  # when it is asked for, and no sooner

        limit = self.settings.time_limit(self._dt)
        return NativeEngine(self.problem, self.settings, self._nodes, limit, self._timer)

    @cached_property
    def _at(self) -> Transcription:
        """The programs; with the native core only to look at one of them."""
        native = self.settings.solver == "native"
        settings = replace(self.settings, solver="osqp") if native else self.settings
        return Transcription(self.problem, settings, self._nodes)

    @cached_property
    def _loop(self) -> Loop:
        return Loop(self._at)

    def __getstate__(self) -> dict[str, object]:
        """What a copy is built from: solvers and locks are not copied."""
        parts = {"problem": self.problem, "settings": self.settings, "timer": self._timer}
        memory = None if self.native is None else self.native.core.memory
        return parts | {"dt": self._dt, "memory": memory}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Build the copy."""
        memory = state.pop("memory")
        self.__init__(**state)  # type: ignore[misc]
        if self.native is not None:
            self.native.core.memory = memory

    def solve(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction] = (),
        guess: Trajectory | Iterate | None = None,
        multi_start: bool = True,
        robot_covariance: ArrayLike | None = None,
        u_last: ArrayLike | None = None,
    ) -> Plan:
        """Plan from the state x0 along the reference and around the obstacles.

        Args:
            x0: (nx,) state now.
            x_ref: (N+1, nx) reference, or (nx,) to be held; row 0 is not weighted.
            obstacles: At most `max_obstacles` predictions over the same horizon.
            guess: Where to linearise first; None for the plan that ignores the obstacles.
            multi_start: Try the other ways past the obstacles even if this one works, unless
                `settings.multi_start` is off.
            robot_covariance: (d, d) or (N+1, d, d) of the robot's own position [m^2]; adds to the
                obstacles'.
            u_last: (nu,) input last applied, from which the first rate counts. None for unknown:
                then the first input has no rate.

        Raises:
            InvalidArgumentError: Or one of its subclasses, before anything is changed.
            ConcurrentUseError: Another thread is using this solver.
        """
        nominal = None if guess is None else as_iterate(guess, self.problem)
        return self.solve_from(
            *(x0, x_ref, obstacles, nominal, multi_start, robot_covariance),
            u_last=u_last,
        )

    def solve_from(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        nominal: Iterate | None,
        multi_start: bool,
        robot_covariance: ArrayLike | None = None,
        clock: Clock | None = None,
        u_last: ArrayLike | None = None,
        brake_first: bool = False,
    ) -> Plan:
        """`solve`, with an iterate that is known to fit, and a clock that may run.

        Where nothing better is found in time, the last plan is followed, or with
        `brake_first` braking if that meets every constraint, too.
        """
        if not self._busy.acquire(blocking=False):
            raise ConcurrentUseError("this solver is at work in another thread; give each its own")
        try:
            if self.native is not None:
                return self.native.solve(
                    *(x0, x_ref, obstacles, nominal, multi_start, robot_covariance, u_last),
                    brake_first,
                )
            clock = self.clock() if clock is None else clock
            step = Step.read(
                self.problem, x0, x_ref, obstacles, robot_covariance, self._nodes, u_last
            )
            if nominal is not None:
                nominal = nominal.unwrapped(self.problem.model, step.x0)
            try:
                return self._solve(step, clock, nominal, multi_start, brake_first)
            except (ArithmeticError, np.linalg.LinAlgError, InvalidArgumentError):
                _log.exception("a computation broke down: the last plan, or braking")
                return self._plan(
                    step, Found(self._fallback.best(step, nominal, None, brake_first)), clock
                )
        finally:
            self._busy.release()

    def subproblem(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction] = (),
        guess: Trajectory | Iterate | None = None,
        elastic: bool = False,
        robot_covariance: ArrayLike | None = None,
        u_last: ArrayLike | None = None,
    ) -> QuadraticProgram:
        """Return the quadratic program that one SCP iteration solves, as sparse matrices.

            minimise 1/2 z'P z + q'z   subject to   lower <= A z <= upper

        Variables z are the states 1 .. N as deviations from the reference, the inputs 0 .. N-1, the
        sizes if they move, and slack in an elastic program; rows are the dynamics, bounds, and
        half-spaces about the guess. Its cost lacks a constant.

        Args:
            x0: As in `solve`, like the other arguments.
            x_ref: Likewise.
            obstacles: Likewise.
            guess: The plan about which dynamics and obstacles are linearised.
            elastic: Whether bounded states and half-spaces may yield, at their price.
            robot_covariance: As in `solve`.
            u_last: As in `solve`.
        """
        nominal = None if guess is None else as_iterate(guess, self.problem)
        if not self._busy.acquire(blocking=False):
            raise ConcurrentUseError("this solver is at work in another thread; give each its own")
        try:
            step = Step.read(
                self.problem, x0, x_ref, obstacles, robot_covariance, self._nodes, u_last
            )
            at = self._at
            at.begin(step, self.clock())
            if nominal is None:
                nominal = at.iterate(self._obstacle_free(None))
            if self._between and step.count:
                at.step = self._widened(step, self._motion(nominal))
            about, path = at.at(nominal), at.outputs(nominal)
            about = at.at(nominal, about=path)
            relaxation = Relaxation.ALL if elastic else Relaxation.NONE
            program = at.write(about, at.linearise(about), about.pairs.planes(path), relaxation)
            return program.subproblem.program.copy()
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
        clock = Clock()
        step = Step.read(self.problem, x0, x_ref, (), nodes=self._nodes, u_last=u_last)
        return self._plan(step, Found(self._fallback.brake(step, status)), clock)

    def follow(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        inputs: FloatArray,
        robot_covariance: ArrayLike | None = None,
        u_last: ArrayLike | None = None,
    ) -> Plan:
        """Judge inputs (N, nu) that are known, as `Status.PREVIOUS` if they hold."""
        given = self.problem, x0, x_ref, obstacles, robot_covariance, self._nodes, u_last
        step = Step.read(*given)
        return self._plan(step, Found(self._fallback.keep(step, inputs)), Clock())

    def clock(self) -> Clock:
        """The clock of a step that begins now."""
        return self.timed(self.settings.time_limit(self._dt))

    def timed(self, deadline: float | None) -> Clock:
        """The clock of a step that begins now and is to end by a deadline [s]."""
        return Clock(deadline, self._pace, self.settings.max_programs, self._timer)

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
        self, step: Step, clock: Clock, last: Iterate | None, multi_start: bool, brake_first: bool
    ) -> Plan:
        at = self._at
        at.begin(step, clock)
        free = self._obstacle_free(last)
        free_motion, wide = None, step
        if self._between and step.count:
            free_motion = self._nodes.motion(*self._trajectory(free, step))
            wide = self._widened(step, free_motion)
        if self._is_clear(wide, free):
            at.step, alone = wide, self._loop.result(free)
            if alone.status.certified or (alone.status.ok and not step.count):
                return self._plan(wide, Found(alone), clock)
        at.obstacle_free = at.iterate(free)
        # Where the inputs lead from a state that a disturbance has moved says little about sides.
        about = None if last is None else at.outputs(last)
        start = at.obstacle_free if last is None else last
        for _ in range(_CORRECTIONS):
            assumed = None
            if free_motion is not None:
                assumed = self._motion(start).reserved(free_motion, self._nodes.most_deviation)
                wide = self._widened(step, assumed)
            at.step = wide
            best = None
            if step.count and clock.allows("iteration"):
                best = self._loop.run(at.at(start, about=about), about=about)
            ending = clock.mark()
            found = Found(best or self._fallback.best(step, last, None, brake_first))
            if self._multi_start.wanted(found.best, multi_start):
                found = self._multi_start.run(found.best, at.path(free.y)[1:], last)
                ending = clock.mark()
            if best is not None and isinstance(self.problem.margin, JointRisk):
                found = replace(found, best=allocate(at, self._loop, found.best))
                ending = clock.mark()
            best = self._rescued(step, last, found.best, brake_first)
            if best.iterate.multipliers is None:  # from here the next obstacle-free plan is sought
                best = replace(best, iterate=replace(best.iterate, obstacle_free=at.obstacle_free))
            found = replace(found, best=best)
            if assumed is None or self._is_kept(step, assumed, found.best):
                break
            start, about = found.best.iterate, None
        else:
            exposed = self._exposed(step, found.best)
            found = replace(found, best=self._fallback.best(step, last, exposed, brake_first))
        plan = self._plan(at.step, found, clock)
        clock.learn("ending", ending)
        return plan

    def _obstacle_free(self, last: Iterate | None) -> Nominal:
        """The plan that ignores the obstacles: no other costs less, and most steps need no more.

        For a linear robot that takes a few linear systems. For a nonlinear one the loop finds it,
        from the better of the last plan and the last obstacle-free one, for both lead to local
        optima only; where an obstacle shaped the last plan, only the sides of the obstacles are
        sought, and one program about it has to do.
        """
        at, limit, others = self._at, None, list[Nominal]()
        known = last if last is None or last.obstacle_free is None else last.obstacle_free
        plan = at.obstacle_free_optimum(known) if at.linear else None
        if plan is None:
            if last is None:
                start, *others = map(at.plain, self._starts())
            elif at.linear:
                start = at.at(known or last, at.no_pairs.near)
            else:
                start = at.at(last, at.no_pairs.near)
                limit = 1 if last.touches else None
                if last.obstacle_free is not None and not last.touches:
                    other = at.at(last.obstacle_free, at.no_pairs.near)
                    merits = [at.merit(p.cost, 0.0, p.excess) for p in (start, other)]
                    start = other if merits[1] < merits[0] else start
            found = None
            if last is None or not last.touches or at.clock.room("iteration", 2) == 2:
                found = self._loop.run(start, limit=limit)
            found = found or self._loop.result(start)
            if last is not None and stands(self.problem, found.iterate.states, at.step.x_ref):
                others = [at.plain(inputs) for inputs in self._starts()]
            for other in others:
                if at.clock.room("iteration", _SPARE) < _SPARE:
                    break
                end = self._loop.run(other, found)
                if end is not None and end.beats(found, _BETTER * found.merit):
                    found = end
            plan = found.nominal or start
        return plan

    def _starts(self) -> list[FloatArray]:
        """Inputs (N, nu) that lead near some local optima each: rest, and the best manoeuvres."""
        at, clock, rest = self._at, self._at.clock, self.problem.model.equilibrium_input
        starts = [np.tile(rest, (self.problem.horizon, 1))]
        if not at.linear and clock.allows("manoeuvres"):
            with clock.task("manoeuvres"):
                starts.extend(manoeuvres(at.step, _MANOEUVRES))
        return starts

    def _rescued(self, step: Step, last: Iterate | None, best: Result, brake_first: bool) -> Result:
        """Without a plan that meets every constraint: go on from one that does, if known.

        What is known is judged by its own motion between the nodes, and so is what it leads to.
        """
        if best.status.ok or best.nominal is None:
            return best
        known = self._fallback.best(step, last, best, brake_first)
        if not known.status.ok:
            return known
        better = known
        for _ in range(_CORRECTIONS):
            own = self._motion(better.iterate)
            self._at.step = self._widened(step, own) if self._between else step
            found = self._loop.run(self._at.at(better.iterate))
            if found is None or not found.status.ok:
                return known
            better = found
            if not self._between or self._is_kept(step, own, better):
                return better
        return known

    def _is_clear(self, step: Step, plan: Nominal) -> bool:
        path, s = self._at.path(plan.y), plan.y[self._at.layout.s]
        return step.within(path, s, 0.0) is None

    def _trajectory(self, plan: Nominal, step: Step) -> tuple[FloatArray, FloatArray]:
        states = step.x_ref.copy()
        states[0] = step.x0
        states[1:] += plan.rollout.deviations
        return states, plan.rollout.inputs

    def _motion(self, iterate: Iterate) -> Motion:
        return self._nodes.motion(iterate.states, iterate.inputs)

    def _widened(self, step: Step, motion: Motion) -> Step:
        """The step with radii that leave room for what happens between the nodes."""
        return step.widened(self._nodes.radii(step.radii, step.drift, motion))

    def _is_kept(self, step: Step, assumed: Motion, best: Result) -> bool:
        """Whether a plan is clear between its nodes, too, for what it really does there."""
        if not best.status.ok or assumed.covers(self._motion(best.iterate)):
            return True
        return bool(self._depths(step, best).max(initial=0.0) <= self.settings.tolerance)

    def _depths(self, step: Step, best: Result) -> FloatArray:
        """How deep a plan enters the no-go sets (J, C), for what it does between its nodes."""
        iterate = best.iterate
        path = self._nodes.positions(iterate.states, iterate.inputs)
        return self._widened(step, self._motion(iterate)).depths(path, iterate.s)

    def _exposed(self, step: Step, best: Result) -> Result:
        """A plan that is not clear between its nodes after all, with how far it is not."""
        depths, slack = self._depths(step, best), best.iterate.slack.copy()
        slack[: step.count] = depths
        iterate = replace(best.iterate, slack=slack).frozen()
        residuals = replace(best.residuals, feasibility=float(depths.max()))
        return replace(best, iterate=iterate, status=Status.VIOLATING, residuals=residuals)

    def _plan(self, step: Step, found: Found, clock: Clock) -> Plan:
        best = found.best
        iterate = best.iterate
        slack = iterate.slack[: step.count]
        if step.nodes.count > 1:
            slack = frozen(step.nodes.stages(slack).max(axis=2, initial=0.0))
        finished = self._at.finished if self.native is None else {}
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
            qps=dict(finished),
            candidates=found.tried,
            switched=found.switched,
            timing=Timing(
                linearise=clock.spent["linearise"],
                update=clock.spent["update"],
                solve=clock.spent["solve"],
                total=clock.elapsed(),
            ),
            iterate=iterate,
            history=best.history,
            step=step,
        )
