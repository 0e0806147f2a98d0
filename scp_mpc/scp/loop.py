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
from scp_mpc.scp.certificate import BENT, Nominal
from scp_mpc.scp.history import Record, recorded
from scp_mpc.scp.newton import corrected, downhill, refined
from scp_mpc.scp.plan import Result, judge
from scp_mpc.scp.rivals import is_vain
from scp_mpc.scp.transcription import Relaxation, Transcription
from scp_mpc.scp.trust_region import Region

_SURPLUS = 0.1  # of the tolerance: worth one more iteration, whose convergence is quadratic
_LEAST_COST = 1e-3  # relative to which products of forces and gaps are judged


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
        at, clock, history = self._at, self._at.clock, list[Record]()
        planes = nominal.planes if about is None else nominal.pairs.planes(about)
        region, give, leaps, bold, iterations = Region(at), Relaxation.NOBODY, 0, True, 0
        best: Nominal | None = None
        limit = self._settings.max_iterations if limit is None else limit
        while iterations < limit and clock.allows("iteration"):
            with clock.task("iteration"):
                condensed = at.linearise(nominal)
                program = at.write(nominal, condensed, planes, give, region.radius)
                end = at.solve(program, nominal)
                solution = end.solution
                if solution is not None:
                    step, ahead = (
                        refined(at, program, solution, leaps) if bold else (solution, None)
                    )
                    trial = at.certify(program, step)
            if solution is None:
                if planes is not nominal.planes and best is not None:
                    planes, leaps, bold = nominal.planes, 0, False  # it was a leap too far
                    continue
                more = at.next_relaxation(give, firm or not len(nominal.force))
                if more is None or end.late:
                    break
                give = more
                continue
            iterations += 1
            left_out = at.screen(trial) if screen else None
            if left_out is not None:  # they enter, and the program is solved again
                own, nominal = planes is nominal.planes, at.with_pairs(nominal, left_out)
                planes = nominal.planes if own else left_out.planes(planes.y)
                continue
            accepted = region.accepts(nominal, best, trial, program, solution, step, leaps)
            if not accepted and not at.linear:
                step = corrected(program, step, trial)
                trial = at.certify(program, step)
                accepted = region.accepts(nominal, best, trial, program, solution, step, leaps)
            if self._settings.history:
                history.append(recorded(at, nominal, program, solution, trial, accepted))
            if not accepted:
                if leaps and best is not None:
                    nominal, planes, leaps, bold = best, best.planes, 0, False  # take it back
                elif not region.shrinks(nominal, program, step):
                    break
                continue
            before, residuals = inf if best is None else best.residuals.worst, trial.residuals
            nominal = best = trial
            give = give if trial.slack.any() or trial.excess.any() else Relaxation.NOBODY
            if self._is_converged(trial, before):
                best, direction = at.second_order(trial, program, step)
                saddle = best.residuals.curvature < -BENT
                away = downhill(at, trial, direction) if saddle else None
                if away is None:
                    break
                nominal, planes, leaps, bold = away, away.planes, 0, True
                continue
            if goal is not None and is_vain(at, iterations, trial, goal):
                return None
            leaps = 0 if ahead is None else leaps + 1
            planes = trial.planes if ahead is None else trial.pairs.planes(ahead)
            bold = not at.linear or leaps > 0 or step is solution or residuals.worst < before / 2
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
        cap = at.problem.slack_weight if give is Relaxation.EVERYBODY else inf
        iterate = at.iterate(nominal, cap)
        return Result(iterate, nominal.cost, merit, residuals, status, iterations, nominal, history)

    def _is_converged(self, trial: Nominal, before: float) -> bool:
        """Whether a plan is certified, and another iteration would hardly better it."""
        tolerance, residuals = self._settings.tolerance, trial.residuals
        product = residuals.complementarity / min(1.0, max(trial.cost, _LEAST_COST))
        enough = tolerance if before <= tolerance else _SURPLUS * tolerance
        return max(residuals.worst, product) <= enough
