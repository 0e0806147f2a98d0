"""Sequential convex programming: the loop.

    nominal = the plan to start from
    repeat:  screen      which pairs of obstacle and node are near
             linearise   dynamics and half-spaces about the nominal
             write       values into the fixed pattern of the program
             solve       OSQP, warm-started; the active set that it names, solved exactly
             refine      Newton's step on that active set, where it exists (newton.py)
             certify     the plan it leads to, against the original problem (certificate.py)
             accept      that plan as the next nominal, or trust a smaller region
    until    certified, or the time is up

For a linear robot half-spaces are sound about any point, so the merit cannot rise and every plan is
accepted. Two cases have no Newton step there: where it would break a constraint, its end is where
to linearise next; where the convex steps lead away, for they grow, the next half-spaces are about a
point several steps ahead, and a leap that costs more is taken back. For a nonlinear robot the
region bounds what the inputs change by, and the merit is cost and penalty on all violations.
"""

from math import inf

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.qp.program import KKTResiduals
from scp_mpc.scp.candidates import Passing, same_way
from scp_mpc.scp.certificate import BENT, Nominal, with_curvature
from scp_mpc.scp.history import Record
from scp_mpc.scp.iterate import NEGLIGIBLE
from scp_mpc.scp.newton import corrected, downhill, refined
from scp_mpc.scp.plan import Result, Status
from scp_mpc.scp.transcription import Convex, Relaxation, Transcription
from scp_mpc.scp.trust_region import Region

_PATIENCE = 3  # iterations before a rival is given up
_FAR = 1.1  # share of the goal's merit above which it is
_SURPLUS = 1e-3  # of the tolerance: worth one more iteration, whose convergence is quadratic
_ALIKE = 0.01  # relative difference of cost of plans that may become the same


