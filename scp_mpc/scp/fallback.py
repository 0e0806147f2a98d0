"""The fallback hierarchy: what to do when the search has no plan that meets every constraint.

1. the certified plan       2. a feasible iterate
3. the last plan, shifted: its inputs from the state now, rechecked against the new predictions
4. braking at the model's limits, checked likewise
5. the plan with slack, or as much of it as leaves time to brake before it violates anything
6. braking, whatever is in the way
"""

from dataclasses import replace

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.problem import Problem
from scp_mpc.qp.program import KKTResiduals
from scp_mpc.scp.braking import AT_REST, braking, resting_input
from scp_mpc.scp.iterate import Iterate
from scp_mpc.scp.plan import Result, Status
from scp_mpc.scp.step import Step

_STANDS = 0.3  # [m/s] up to which an obstacle does, whose velocity is estimated


class Fallback:
    """Plans that need no program.

    Args:
        problem: What they are judged by.
        tolerance: Violation that is none [m].
    """

    def __init__(self, problem: Problem, tolerance: float) -> None:
        """Remember both."""
        self._problem, self._tolerance = problem, tolerance

    def best(
        self,
        step: Step,
        last: Iterate | None,
        found: Result | None = None,
        brake_first: bool = False,
    ) -> Result:
        """The last plan or braking, if it meets every constraint; else what is passively safe.

        Args:
            step: The step.
            last: The last plan, shifted; or None.
            found: What a search ended with, that does not meet every constraint; or None.
            brake_first: Whether braking comes before the last plan.
        """
        brake = self.brake(step) if brake_first or last is None else None
        if brake is not None and brake.status.ok:
            return brake
        kept = None if last is None else self.keep(step, last.inputs)
        if kept is not None and kept.status.ok:
            return kept
        brake = self.brake(step) if brake is None else brake
        if brake.status.ok:
            return brake
        return self.stopping(step, brake, found, kept)

    def stopping(self, step: Step, brake: Result, *plans: Result | None) -> Result:
        """The first plan, or the longest head of one followed by braking, that is passively safe.

        Passively safe is who violates nothing, or no faster than full braking from now on would
        be at that time: whoever is in the way then finds the robot at rest, or as slow as can be
        (passive motion safety: Macek, Vasquez, Fraichard and Siegwart, 2009). What stands and is
        entered already may be left. Braking alone always is safe in this sense; whether it comes
        to rest in time is what its status says.

        Args:
            step: The step.
            brake: Braking from now on.
            plans: With slack, or not feasible, in order of preference.
        """
        problem = self._problem
        known = [plan for plan in plans if plan is not None]
        for plan in known:
            if self._is_passive(step, plan, brake):
                return plan if plan.status.certified else replace(plan, status=Status.STOPPING)
        head = problem.horizon
        while head > 1:
            head //= 2
            for plan in known:
                inputs = plan.iterate.inputs[:head]
                stop = braking(problem, plan.iterate.states[head], inputs[-1])[0]
                rest = np.tile(resting_input(problem), (problem.horizon, 1))
                whole = np.concatenate([inputs, stop, rest])[: problem.horizon]
                tried = self._judged(step, whole, Status.STOPPING)
                if self._is_passive(step, tried, brake):
                    return tried
        deep = self._stages(step, brake).max(axis=0, initial=0.0) > self._tolerance
        if (self._ways(brake)[deep] <= AT_REST * problem.model.dt).all():
            return replace(brake, status=Status.STOPPING)
        return brake

    def _is_passive(self, step: Step, plan: Result, brake: Result) -> bool:
        """Whether a plan is as slow as braking where it violates anything, or leaves it."""
        tolerance, hard = self._tolerance, ~self._problem.soft_rows
        excess, most = (
            self._problem.row_excess(one.iterate.states)[:, hard].max(initial=0.0)
            for one in (plan, brake)
        )
        if plan.residuals.feasibility == np.inf or excess > most + tolerance:
            return False
        depths, dt = self._stages(step, plan), self._problem.model.dt
        slow = self._ways(plan) <= self._ways(brake) + AT_REST * dt
        leaves = depths <= self._stages(step, brake) + tolerance
        leaves[:, 1:] &= depths[:, 1:] <= depths[:, :-1] + tolerance
        means = step.means[:, :: step.nodes.count]
        stands = np.linalg.norm(np.diff(means, axis=1), axis=2).max(axis=1) <= _STANDS * dt
        return bool(((depths <= tolerance) | slow | (leaves & stands[:, None])).all())

    def _stages(self, step: Step, plan: Result) -> FloatArray:
        """How deep (J, N) a plan enters the no-go sets in each interval [m]."""
        return step.nodes.stages(plan.iterate.slack[: step.count]).max(axis=2, initial=0.0)

    def _ways(self, plan: Result) -> FloatArray:
        """How far the robot goes in each interval (N,) [m]."""
        path = plan.iterate.states[:, self._problem.model.position]
        return np.linalg.norm(np.diff(path, axis=0), axis=1)

    def keep(self, step: Step, inputs: FloatArray) -> Result:
        """Roll the last plan's inputs (N, nu) out from the state now."""
        return self._judged(step, self._problem.limited(inputs, step.u_last), Status.PREVIOUS)

    def brake(self, step: Step, status: Status = Status.BRAKING) -> Result:
        """Bring the robot to rest, as hard as the bounds allow, in the direction it moves."""
        problem = self._problem
        U, stop = np.tile(resting_input(problem), (problem.horizon, 1)), step.braking[0]
        U[: len(stop)] = stop
        return self._judged(step, problem.limited(U, step.u_last), status)

    def depths(self, step: Step, inputs: FloatArray) -> FloatArray:
        """How deep (J, C) [m] a plan enters the no-go sets, by its own motion between the nodes."""
        return self._judged(step, inputs, Status.PREVIOUS).iterate.slack[: step.count]

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
        s = np.full(problem.max_obstacles, problem.size.reference)
        s[: step.count] = problem.size.lower  # all that a plan without a search can promise
        if step.count and step.nodes.instants > 1:  # between them it is judged by its own motion
            motion = step.nodes.motion(states, inputs)
            step = step.widened(step.nodes.radii(step.radii, step.drift, motion))
        slack = np.zeros((problem.max_obstacles, step.nodes.size))
        slack[: step.count] = step.depths(step.nodes.positions(states, inputs), s)
        outside = problem.row_excess(states).max(initial=0.0)
        most = float(np.maximum(slack.max(initial=0.0), outside))  # or NaN
        most = np.inf if lost.any() else most
        if status.ok and not most <= self._tolerance:
            status = Status.FALLBACK
        cost = problem.cost(states, inputs, s, step.x_ref)
        merit = cost + problem.penalty(slack, states)
        residuals = KKTResiduals(np.inf, most, np.inf)
        return Result(Iterate(states, inputs, s, slack).frozen(), cost, merit, residuals, status, 0)
