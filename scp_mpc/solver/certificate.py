"""The KKT residual of the original problem, computed from its own data at a condensed solution.

Inputs are rolled out through the dynamics, derivatives are taken along the rolled-out plan, and
multipliers nu of the dynamics follow backwards from stationarity in the states,

    D' nu = phi_e - 2 Q e,     then in the inputs     2 R u - B' nu - phi_u = 0

has to hold, and for sizes that move 2 w (s - s_ref) - phi_s = 0.

Notation:
    e, u, s     deviations, inputs and sizes
    lambda      (K,)    forces on the pairs of obstacle and stage, non-negative
    beta        (nf,)   forces of the bounds, positive at lower ones
    phi         (ny,)   forces of all constraints: sum_k lambda_k grad g_k on positions and sizes
                        (positions between samples pass theirs on to states and inputs), and beta
"""

from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.problem import Problem
from scp_mpc.solver.chart import Rolled
from scp_mpc.solver.conflicts import Conflicts, Tangent
from scp_mpc.solver.layout import Layout
from scp_mpc.solver.program import KKTResiduals


@dataclass(frozen=True, eq=False)
class Pushed:
    """The obstacles' part of a point.

    Attributes:
        tangent: Their constraints, linearised there.
        force: (K,) lambda.
        slack: (K,) violation of the pairs that yield [m].
        conflicts: The pairs.
    """

    tangent: Tangent
    force: FloatArray
    slack: FloatArray
    conflicts: Conflicts

    def on(self, size: int) -> FloatArray:
        """Phi (ny,), on positions and sizes."""
        weights = (self.force[:, None] * self.tangent.a).ravel()
        return np.bincount(self.conflicts.at.ravel(), weights, size).astype(np.float64)


@dataclass(frozen=True, eq=False)
class Point:
    """A plan with its forces and its residuals.

    Attributes:
        y: (ny,) outputs, their positions rolled out from the inputs.
        rolled: The plan that its inputs lead to.
        costates: (N, nx) nu.
        reaction: (nf,) beta.
        pushed: The obstacles' part; None if none is near.
        cost: Objective without slack.
        residuals: KKT residuals of the original problem.
        excess: (N nb,) how far the bounded states exceed their bounds.
    """

    y: FloatArray
    rolled: Rolled
    costates: FloatArray
    reaction: FloatArray
    pushed: Pushed | None
    cost: float
    residuals: KKTResiduals
    excess: FloatArray

    @property
    def tangent(self) -> Tangent:
        """The obstacles' constraints about this point, where some are near."""
        assert self.pushed is not None
        return self.pushed.tangent

    @property
    def slack(self) -> float:
        """Sum of the violations [m]."""
        return 0.0 if self.pushed is None else float(self.pushed.slack.sum())


class Certificate:
    """Computes the residuals of condensed solutions.

    Args:
        problem: Whose KKT conditions are checked.
        layout: What y holds.
    """

    def __init__(self, problem: Problem, layout: Layout) -> None:
        """Remember the problem."""
        self._problem, self._layout = problem, layout

    def costates(
        self, rolled: Rolled, e: FloatArray, reaction: FloatArray, pushed: Pushed | None
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Multipliers nu (N, nx) at deviations e, forces on u (N, nu) and on s (M,)."""
        problem, c = self._problem, self._layout
        pull = -2 * (e @ problem.Q)
        pull[-1] = -2 * (e[-1] @ problem.Qf)
        on_u, on_s = np.zeros(c.shape), np.zeros(problem.max_obstacles)
        if pushed is not None:
            phi = pushed.on(c.size)
            on_e, between = rolled.motion.pull(phi[c.p])
            pull += on_e
            on_s = phi[c.s]
            if between is not None:
                on_u = between
        if reaction.any():
            bound_e, bound_u = c.pushed(reaction)
            on_u = on_u + bound_u
            if bound_e is not None:
                pull += bound_e
            if c.moving:
                on_s = on_s + reaction[: c.moving]
        return rolled.motion.costates(pull), on_u, on_s

    def certify(
        self,
        y: FloatArray,
        rolled: Rolled,
        reaction: FloatArray,
        pushed: Pushed | None,
        bounds: tuple[FloatArray, FloatArray],
    ) -> Point:
        """Return the point with its residuals.

        Args:
            y: (ny,) outputs.
            rolled: The plan that belongs to its inputs.
            reaction: (nf,) forces of the bounds.
            pushed: The obstacles' part.
            bounds: Of y in this step.
        """
        problem, c = self._problem, self._layout
        u, e, w = rolled.inputs, rolled.deviations, problem.size.weight
        away = y[c.s] - problem.size.reference
        push = u - problem.model.idle
        track, effort = e @ problem.Q, push @ problem.R
        track[-1] = e[-1] @ problem.Qf
        cost = float(np.vdot(track, e) + np.vdot(effort, push) + w * (away @ away))
        scale = max(1.0, 2 * float(np.abs(track).max()), 2 * float(np.abs(effort).max()))
        nu, on_u, on_s = self.costates(rolled, e, reaction, pushed)
        stationarity = float(np.abs(2 * effort - rolled.motion.thrust(nu) - on_u).max())
        if c.moving:
            stationarity = max(stationarity, float(np.abs(2 * w * away - on_s).max()))
        feasibility = product = 0.0
        if pushed is not None:
            gap = pushed.tangent.g + pushed.slack
            feasibility = max(0.0, -float(gap.min()))
            product = max(-float(pushed.force.min()), float(np.abs(pushed.force * gap).max()))
        lower, upper = (b[c.boxed] for b in bounds)
        boxed = y[c.boxed]
        excess = np.zeros(0)
        if c.size > c.u.stop:  # changes and states can be beyond their bounds; nothing else can
            beyond = np.maximum(0.0, np.maximum(lower - boxed, boxed - upper))
            excess = beyond[c.yielding]
            firm = beyond[: c.yielding.start].max()
            yields = np.abs(reaction[c.yielding]) >= problem.state_slack_weight
            feasibility = max(
                feasibility, float(firm), float(np.where(yields, 0.0, excess).max(initial=0.0))
            )
        if reaction.any():
            room = np.where(reaction > 0, boxed - lower, upper - boxed)
            if len(excess):
                room[c.yielding] += np.where(yields, excess, 0.0)
            product = max(product, float(np.abs(reaction * room)[reaction != 0].max()))
        residuals = KKTResiduals(stationarity / scale, feasibility, product / max(1.0, cost))
        return Point(y, rolled, nu, reaction, pushed, cost, residuals, excess)
