"""The last rungs of the ladder: what to do when the search has no plan that meets every constraint.

1. the certified plan       2. a feasible iterate
3. the last plan, shifted: its inputs rolled out from the state now, and rechecked against the
new predictions
4. braking at the model's limits, checked likewise
5. whatever violates least
"""

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.problem import Problem
from scp_mpc.solver.descent import Descent
from scp_mpc.solver.iterate import Iterate
from scp_mpc.solver.plan import Status
from scp_mpc.solver.program import KKTResiduals
from scp_mpc.solver.step_data import StepData
from scp_mpc.trajectory import rollout


class Ladder:
    """Plans that need no program.

    Args:
        problem: What they are judged by.
        tolerance: Violation that is none [m].
    """

    def __init__(self, problem: Problem, tolerance: float) -> None:
        """Remember both."""
        self._problem, self._tolerance = problem, tolerance

    def resort(self, step: StepData, last: Iterate | None) -> Descent:
        """The last plan, if it meets every constraint; else braking, whether it does or not."""
        kept = None if last is None else self.keep(step, last.inputs)
        return kept if kept is not None and kept.status.ok else self.brake(step)

    def lesser(self, found: Descent, braking: Descent) -> Descent:
        """Of two plans with a violation, a certified one, else the one with less."""
        if found.status.certified:
            return found
        most = (float(end.iterate.slack.max(initial=0.0)) for end in (found, braking))
        return min(zip(most, (found, braking), strict=True), key=lambda pair: pair[0])[1]

    def keep(self, step: StepData, inputs: FloatArray) -> Descent:
        """Roll the last plan's inputs (N, nu) out from the state now."""
        problem = self._problem
        return self._judged(step, np.clip(inputs, problem.u_min, problem.u_max), Status.PREVIOUS)

    def brake(self, step: StepData, status: Status = Status.BRAKING) -> Descent:
        """Bring the robot to rest, as hard as the bounds allow, in the direction it moves."""
        problem, x = self._problem, step.x0
        rest = np.clip(np.zeros(problem.model.nu), problem.u_min, problem.u_max)
        inputs = np.tile(rest, (problem.horizon, 1))
        for u in inputs:
            wanted = problem.model.brake(x) - rest
            if not wanted.any():
                break
            room = np.where(wanted > 0, problem.u_max - rest, problem.u_min - rest)
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.where(wanted == 0, 1.0, room / wanted).min()
            u += min(1.0, share) * wanted
            x = problem.model.step(x, u)
        return self._judged(step, np.clip(inputs, problem.u_min, problem.u_max), status)

    def _judged(self, step: StepData, inputs: FloatArray, status: Status) -> Descent:
        """The trajectory of some inputs, with its true violation; FALLBACK where there is any."""
        problem = self._problem
        states = rollout(problem.model.step, step.x0, inputs).states
        s = np.full(problem.max_obstacles, problem.size.lower)
        slack = np.zeros((problem.max_obstacles, step.sampling.points))
        slack[: step.count] = step.depths(step.sampling.positions(states, inputs), s)
        if status.ok and slack.max(initial=0.0) > self._tolerance:
            status = Status.FALLBACK
        residuals = KKTResiduals(np.inf, float(slack.max(initial=0.0)), np.inf)
        cost = problem.cost(states, inputs, s, step.x_ref)
        merit = cost + problem.slack_weight * float(slack.sum())
        iterate = Iterate(states, inputs, s, slack)
        return Descent(iterate.frozen, cost, merit, residuals, status, 0)
