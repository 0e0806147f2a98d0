"""Sequential convex programming: the loop.

    nominal = the plan to start from
    repeat:  linearise   the dynamics about the nominal
             write       their values, and half-spaces of near obstacles, into the fixed pattern
             solve       OSQP, warm-started; the active set that it names, solved exactly
             refine      Newton's step on that active set, where it exists (newton.py)
             certify     the plan it leads to, against the original problem (certificate.py)
             screen      whether that plan violates a pair of obstacle and node that was left out
             accept      the plan as the next nominal, or trust a smaller region (trust_region.py)
    until    certified, or the time is up

For a linear robot half-spaces are sound about any point: a convex step cannot raise the merit, a
Newton step hardly, and all plans are accepted. For a nonlinear robot a trust region bounds what the
inputs change by, and the merit is cost and penalty on all violations.
"""

from dataclasses import replace
from math import inf, isnan

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.scp.candidates import PassingPattern, same_pattern
from scp_mpc.scp.certificate import Nominal
from scp_mpc.scp.history import Record, recorded
from scp_mpc.scp.iterate import NEGLIGIBLE
from scp_mpc.scp.newton import (
    negative_curvature_step,
    refined,
    restored,
    second_order_correction,
)
from scp_mpc.scp.plan import Result, judge
from scp_mpc.scp.transcription import Relaxation, Transcription
from scp_mpc.scp.trust_region import TrustRegion

_SURPLUS = 0.1  # of the tolerance: worth one more iteration, whose convergence is quadratic
_LEAST_COST = 1e-3  # relative to which products of forces and gaps are judged
_PATIENCE = 3  # iterations before a run towards a goal is given up
_FAR = 1.1  # share of the goal's merit above which it is
_NEARLY = 0.01  # [m], or unit of a state: a violation that steps onto the constraints may mend
_ALIKE = 0.01  # relative difference of cost of plans that may become the same
_CLOSE = 0.1  # share of the inputs' range that lies between plans that become the same


