"""The KKT residual of the original problem, computed from its own data at a condensed solution.

Inputs are rolled out through the dynamics, gradients are taken at the rolled-out positions, and
multipliers nu of the dynamics follow backwards from stationarity in the states,

    D' nu = phi_e - 2 Q e,     then in the inputs     2 R u - B' nu - phi_u - beta = 0

has to hold (phi_u: forces on points between two samples), and for sizes that move
2 w (s - s_ref) - phi_s - beta_s = 0.

Notation:
    e, u, s     deviations, inputs and sizes
    lambda      (K,)    forces on the pairs of obstacle and stage, non-negative
    phi         (ny,)   sum_k lambda_k grad g_k: forces on positions and sizes
    beta        (nf,)   forces of the bounds, positive at lower ones
"""

from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.problem import Problem
from scp_mpc.solver.condensed import Condensed
from scp_mpc.solver.conflicts import Conflicts, Tangent
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


@dataclass(frozen=True, eq=False)
class Point:
    """A plan with its forces and its residuals.

    Attributes:
        y: (ny,) outputs, their positions rolled out from the inputs.
        deviations: (N, nx) e.
        costates: (N, nx) nu.
        reaction: (nf,) beta.
        pushed: The obstacles' part; None if none is near.
        cost: Objective without slack.
        residuals: KKT residuals of the original problem.
    """

    y: FloatArray
    deviations: FloatArray
    costates: FloatArray
    reaction: FloatArray
    pushed: Pushed | None
    cost: float
    residuals: KKTResiduals

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
        condensed: Rolls inputs out.
    """

    def __init__(self, problem: Problem, condensed: Condensed) -> None:
        """Remember the problem."""
        self._problem, self._condensed = problem, condensed

    def rolled_out(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Clip the inputs in y to their bounds; return y and e with the positions they lead to."""
        model, c = self._problem.model, self._condensed
        y = np.minimum(np.maximum(y, c.lower), c.upper)
        e = c.deviations(y[c.u].reshape(-1, model.nu))
        y[c.p] = c.sampling.deviations(e, y[c.u].reshape(-1, model.nu)).ravel()
        return y, e

    def certify(
        self, y: FloatArray, e: FloatArray, reaction: FloatArray, pushed: Pushed | None
    ) -> Point:
        """Return the point with its residuals.

        Args:
            y: (ny,) outputs.
            e: (N, nx) deviations that belong to its inputs.
            reaction: (nf,) forces of the bounds.
            pushed: The obstacles' part.
        """
        problem, c = self._problem, self._condensed
        model, w = problem.model, problem.size.weight
        u, away = y[c.u].reshape(-1, model.nu), y[c.s] - problem.size.reference
        track, effort = e @ problem.Q, u @ problem.R
        track[-1] = e[-1] @ problem.Qf
        cost = float(np.vdot(track, e) + np.vdot(effort, u) + w * (away @ away))
        scale = max(1.0, 2 * float(np.abs(track).max()), 2 * float(np.abs(effort).max()))
        pull = -2 * track
        gradient = np.empty(len(reaction))
        feasibility = product = 0.0
        on_u = None
        if pushed is not None:
            weights = (pushed.force[:, None] * pushed.tangent.a).ravel()
            at = pushed.conflicts.at.ravel()
            phi = np.bincount(at, weights=weights, minlength=len(y)).astype(np.float64)
            on_e, on_u = c.sampling.pull(phi[c.p])
            pull += on_e
            gap = pushed.tangent.g + pushed.slack
            feasibility = max(0.0, -float(gap.min()))
            product = max(-float(pushed.force.min()), float(np.abs(pushed.force * gap).max()))
        nu = c.costates(pull)
        thrust = 2 * effort - nu @ model.B
        if on_u is not None:
            thrust -= on_u
        gradient[: u.size] = thrust.ravel()
        if c.moving_sizes:
            gradient[u.size :] = 2 * w * away - (0.0 if pushed is None else phi[c.s])
        if reaction.any():
            boxed = y[c.boxed]
            room = np.where(reaction > 0, boxed - c.lower[c.boxed], c.upper[c.boxed] - boxed)
            product = max(product, float((np.abs(reaction) * room).max()))
            gradient -= reaction
        stationarity = float(np.abs(gradient).max()) / scale
        residuals = KKTResiduals(stationarity, feasibility, product / max(1.0, cost))
        return Point(y, e, nu, reaction, pushed, cost, residuals)
