"""The fallback hierarchy: what to do when the search has no plan that meets every constraint.

1. the certified plan       2. a feasible iterate
3. the last plan, shifted: its inputs from the state now, rechecked against the new predictions
4. braking at the model's limits, checked likewise
5. whatever violates least
"""

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.problem import Problem
from scp_mpc.qp.program import KKTResiduals
from scp_mpc.scp.iterate import Iterate
from scp_mpc.scp.plan import Result, Status
from scp_mpc.scp.step import Step

_AT_REST = 1e-9  # of an input, in its own unit, that is none


class Fallback:
    """Plans that need no program.

    Args:
        problem: What they are judged by.
        tolerance: Violation that is none [m].
    """

    def __init__(self, problem: Problem, tolerance: float) -> None:
        """Remember both."""
        self._problem, self._tolerance = problem, tolerance
        self._rest = np.clip(problem.model.equilibrium_input, problem.u_min, problem.u_max)

    def best(self, step: Step, last: Iterate | None) -> Result:
        """The last plan, if it meets every constraint; else braking, whether it does or not."""
        kept = None if last is None else self.keep(step, last.inputs)
        return kept if kept is not None and kept.status.ok else self.brake(step)

    def lesser(self, found: Result, braking: Result) -> Result:
        """Of two plans with a violation, a certified one, else the one with less.

        The largest slack and the largest excess of a state count at their prices.
        """
        if found.status.certified:
            return found
        return found if self._violation(found) <= self._violation(braking) else braking

    def _violation(self, end: Result) -> float:
        problem, iterate = self._problem, end.iterate
        most = problem.slack_weight * float(iterate.slack.max(initial=0.0))
        most += problem.state_slack_weight * float(problem.excess(iterate.states).max())
        return np.inf if np.isnan(most) else most

    def keep(self, step: Step, inputs: FloatArray) -> Result:
        """Roll the last plan's inputs (N, nu) out from the state now."""
        return self._judged(step, self._problem.limited(inputs, step.u_last), Status.PREVIOUS)

    def brake(self, step: Step, status: Status = Status.BRAKING) -> Result:
        """Bring the robot to rest, as hard as the bounds allow, in the direction it moves."""
        problem = self._problem
        U, stop = np.tile(self._rest, (problem.horizon, 1)), self.stopping(step.x0, step.u_last)[0]
        U[: len(stop)] = stop
        return self._judged(step, problem.limited(U, step.u_last), status)

    def stopping(
        self, x: FloatArray, last: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Inputs (k, nu) that bring the robot to rest from x, k <= N, and states (k+1, nx)."""
        problem, inputs, states = self._problem, [], [x]
        for _ in range(problem.horizon):
            stop = self._stop(states[-1])
            if stop is None:
                break
            last = problem.limited(stop[None], last)[0]
            inputs.append(last)
            states.append(problem.model.step(states[-1], last))
        return np.array(inputs).reshape(-1, problem.model.nu), np.array(states)

    def depths(self, step: Step, inputs: FloatArray) -> FloatArray:
        """How deep (J, C) [m] a plan enters the no-go sets, by its own motion between the nodes."""
        return self._judged(step, inputs, Status.PREVIOUS).iterate.slack[: step.count]

    def _stop(self, x: FloatArray) -> FloatArray | None:
        """The input (nu,) that stops the robot, as far as the bounds allow; None at rest."""
        problem, rest = self._problem, self._rest
        wanted = problem.model.stopping_input(x) - rest
        if not float(np.abs(wanted).max()) > _AT_REST:  # or NaN
            return None
        # In the direction of what is wanted; inputs without any room stay where they are.
        room = np.where(wanted > 0, problem.u_max - rest, problem.u_min - rest)
        none = np.abs(room) <= _AT_REST
        wanted, room = np.where(none, 0.0, wanted), np.where(none, 1.0, room)
        stop: FloatArray = rest + wanted / max(1.0, float((wanted / room).max()))
        return stop

    def _judged(self, step: Step, inputs: FloatArray, status: Status) -> Result:
        """The trajectory of inputs with its true violation; FALLBACK where there is any."""
        problem = self._problem
        states = np.empty((len(inputs) + 1, problem.model.nx))
        states[0] = step.x0
        for i, u in enumerate(inputs):
            states[i + 1] = problem.model.step(states[i], u)
        lost = ~np.isfinite(states).all(axis=1)
        if lost.any():  # where the model has no next state, it stays in the last one
            states[lost] = states[int(lost.argmax()) - 1]
            status = Status.FALLBACK if status.ok else status
        s = np.full(problem.max_obstacles, problem.size.reference)
        s[: step.count] = problem.size.lower  # all that a plan without a search can promise
        if step.count and step.nodes.instants > 1:  # between them it is judged by its own motion
            motion = step.nodes.motion(states, inputs)
            step = step.widened(step.nodes.radii(step.radii, step.drift, motion))
        slack = np.zeros((problem.max_obstacles, step.nodes.size))
        slack[: step.count] = step.depths(step.nodes.positions(states, inputs), s)
        most = float(np.maximum(slack.max(initial=0.0), problem.excess(states).max()))  # or NaN
        if status.ok and not most <= self._tolerance:
            status = Status.FALLBACK
        cost = problem.cost(states, inputs, s, step.x_ref)
        merit = cost + problem.penalty(slack, states)
        residuals = KKTResiduals(np.inf, most, np.inf)
        return Result(Iterate(states, inputs, s, slack).frozen(), cost, merit, residuals, status, 0)
