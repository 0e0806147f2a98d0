"""Sequential convex programming for the problem of `scp_mpc.problem`.

    nominal = previous plan, shifted (or the plan that ignores the obstacles)
    repeat:  half-spaces about the nominal -> values of the QP -> solve, warm-started in x and y
             -> new nominal -> half-spaces about it -> KKT residual of the original problem
    until    that residual is below the tolerance, or the iterations run out
             (from the third time on, about a point extrapolated from the last two nominals)

A half-space about a point is exact there. So the KKT residual of the *next* QP at the present
point and multipliers is the KKT residual of the original problem: the certificate costs one
residual, and a step without an active obstacle takes one QP.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from threading import Lock
from time import perf_counter

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.errors import ConcurrentUseError, InvalidArgumentError
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.safety.halfspaces import HalfSpaces
from scp_mpc.settings import Settings
from scp_mpc.solver.acceleration import Anderson
from scp_mpc.solver.guess import as_iterate
from scp_mpc.solver.iterate import Iterate
from scp_mpc.solver.plan import Plan, Status, Timing
from scp_mpc.solver.program import KKTResiduals
from scp_mpc.solver.sides import candidates
from scp_mpc.solver.step_data import StepData
from scp_mpc.solver.subproblem import Subproblem
from scp_mpc.solver.trusted import TrustedSolver
from scp_mpc.trajectory import Trajectory, rollout

# A rival must win this share of what it could win at most, or the plan flickers between sides.
_HYSTERESIS = 0.05
# Subproblems after which a rival must be ahead; costs fall from one to the next, so it is fair.
_EXPLORATION = 5


@dataclass(frozen=True, eq=False)
class Descent:
    """Where one run of the loop ended; `merit` is its cost and the penalty on its slack."""

    iterate: Iterate
    cost: float
    merit: float
    residuals: KKTResiduals
    status: Status
    iterations: int

    def beats(self, other: "Descent", lead: float) -> bool:
        """Whether this end is safe and the other is not, or its merit is better by `lead`."""
        if self.status.ok != other.status.ok:
            return self.status.ok
        return self.merit < other.merit - lead


class SCP:
    """Solves one control step at a time, without memory of the last plan.

    Args:
        problem: What to solve.
        settings: How to solve it.
    """

    def __init__(self, problem: Problem, settings: Settings | None = None) -> None:
        """Lay out the subproblem and set up its solver."""
        self.problem = problem
        self.settings = Settings() if settings is None else settings
        if not isinstance(self.settings, Settings):
            raise InvalidArgumentError("settings", f"{settings!r} is not a Settings")
        self._busy = Lock()
        self._subproblem = Subproblem(problem)
        self._qp = TrustedSolver(self._subproblem.program, self.settings.qp)
        self._linearising = self._solving = 0.0

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
        if not self._busy.acquire(blocking=False):
            raise ConcurrentUseError("this solver is at work in another thread; give each its own")
        try:
            return self._solve(x0, x_ref, obstacles, guess, challenge)
        finally:
            self._busy.release()

    def _solve(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        guess: Trajectory | Iterate | None,
        challenge: bool,
    ) -> Plan:
        began = perf_counter()
        step = StepData.read(self.problem, x0, x_ref, obstacles)
        nominal = None if guess is None else as_iterate(guess, self.problem)
        self._linearising = self._solving = 0.0
        self._qp.reset_counts()
        if nominal is None:
            self._qp.reset()
        self._subproblem.write_step(step.x0, step.x_ref)
        nominal = nominal or self._free_plan(step)
        best = self._descend(step, nominal, self.settings.max_iterations)
        tried, switched = 0, False
        wanted = not best.status.ok or (challenge and best.iterate.touches)
        if self.settings.sides and wanted:
            best, tried, switched = self._challenge(step, best)
        return self._plan(step, best, tried, switched, began)

    def _descend(self, step: StepData, nominal: Iterate, limit: int) -> Descent:
        """Run the loop from one nominal plan, for at most `limit` subproblems."""
        tolerance = self.settings.tolerance
        self._subproblem.soft = False
        iterate, iterations = self._subproblem.started(nominal), 0
        residuals = self._linearise_about(step, iterate)
        acceleration = Anderson(iterate, self.problem.model.position)
        while residuals.worst > tolerance and iterations < limit:
            convex = self._improve(step, iterate, residuals, acceleration)
            if convex is None:
                break
            iterate, iterations = convex, iterations + 1
            if self.settings.acceleration:
                acceleration.learn(iterate)
            residuals = self._linearise_about(step, iterate)
        if iterations == 0 and residuals.worst > tolerance:
            return self._given_up(step, nominal)
        return self._ended(step, iterate, residuals, self._judge(residuals, iterate), iterations)

    def _challenge(self, step: StepData, best: Descent) -> tuple[Descent, int, bool]:
        """Try the other sides, if there is something to win."""
        free = self._free_plan(step)
        most = best.merit - self._cost(step, free)  # no plan costs less than the free one
        if most <= _HYSTERESIS * best.merit:
            return best, 0, False
        position = self.problem.model.position
        value = step.half_spaces(self.problem, free.states, free.s).value
        starts = candidates(free, position, step.sets, value)
        rival: Descent | None = None
        for start in starts:
            other = self._descend(step, start, _EXPLORATION)
            if rival is None or other.beats(rival, lead=0.0):
                rival = other
        if rival is None or not rival.beats(best, _HYSTERESIS * most):
            return best, len(starts), False
        if not rival.status.certified:
            refined = self._descend(step, rival.iterate, self.settings.max_iterations)
            refined = replace(refined, iterations=rival.iterations + refined.iterations)
            rival = rival if rival.beats(refined, lead=0.0) else refined
        return rival, len(starts), True

    def _improve(
        self, step: StepData, iterate: Iterate, residuals: KKTResiduals, acceleration: Anderson
    ) -> Iterate | None:
        """Solve one subproblem: about the extrapolated point if that helps, else the iterate."""
        bold = acceleration.propose(iterate)
        if bold is not None:
            self._write_half_spaces(step, bold)
            convex = self._solve_convex(iterate, residuals)
            if convex is not None and self._merit(step, convex) <= self._merit(step, iterate):
                return convex
            acceleration.reject()
            self._write_half_spaces(step, iterate)
        convex = self._solve_convex(iterate, residuals)
        if convex is None and not self._subproblem.soft:
            self._subproblem.soft = True  # nobody found a plan within all half-spaces
            convex = self._solve_convex(iterate, residuals)
        return convex

    def _solve_convex(self, iterate: Iterate, residuals: KKTResiduals) -> Iterate | None:
        """Solve the subproblem as it stands, warm-started at an iterate."""
        began = perf_counter()
        solution = self._qp.solve(*self._subproblem.pack(iterate), residuals.worst)
        self._solving += perf_counter() - began
        return None if solution is None else self._subproblem.unpack(solution.x, solution.y)

    def _linearise_about(self, step: StepData, iterate: Iterate) -> KKTResiduals:
        """Write the half-spaces about an iterate; return its residuals in the original problem."""
        self._write_half_spaces(step, iterate)
        return self._subproblem.residuals(iterate)

    def _write_half_spaces(self, step: StepData, iterate: Iterate) -> None:
        began = perf_counter()
        spaces = step.half_spaces(self.problem, iterate.states, iterate.s)
        self._subproblem.write_half_spaces(spaces)
        self._linearising += perf_counter() - began

    def _free_plan(self, step: StepData) -> Iterate:
        """The plan that ignores the obstacles; its cost bounds every other from below."""
        self._subproblem.soft = False
        problem = self.problem
        self._subproblem.write_half_spaces(
            HalfSpaces.none(problem.max_obstacles, problem.horizon, problem.model.dim)
        )
        nominal = self._subproblem.resting(step.x_ref)
        return self._solve_convex(nominal, self._subproblem.residuals(nominal)) or nominal

    def _judge(self, residuals: KKTResiduals, iterate: Iterate) -> Status:
        tolerance = self.settings.tolerance
        inside = max(residuals.feasibility, iterate.slack.max(initial=0.0)) > tolerance
        if residuals.worst <= tolerance:
            return Status.SOFTENED if inside else Status.CONVERGED
        return Status.VIOLATING if inside else Status.FEASIBLE

    def _given_up(self, step: StepData, nominal: Iterate) -> Descent:
        """Keep the nominal inputs, roll them out from x0, and own up to what they violate."""
        problem = self.problem
        inputs = np.clip(nominal.inputs, problem.u_min, problem.u_max)
        path = rollout(problem.model.step, step.x0, inputs)
        s = np.full(problem.max_obstacles, problem.margin.reference)
        value = step.half_spaces(problem, path.states, s).value
        iterate = Iterate(path.states, inputs, s, np.maximum(0.0, -value))
        unknown = KKTResiduals(np.inf, np.inf, np.inf)
        return self._ended(step, iterate, unknown, Status.FALLBACK, 0)

    def _ended(
        self,
        step: StepData,
        iterate: Iterate,
        residuals: KKTResiduals,
        status: Status,
        iterations: int,
    ) -> Descent:
        cost = self._cost(step, iterate)
        merit = cost + self._penalty(iterate)
        return Descent(iterate.frozen(), cost, merit, residuals, status, iterations)

    def _merit(self, step: StepData, iterate: Iterate) -> float:
        return self._cost(step, iterate) + self._penalty(iterate)

    def _penalty(self, iterate: Iterate) -> float:
        return self.problem.slack_weight * float(iterate.slack.sum())

    def _cost(self, step: StepData, iterate: Iterate) -> float:
        return self.problem.cost(iterate.states, iterate.inputs, iterate.s, step.x_ref)

    def _plan(
        self, step: StepData, best: Descent, tried: int, switched: bool, began: float
    ) -> Plan:
        iterate = best.iterate
        timing = Timing(
            linearise=self._linearising,
            update=self._solving - self._qp.seconds,
            solve=self._qp.seconds,
            total=perf_counter() - began,
        )
        return Plan(
            X=iterate.states,
            U=iterate.inputs,
            s=iterate.s[: step.count],
            slack=iterate.slack[: step.count],
            cost=best.cost,
            status=best.status,
            kkt=best.residuals,
            iterations=best.iterations,
            qps=dict(self._qp.finished),
            candidates=tried,
            switched=switched,
            timing=timing,
            iterate=iterate,
        )