class Loop:
    """Solves control steps that a transcription has begun.

    Args:
        transcription: The step in numbers.
    """

    def __init__(self, transcription: Transcription) -> None:
        """Remember it, and the settings."""
        self._at, self._settings = transcription, transcription.settings

    def run(
        self,
        nominal: Nominal,
        goal: Result | None = None,
        about: FloatArray | None = None,
        screen: bool = True,
        firm: bool = False,
    ) -> Result | None:
        """Descend from a plan; None if not even the first program was solved, or if given up.

        Args:
            nominal: Where to begin.
            goal: Give up when it is plain that this plan will not be reached.
            about: (ny,) where the first half-spaces are taken, which need not obey the dynamics.
            screen: Whether to look for obstacles that were left out.
            firm: Whether to give up where the obstacles would have to yield.
        """
        at, settings, clock = self._at, self._settings, self._at.clock
        planes = nominal.planes if about is None else nominal.pairs.planes(about)
        region, relaxation, history = Region(at), Relaxation.NOBODY, []
        best: Nominal | None = None
        leaps, bold, iterations, began = 0, about is None, 0, clock.elapsed
        while iterations < settings.max_iterations and clock.allows("iteration"):
            iterations += 1
            clock.begin()
            condensed = at.condensed(nominal)
            clock.charge("linearise")
            levels = at.relaxations(firm, relaxation)
            if leaps:  # nobody yields for the sake of a leap
                levels = (relaxation,)
            convex = at.solve(nominal, condensed, planes, levels, region.radius)
            if convex is None and planes is not nominal.planes:
                planes, leaps, bold = nominal.planes, 0, False  # a leap too far
                continue
            if convex is None:
                break
            relaxation = convex.relaxation
            solution, ahead = refined(at, convex, leaps) if bold else (convex.solution, None)
            trial = at.reached(convex, solution)
            clock.charge("linearise")
            wider = at.screened(trial) if screen else None
            if wider is not None:  # solve again, with the pairs that were left out and violated
                own = planes is nominal.planes
                nominal = at.renewed(nominal, wider)
                planes = nominal.planes if own else wider.planes(planes.y)
                continue
            clock.learn("iteration", began)
            began = clock.elapsed
            accepted = region.accepts(nominal, best, trial, convex, solution, leaps)
            if not accepted and not at.linear:
                solution = corrected(convex, solution, trial)
                trial = at.reached(convex, solution)
                accepted = region.accepts(nominal, best, trial, convex, solution, leaps)
            if settings.history:
                history.append(self._record(nominal, trial, convex, accepted))
            if not accepted and best is not None and at.linear:
                nominal, planes, leaps, bold = best, best.planes, 0, False  # take the leap back
                continue
            if not accepted:
                if region.shrinks(nominal, convex, solution):
                    continue
                break
            before = inf if best is None else best.residuals.worst
            nominal = best = trial
            planes = trial.planes
            if not (trial.slack.any() or trial.excess.any()):
                relaxation = Relaxation.NOBODY
            worst = trial.residuals.worst
            if worst <= _SURPLUS * settings.tolerance or max(worst, before) <= settings.tolerance:
                least, direction = at.second_order(trial)
                best = with_curvature(trial, least)
                away = downhill(at, trial, direction) if least < -BENT else None
                if away is None:
                    break
                nominal, planes, leaps, bold = away, away.planes, 0, True  # it was a saddle
                continue
            if goal is not None and self._vain(iterations, trial, goal):
                return None
            leaps = leaps + 1 if ahead is not None and len(ahead) else 0
            bold = bool(leaps) or ahead is None or trial.residuals.worst < before / 2
            if ahead is not None and len(ahead):
                planes = trial.pairs.planes(ahead)
        return None if best is None else self.result(best, relaxation, iterations, tuple(history))

    def result(
        self,
        nominal: Nominal,
        relaxation: Relaxation = Relaxation.NOBODY,
        iterations: int = 0,
        history: tuple[Record, ...] = (),
    ) -> Result:
        """Judge a plan."""
        at, problem = self._at, self._at.problem
        tolerance = self._settings.tolerance
        residuals = nominal.residuals
        status = judge(residuals, _most(nominal), tolerance)
        slack = float(nominal.slack.sum())
        if not status.certified and residuals.feasibility > tolerance:
            slack = float(np.maximum(-nominal.planes.g, 0.0).sum())
        merit = at.merit(nominal.cost, slack, nominal.excess)
        soft = relaxation is Relaxation.EVERYBODY
        iterate = at.iterate(nominal, problem.slack_weight if soft else inf)
        return Result(iterate, nominal.cost, merit, residuals, status, iterations, nominal, history)

    def _vain(self, iteration: int, trial: Nominal, goal: Result) -> bool:
        """Whether a run is too far above the goal, or about to end just there."""
        at, cost = self._at, trial.cost
        if goal.status.ok and iteration >= _PATIENCE and cost > _FAR * goal.merit:
            return True
        if not len(trial.force) or abs(cost - goal.cost) > _ALIKE * goal.cost:
            return False
        mine = Passing(at.path(trial.y)[1:], trial.pairs.table(trial.force > NEGLIGIBLE))
        other = goal.iterate
        there = at.nodes.positions(other.states, other.inputs)
        return same_way(at.step, mine, Passing(there, other.touched[: at.step.count]))

    def _record(self, nominal: Nominal, trial: Nominal, convex: Convex, accepted: bool) -> Record:
        change = trial.rollout.inputs - nominal.rollout.inputs
        at, planes, pairs = self._at, convex.planes, convex.pairs
        solver = (at.elastic if convex.relaxation else at.firm).solver
        push = convex.solution.force[len(convex.qp.F) :] > NEGLIGIBLE
        return Record(
            cost=trial.cost,
            violation=float(np.maximum(-trial.planes.g, 0.0).max(initial=0.0)),
            residual=trial.residuals.worst,
            step=float(np.linalg.norm(change)),
            accepted=accepted,
            iterations=int(getattr(solver.backend, "iterations", 0)),
            positions=at.path(trial.y),
            obstacles=pairs.obstacle[push],
            normals=planes.a[push, :-1],
            points=at.path(planes.y)[pairs.node[push] + 1],
            values=planes.g[push],
        )


def _most(nominal: Nominal) -> float:
    """Largest slack of a plan [m, or unit of a state]."""
    return float(max(nominal.slack.max(initial=0.0), nominal.excess.max(initial=0.0)))


def judge(residuals: KKTResiduals, slack: float, tolerance: float) -> Status:
    """Return the status of a plan with the given residuals and largest slack."""
    inside = not (residuals.feasibility <= tolerance and slack <= tolerance)  # or NaN
    if residuals.worst <= tolerance and slack == slack and not residuals.curvature < -BENT:
        return Status.SOFTENED if inside else Status.CONVERGED
    return Status.VIOLATING if inside else Status.FEASIBLE
