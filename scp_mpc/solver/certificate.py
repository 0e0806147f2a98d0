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

_NOTHING = np.zeros(0)


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
        idle = problem.model.idle
        self._idle = idle if idle.any() else None

    def track(self, e: FloatArray) -> FloatArray:
        """Q e (N, nx): half the cost's gradient in deviations e."""
        track = e @ self._problem.Q
        track[-1] = e[-1] @ self._problem.Qf
        return track

    def costates(
        self,
        rolled: Rolled,
        track: FloatArray,
        reaction: FloatArray | None,
        pushed: Pushed | None,
    ) -> tuple[FloatArray, FloatArray | None, FloatArray | None]:
        """Multipliers nu (N, nx), and the forces on u (N, nu) and s (M,), or None for none.

        Args:
            rolled: The plan about which the dynamics are linearised.
            track: (N, nx) half the cost's gradient in e.
            reaction: (nf,) forces of the bounds, or None.
            pushed: The obstacles' part.
        """
        c, pull = self._layout, -2 * track
        on_u = on_s = None
        if pushed is not None:
            phi = pushed.on(c.size)
            on_e, on_u = rolled.motion.pull(phi[c.p])
            pull += on_e
            on_s = phi[c.s]
        if reaction is not None:
            bound_e, bound_u = c.pushed(reaction)
            on_u = bound_u if on_u is None else on_u + bound_u
            if bound_e is not None:
                pull += bound_e
            if c.moving:
                on_s = reaction[: c.moving] if on_s is None else on_s + reaction[: c.moving]
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
        push = u if self._idle is None else u - self._idle
        track, effort = self.track(e), push @ problem.R
        cost = float(np.vdot(track, e) + np.vdot(effort, push) + w * (away @ away))
        scale = max(1.0, 2 * float(np.abs(track).max()), 2 * float(np.abs(effort).max()))
        force = reaction if reaction.any() else None
        nu, on_u, on_s = self.costates(rolled, track, force, pushed)
        thrust = 2 * effort - rolled.motion.thrust(nu)
        if on_u is not None:
            thrust -= on_u
        stationarity = float(np.abs(thrust).max())
        if c.moving:
            pull = 2 * w * away if on_s is None else 2 * w * away - on_s
            stationarity = max(stationarity, float(np.abs(pull).max()))
        feasibility = product = 0.0
        if pushed is not None:
            gap = pushed.tangent.g + pushed.slack
            feasibility = max(0.0, -float(gap.min()))
            product = max(-float(pushed.force.min()), float(np.abs(pushed.force * gap).max()))
        excess = _NOTHING
        if force is not None or c.size > c.u.stop:
            (lower, upper), boxed = bounds, y[c.boxed]
            below, above = boxed - lower[c.boxed], upper[c.boxed] - boxed
            slack = np.zeros(len(boxed))
            if c.size > c.u.stop:  # only changes and states can be beyond their bounds
                beyond = np.maximum(0.0, -np.minimum(below, above))
                excess = beyond[c.yielding]
                yields = np.abs(reaction[c.yielding]) >= problem.state_slack_weight
                slack[c.yielding] = np.where(yields, excess, 0.0)
                feasibility = max(feasibility, float((beyond - slack).max()))
            if force is not None:
                room = np.abs(force * (np.where(force > 0, below, above) + slack))
                product = max(product, float(room[force != 0].max()))
        residuals = KKTResiduals(stationarity / scale, feasibility, product / max(1.0, cost))
        return Point(y, rolled, nu, reaction, pushed, cost, residuals, excess)