class Loop:
    """Solves the control steps that a transcription has begun."""

    def __init__(self, at: Transcription) -> None:
        """Remember it, and the settings."""
        self._at, self._settings = at, at.settings

    def run(
        self,
        nominal: Nominal,
        goal: Result | None = None,
        about: FloatArray | None = None,
        limit: int | None = None,
        hard: bool = False,
    ) -> Result | None:
        """Descend from a plan; None if no plan was accepted, or if given up.

        Args:
            nominal: Where to begin.
            goal: Give up when it is plain that this plan will not be reached.
            about: (ny,) where the first half-spaces are taken, which need not obey the dynamics.
            limit: Iterations at most; None for as many as the settings allow.
            hard: Whether to give up where the obstacles would have to yield.
        """
        at, clock, history = self._at, self._at.clock, list[Record]()
        planes = nominal.planes if about is None else nominal.pairs.planes(about)
        region, level, iterations = TrustRegion(at), Relaxation.NONE, 0
        reached: Nominal | None = None  # the last plan that was accepted
        while iterations < (limit or self._settings.max_iterations) and clock.allows("iteration"):
            with clock.task("iteration"):
                condensed = at.linearise(nominal)
                program = at.write(nominal, condensed, planes, level, region.radius)
                end = at.solve(program, nominal)
                convex = end.solution
                if convex is not None:
                    solution = refined(at, program, convex)
                    trial = at.certify(program, solution)
            if convex is None:
                more = at.next_relaxation(level, hard or not len(nominal.force))
                if more is None or end.late:
                    break
                level = more  # no solution, or none found: the next ones may yield
                continue
            iterations += 1
            wider = at.screen(trial)
            if wider is not None:  # who was left out enters, and the program is solved again
                own, nominal = planes is nominal.planes, at.with_pairs(nominal, wider)
                planes = nominal.planes if own else wider.planes(planes.y)
                continue
            accepted = region.accepts(nominal, reached, trial, program, convex, solution)
            if not accepted and not at.linear and len(trial.force):
                solution = second_order_correction(program, solution, trial)
                trial = at.certify(program, solution)
                accepted = region.accepts(nominal, reached, trial, program, convex, solution)
            if self._settings.history:
                history.append(recorded(at, nominal, program, convex, trial, accepted))
            if not accepted and not region.shrinks(nominal, program, solution):
                break
            if not accepted:
                continue
            before = inf if reached is None else reached.residuals.worst
            nominal, reached, planes = trial, trial, trial.planes
            level = level if trial.slack.any() or trial.excess.any() else Relaxation.NONE
            if self._is_converged(trial, before):
                reached, direction = at.second_order(trial, program, solution)
                away = negative_curvature_step(at, reached, direction)
                if away is None:
                    break
                nominal, planes = away, away.planes
                continue
            if goal is not None and self._is_dominated(iterations, trial, goal):
                return None
        if reached is None:
            return None
        if reached.residuals.worst <= self._settings.tolerance and isnan(
            reached.residuals.curvature
        ):
            reached, _ = at.second_order(reached, program, solution)
        if self._is_nearly_feasible(reached):  # out of iterations: a plan that can be followed
            near = restored(at, reached, self._settings.tolerance)
            reached, level = (near, Relaxation.NONE) if near is not None else (reached, level)
        return self.result(reached, level, iterations, tuple(history))

    def _is_nearly_feasible(self, plan: Nominal) -> bool:
        """Whether a nonlinear robot's plan violates its constraints, but hardly."""
        if self._at.linear or plan.residuals.worst <= self._settings.tolerance:
            return False
        deep = max(plan.residuals.feasibility, float(plan.slack.max(initial=0.0)))
        deep = max(deep, float(plan.excess.max(initial=0.0)))
        return self._settings.tolerance < deep <= _NEARLY

    def result(
        self,
        nominal: Nominal,
        level: Relaxation = Relaxation.NONE,
        iterations: int = 0,
        history: tuple[Record, ...] = (),
    ) -> Result:
        """Judge a plan."""
        at, residuals, tolerance = self._at, nominal.residuals, self._settings.tolerance
        most = float(max(nominal.slack.max(initial=0.0), nominal.excess.max(initial=0.0)))
        status = judge(residuals, most, tolerance)
        if not status.certified and residuals.feasibility > tolerance:  # then all of it counts
            nominal = replace(nominal, slack=np.maximum(-nominal.planes.g, 0.0))
        merit = at.merit(nominal.cost, float(nominal.slack.sum()), nominal.excess)
        l1_weight = at.problem.slack_weight if level is Relaxation.ALL else inf
        given = nominal.cost, merit, residuals, status, iterations, nominal, history
        return Result(at.iterate(nominal, l1_weight), *given)

    def _is_converged(self, trial: Nominal, before: float) -> bool:
        """Whether a plan is certified, and another iteration would hardly better it."""
        tolerance, residuals = self._settings.tolerance, trial.residuals
        product = residuals.complementarity / min(1.0, max(trial.cost, _LEAST_COST))
        enough = tolerance if before <= tolerance else _SURPLUS * tolerance
        return max(residuals.worst, product) <= enough

    def _is_dominated(self, iterations: int, trial: Nominal, goal: Result) -> bool:
        """Whether a run, whose cost falls by ever less, is far above its goal or ends there."""
        at, cost, there = self._at, trial.cost, goal.iterate
        if goal.status.ok and iterations >= _PATIENCE and cost > _FAR * goal.merit:
            return True
        if abs(cost - goal.cost) > _ALIKE * goal.cost:
            return False
        if not len(trial.force):
            apart = np.abs(trial.rollout.inputs - there.inputs)
            return bool((apart <= _CLOSE * (at.problem.u_max - at.problem.u_min)).all())
        mine = PassingPattern(at.path(trial.y)[1:], trial.pairs.table(trial.force) > NEGLIGIBLE)
        path = at.nodes.positions(there.states, there.inputs)
        return same_pattern(at.step, mine, PassingPattern(path, there.touched[: at.step.count]))
