"""Sequential convex programming: the loop.

    nominal = the plan to start from
    repeat:  linearise   dynamics about the nominal, half-spaces of the obstacles that are near
             write       values into the fixed pattern of the program
             solve       OSQP, warm-started; the active set that it names, solved exactly
             refine      Newton's step on that active set, where it exists (newton.py)
             certify     the plan it leads to, against the original problem (certificate.py)
             screen      whether that plan violates a pair of obstacle and node that was left out
             accept      the plan as the next nominal, or trust a smaller region (trust_region.py)
    until    certified, or the time is up

For a linear robot half-spaces are sound about any point, so the merit cannot rise and every plan is
accepted. Two cases have no Newton step there: where it would break a constraint, its end is where
to linearise next; where the convex steps lead away, for they grow, the next half-spaces are about a
point several steps ahead, and such a leap is taken back if it costs more. For a nonlinear robot a
trust region bounds what the inputs change by, and the merit is cost and penalty on all violations.
"""

from math import inf

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.qp.active_set import QPSolution
from scp_mpc.qp.program import KKTResiduals
from scp_mpc.scp.candidates import Passing, same_way
from scp_mpc.scp.certificate import BENT, Nominal
from scp_mpc.scp.iterate import NEGLIGIBLE
from scp_mpc.scp.newton import corrected, downhill, refined
from scp_mpc.scp.plan import Record, Result, Status
from scp_mpc.scp.transcription import Program, Relaxation, Transcription
from scp_mpc.scp.trust_region import Region

_PATIENCE = 3  # iterations before a rival is given up
_FAR = 1.1  # share of the goal's merit above which it is
_LEAST_COST = 1e-3  # relative to which products of forces and gaps are judged
_SURPLUS = 0.1  # of the tolerance: worth one more iteration, whose convergence is quadratic
_ALIKE = 0.01  # relative difference of cost of plans that may become the same


