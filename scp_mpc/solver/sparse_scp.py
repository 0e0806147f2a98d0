"""Sequential convex programming on the sparse program: for any problem, OSQP first.

    repeat:  half-spaces about the nominal -> values of the QP -> solve, warm-started in x and y
             -> new nominal -> half-spaces about it -> KKT residual of the original problem
    until    that residual is below the tolerance, or the iterations run out
             (from the third time on, about a point extrapolated from the last two nominals)

A half-space about a point is exact there. So the KKT residual of the *next* QP at the present
point and multipliers is the KKT residual of the original problem: the certificate costs one
residual, and a step without an active obstacle takes one QP.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.problem import Problem
from scp_mpc.safety.halfspaces import HalfSpaces
from scp_mpc.settings import Settings
from scp_mpc.solver.acceleration import Anderson
from scp_mpc.solver.descent import Descent, Glimpse, hopeless, judge
from scp_mpc.solver.iterate import Iterate, moved
from scp_mpc.solver.program import KKTResiduals
from scp_mpc.solver.sampling import Sampling
from scp_mpc.solver.step_data import StepData
from scp_mpc.solver.stopwatch import Stopwatch
from scp_mpc.solver.subproblem import Subproblem
from scp_mpc.solver.trusted import TrustedSolver


class SparseSCP:
    """Descends from a nominal plan, one sparse quadratic program per iteration.

    Usage: `begin` a step; then `free` and `descend` as often as wanted.

    Args:
        problem: What to solve.
        settings: How to solve it.
    """

    def __init__(self, problem: Problem, settings: Settings, sampling: Sampling) -> None:
        """Lay out the subproblem and set up its solver."""
        self._problem, self._settings = problem, settings
        self._sampling = sampling
        self._subproblem = Subproblem(problem, sampling)
        self._qp = TrustedSolver(self._subproblem.program, settings.qp)
        self._stale = False
        self.watch = Stopwatch()

    @property
    def finished(self) -> Counter[str]:
        """Programs finished since `begin`, by solver."""
        return self._qp.finished

    def forget(self) -> None:
        """Forget what earlier programs left behind, before the next one."""
        self._stale = True

    def begin(self, step: StepData, watch: Stopwatch) -> None:
        """Read a control step."""
        if self._stale:
            self._qp.reset()
            self._stale = False
        self.step, self.watch = step, watch
        self._qp.reset_counts()
        self._subproblem.write_step(step.x0, step.x_ref, step.u_last)

    def widen(self, step: StepData) -> None:
        """Take other radii or sizes for the step that has begun."""
        self.step = step

    def unhindered(self) -> None:
        """No shortcut: see `CondensedSCP.unhindered`."""

    def free(self) -> Iterate:
        """The plan that ignores the obstacles; its cost bounds every other from below."""
        self._subproblem.soft = False
        problem = self._problem
        self._subproblem.write_half_spaces(
            HalfSpaces.none(problem.max_obstacles, self._sampling.points, problem.model.dim)
        )
        nominal = self._subproblem.resting(self.step.x_ref)
        return self._solve_convex(nominal, self._subproblem.residuals(nominal)) or nominal

    def free_path(self) -> FloatArray:
        """Its positions (C, d)."""
        free = self.free()
        return self._sampling.positions(free.states, free.inputs)

    def glimpses(
        self, best: Iterate, paths: Sequence[FloatArray], firm: bool = True
    ) -> list[Glimpse]:
        """Solve one program about each path (C, d); see `CondensedSCP.glimpses`."""
        position, count = self._problem.model.position, self._sampling.count
        starts = (moved(best, position, path[count - 1 :: count]) for path in paths)
        return [self._glimpse(start, self.descend(start, 1), firm) for start in starts]

    def _glimpse(self, start: Iterate, end: Descent | None, firm: bool) -> Glimpse:
        if end is None:
            path = self._sampling.positions(start.states, start.inputs)
            nobody = np.zeros((self.step.count, len(path)), dtype=np.bool_)
            return Glimpse(np.inf, nobody, path, lambda: start)
        merit = end.merit if end.status.ok or not firm else np.inf
        ended = end.iterate
        path = self._sampling.positions(ended.states, ended.inputs)
        return Glimpse(merit, ended.touched[: self.step.count], path, end.make)

    def descend(self, nominal: Iterate, limit: int, goal: Descent | None = None) -> Descent | None:
        """Run the loop from one nominal plan, for at most `limit` subproblems; None if none came.

        Args:
            nominal: Where to begin.
            limit: Subproblems at most.
            goal: Stop when it is plain that this plan will not be reached.
        """
        tolerance = self._settings.tolerance
        self._subproblem.soft = False
        iterate, iterations = self._subproblem.started(nominal), 0
        residuals = self._linearise_about(iterate)
        acceleration = Anderson(iterate, self._problem.model.position)
        while residuals.worst > tolerance and iterations < limit:
            if not self.watch.affords("sparse program"):
                break
            began = self.watch.elapsed
            convex = self._improve(iterate, residuals, acceleration)
            self.watch.learn("sparse program", began)
            if convex is None:
                break
            iterate, iterations = convex, iterations + 1
            if self._settings.acceleration:
                acceleration.learn(iterate)
            residuals = self._linearise_about(iterate)
            if goal is not None and hopeless(iterations, self._merit(iterate), goal):
                break
        if iterations == 0 and residuals.worst > tolerance:
            return None
        return self._ended(iterate, residuals, iterations)

    def _improve(
        self, iterate: Iterate, residuals: KKTResiduals, acceleration: Anderson
    ) -> Iterate | None:
        """Solve one subproblem: about the extrapolated point if that helps, else the iterate."""
        bold = acceleration.propose(iterate)
        if bold is not None:
            self._write_half_spaces(bold)
            convex = self._solve_convex(iterate, residuals)
            if convex is not None and self._merit(convex) <= self._merit(iterate):
                return convex
            acceleration.reject()
            self._write_half_spaces(iterate)
        convex = self._solve_convex(iterate, residuals)
        if convex is None and not self._subproblem.soft:
            self._subproblem.soft = True  # nobody found a plan within all half-spaces
            convex = self._solve_convex(iterate, residuals)
        return convex

    def _solve_convex(self, iterate: Iterate, residuals: KKTResiduals) -> Iterate | None:
        """Solve the subproblem as it stands, warm-started at an iterate."""
        with self.watch.solving:
            x, y = self._subproblem.pack(iterate)
            solution = self._qp.solve(x, y, residuals.worst, self.watch.inside)
        return None if solution is None else self._subproblem.unpack(solution.x, solution.y)

    def _linearise_about(self, iterate: Iterate) -> KKTResiduals:
        """Write the half-spaces about an iterate; return its residuals in the original problem."""
        self._write_half_spaces(iterate)
        return self._subproblem.residuals(iterate)

    def _write_half_spaces(self, iterate: Iterate) -> None:
        with self.watch.linearising:
            spaces = self.step.half_spaces(iterate.states, iterate.s, iterate.inputs)
            self._subproblem.write_half_spaces(spaces)
            self._depths = np.maximum(0.0, -spaces.value)

    def _ended(
        self,
        iterate: Iterate,
        residuals: KKTResiduals,
        iterations: int,
    ) -> Descent:
        if residuals.worst > self._settings.tolerance:  # the slack is about the last nominal
            iterate = replace(iterate, slack=self._depths)
            residuals = self._subproblem.residuals(iterate)
        excess = self._problem.excess(iterate.states).max()
        most = float(np.maximum(iterate.slack.max(initial=0.0), excess))  # NaN stays
        status = judge(residuals, most, self._settings.tolerance)
        cost = self._cost(iterate)
        merit = cost + self._penalty(iterate)
        return Descent(iterate.frozen, cost, merit, residuals, status, iterations)

    def _merit(self, iterate: Iterate) -> float:
        return self._cost(iterate) + self._penalty(iterate)

    def _penalty(self, iterate: Iterate) -> float:
        return self._problem.penalty(iterate.slack, iterate.states)

    def _cost(self, iterate: Iterate) -> float:
        return self._problem.cost(iterate.states, iterate.inputs, iterate.s, self.step.x_ref)