class Loop:
    """Solves control steps that a transcription has begun.

    Args:
        at: The step in numbers.
    """

    def __init__(self, at: Transcription) -> None:
        """Remember it, and the settings."""
        self._at, self._settings = at, at.settings

    def run(
        self,
        nominal: Nominal,
        goal: Result | None = None,
        about: FloatArray | None = None,
        limit: int | None = None,
        screen: bool = True,
        firm: bool = False,
    ) -> Result | None:
        """Descend from a plan; None if not even the first program was solved, or if given up.

        Args:
            nominal: Where to begin.
            goal: Give up when it is plain that this plan will not be reached.
            about: (ny,) where the first half-spaces are taken, which need not obey the dynamics.
            limit: Iterations at most; None for as many as the settings allow.
            screen: Whether to look for obstacles that were left out.
            firm: Whether to give up where the obstacles would have to yield.
        """
        at, clock, tolerance = self._at, self._at.clock, self._settings.tolerance
        planes = nominal.planes if about is None else nominal.pairs.planes(about)
        region, give, history = Region(at), Relaxation.NOBODY, list[Record]()
        best, leaps, bold, iterations = None, 0, True, 0
        limit = self._settings.max_iterations if limit is None else limit
        while iterations < limit and clock.allows("iteration"):
            began = clock.elapsed()
            condensed = at.linearise(nominal)
            program = at.write(nominal, condensed, planes, give, region.radius)
            solution = at.solve(program, nominal)
            clock.learn("iteration", began)
            if solution is None:
                if planes is not nominal.planes and best is not None:
                    planes, leaps, bold = nominal.planes, 0, False  # it was a leap too far
                elif (more := at.next_relaxation(give, firm or not len(nominal.force))) is None:
                    break
                else:
                    give = more
                continue
            iterations += 1
            refinement, ahead = solution, None
            if bold:
                refinement, ahead = refined(at, program, solution, leaps)
            trial = at.certify(program, refinement)
            left_out = at.screen(trial) if screen else None
            if left_out is not None:  # they enter, and the program is solved again
                own, nominal = planes is nominal.planes, at.with_pairs(nominal, left_out)
                planes = nominal.planes if own else left_out.planes(planes.y)
                continue
            accepted = region.accepts(nominal, best, trial, program, solution, refinement, leaps)
            if not accepted and not at.linear:
                refinement = corrected(program, refinement, trial)
                trial = at.certify(program, refinement)
                accepted = region.accepts(
                    nominal, best, trial, program, solution, refinement, leaps
                )
            if self._settings.history:
                history.append(self._record(nominal, trial, program, solution, accepted))
            if not accepted and leaps and best is not None:
                nominal, planes, leaps, bold = best, best.planes, 0, False  # take the leap back
                continue
            if not accepted:
                if region.shrinks(nominal, program, refinement):
                    continue
                break
            before = inf if best is None else best.residuals.worst
            nominal, best, planes, worst = trial, trial, trial.planes, trial.residuals.worst
            if not (trial.slack.any() or trial.excess.any()):
                give = Relaxation.NOBODY
            enough = tolerance if before <= tolerance else _SURPLUS * tolerance
            product = trial.residuals.complementarity / min(1.0, max(trial.cost, _LEAST_COST))
            if max(worst, product) <= enough:
                best, direction = at.second_order(trial, program, refinement)
                away = None
                if best.residuals.curvature < -BENT:  # a saddle is not an end, but a way down
                    away = downhill(at, trial, direction)
                if away is None:
                    break
                nominal, planes, leaps, bold = away, away.planes, 0, True
                continue
            if goal is not None and self._vain(iterations, trial, goal):
                return None
            leaps = 0 if ahead is None else leaps + 1
            bold = not at.linear or leaps > 0 or refinement is solution or worst < before / 2
            if ahead is not None:
                planes = trial.pairs.planes(ahead)
        return None if best is None else self.result(best, give, iterations, tuple(history))

    def result(
        self,
        nominal: Nominal,
        give: Relaxation = Relaxation.NOBODY,
        iterations: int = 0,
        history: tuple[Record, ...] = (),
    ) -> Result:
        """Judge a plan."""
        at, residuals, tolerance = self._at, nominal.residuals, self._settings.tolerance
        most = float(max(nominal.slack.max(initial=0.0), nominal.excess.max(initial=0.0)))
        status, slack = judge(residuals, most, tolerance), nominal.slack
        if not status.certified and residuals.feasibility > tolerance:
            slack = np.maximum(-nominal.planes.g, 0.0)
        merit = at.merit(nominal.cost, float(slack.sum()), nominal.excess)
        soft = give is Relaxation.EVERYBODY
        iterate = at.iterate(nominal, at.problem.slack_weight if soft else inf)
        return Result(iterate, nominal.cost, merit, residuals, status, iterations, nominal, history)

    def _vain(self, iteration: int, trial: Nominal, goal: Result) -> bool:
        """Whether a run is too far above the goal, or about to end just there."""
        at, cost = self._at, trial.cost
        if goal.status.ok and iteration >= _PATIENCE and cost > _FAR * goal.merit:
            return True
        if not len(trial.force) or abs(cost - goal.cost) > _ALIKE * goal.cost:
            return False
        mine = Passing(at.path(trial.y)[1:], trial.pairs.table(trial.force) > NEGLIGIBLE)
        other = goal.iterate
        there = at.nodes.positions(other.states, other.inputs)
        return same_way(at.step, mine, Passing(there, other.touched[: at.step.count]))

    def _record(
        self,
        nominal: Nominal,
        trial: Nominal,
        program: Program,
        solution: QPSolution,
        accepted: bool,
    ) -> Record:
        at, planes, pairs = self._at, program.planes, program.pairs
        push = solution.force[len(program.qp.F) :] > NEGLIGIBLE
        return Record(
            cost=trial.cost,
            violation=float(np.maximum(-trial.planes.g, 0.0).max(initial=0.0)),
            residual=trial.residuals.worst,
            step=float(np.linalg.norm(trial.rollout.inputs - nominal.rollout.inputs)),
            accepted=accepted,
            iterations=program.subproblem.solver.iterations,
            positions=at.path(trial.y),
            obstacles=pairs.obstacle[push],
            normals=planes.a[push, :-1],
            points=at.path(planes.y)[pairs.node[push] + 1],
            values=planes.g[push],
        )


def judge(residuals: KKTResiduals, slack: float, tolerance: float) -> Status:
    """Return the status of a plan with the given residuals and largest slack."""
    inside = not (residuals.feasibility <= tolerance and slack <= tolerance)  # or NaN
    certified = residuals.worst <= tolerance and slack == slack
    if certified and not residuals.curvature < -BENT:
        return Status.SOFTENED if inside else Status.CONVERGED
    return Status.VIOLATING if inside else Status.FEASIBLE
