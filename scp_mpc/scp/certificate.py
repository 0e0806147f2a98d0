"""The certificate: KKT conditions of the original problem, of first and of second order.

Inputs are rolled out through the dynamics, derivatives are taken along the rolled-out plan, and
multipliers nu of the dynamics follow backwards from stationarity in the states,

    D' nu = phi_e - 2 Q e,     then in the inputs     2 R u - B' nu - phi_u = 0

has to hold, and for sizes that move 2 w (s - s_ref) - phi_s = 0. A point where all this holds may
still be a saddle. So the Lagrangian's second derivative must not bend down in any direction in
which the strongly active constraints allow to move, to first order, and the weakly active ones too.

Notation:
    e, u, s     deviations, inputs and sizes
    lambda      (K,)    forces on the pairs of obstacle and node, non-negative
    beta        (nf,)   forces of the bounds, positive at lower ones
    phi         (ny,)   forces of all constraints: sum_k lambda_k grad g_k on positions and sizes
                        (positions between samples pass theirs on to states and inputs), and beta
    W           (nv, nv)    the Lagrangian's second derivative is I + W in condensed coordinates
"""

from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.problem import Problem
from scp_mpc.qp.program import KKTResiduals
from scp_mpc.scp.condensing import Rollout
from scp_mpc.scp.layout import Layout
from scp_mpc.scp.pairs import Pairs, Planes

_NOTHING = np.zeros(0)
_STRONG = 1e-6  # force, relative to the largest, from which a constraint is strongly active
_TOUCH = 1e-7  # distance to a constraint that is none
_DEPENDENT = 1e-12  # of the largest eigenvalue of rows rows': none
_LEAST = 1e-300
_ROUNDING = 1e-10  # of a bounded state beyond its bounds, which costs nothing
CURVATURE_TOLERANCE = 1e-6  # of the largest curvature: what is less is taken for flat


@dataclass(frozen=True, eq=False)
class Nominal:
    """A plan that obeys the dynamics, with its multipliers and residuals: the loop's iterate.

    Attributes:
        y: (ny,) outputs, their positions rolled out from the inputs.
        rollout: The plan that its inputs lead to.
        costates: (N, nx) nu.
        reaction: (nf,) beta.
        pairs: Of obstacle and node that were looked at.
        planes: Their constraints, linearised here.
        force: (K,) lambda.
        slack: (K,) violation of the pairs that yield [m].
        excess: (N nb,) how far what is bounded of the states exceeds its bounds.
        cost: Objective without slack.
        residuals: KKT residuals of the original problem.
    """

    y: FloatArray
    rollout: Rollout
    costates: FloatArray
    reaction: FloatArray
    pairs: Pairs
    planes: Planes
    force: FloatArray
    slack: FloatArray
    excess: FloatArray
    cost: float
    residuals: KKTResiduals


class Certificate:
    """Computes the residuals of plans.

    Args:
        problem: Whose KKT conditions are checked.
        layout: What y holds.
    """

    def __init__(self, problem: Problem, layout: Layout) -> None:
        """Remember the problem."""
        self._problem, self._layout = problem, layout
        rest = problem.model.equilibrium_input
        self._rest = rest if rest.any() else None

    def costates(
        self,
        along: Rollout,
        track: FloatArray,
        reaction: FloatArray,
        phi: FloatArray | None,
    ) -> tuple[FloatArray, FloatArray | None, FloatArray | None]:
        """Multipliers nu (N, nx), and the forces on u (N, nu) and s (M,), or None for none.

        Args:
            along: The plan about which the dynamics are linearised.
            track: (N, nx) Q e, half the cost's gradient in e.
            reaction: (nf,) forces of the bounds.
            phi: (ny,) forces of the obstacles on positions and sizes, or None.
        """
        c, pull = self._layout, -2 * track
        on_u = on_s = None
        if phi is not None:
            on_e, on_u = along.along.pull(phi[c.p])
            pull += on_e
            on_s = phi[c.s]
        if reaction.any():
            bound_e, bound_u = c.pushed(reaction)
            on_u = bound_u if on_u is None else on_u + bound_u
            if bound_e is not None:
                pull += bound_e
            if c.moving:
                on_s = reaction[: c.moving] if on_s is None else on_s + reaction[: c.moving]
        return along.along.costates(pull), on_u, on_s

    def track(self, e: FloatArray) -> FloatArray:
        """Q e (N, nx): half the cost's gradient in deviations e."""
        track = e @ self._problem.Q
        track[-1] = e[-1] @ self._problem.Qf
        return track

    def phi(self, pairs: Pairs, planes: Planes, force: FloatArray) -> FloatArray | None:
        """Forces (ny,) of the obstacles on positions and sizes; None where nobody pushes."""
        if not force.any():
            return None
        weights = (force[:, None] * planes.a).ravel()
        return np.bincount(pairs.at.ravel(), weights, self._layout.size).astype(np.float64)

    def certify(
        self,
        y: FloatArray,
        rollout: Rollout,
        reaction: FloatArray,
        pairs: Pairs,
        planes: Planes,
        force: FloatArray,
        slack: FloatArray,
        bounds: tuple[FloatArray, FloatArray],
        wide: tuple[FloatArray, FloatArray],
    ) -> Nominal:
        """Return the plan with its residuals.

        Args:
            y: (ny,) outputs.
            rollout: The plan that belongs to its inputs.
            reaction: (nf,) forces of the bounds.
            pairs: Of obstacle and node.
            planes: Their constraints, linearised there.
            force: (K,) forces of the obstacles.
            slack: (K,) violation of those that yield [m].
            bounds: Of y in this step.
            wide: The same, as far as its program took those of states.
        """
        problem, c = self._problem, self._layout
        u, e, w = rollout.inputs, rollout.deviations, problem.size.weight
        away = y[c.s] - problem.size.reference
        push = u if self._rest is None else u - self._rest
        track, effort = self.track(e), push @ problem.R
        cost = float(np.vdot(track, e) + np.vdot(effort, push) + w * (away @ away))
        scale = max(1.0, 2 * float(np.abs(track).max()), 2 * float(np.abs(effort).max()))
        nu, on_u, on_s = self.costates(rollout, track, reaction, self.phi(pairs, planes, force))
        thrust = 2 * effort - rollout.along.thrust(nu)
        if on_u is not None:
            thrust -= on_u
        stationarity = float(np.abs(thrust).max())
        if c.moving:
            pull = 2 * w * away if on_s is None else 2 * w * away - on_s
            stationarity = max(stationarity, float(np.abs(pull).max()))
        feasibility = product = 0.0
        if len(force):
            gap = planes.g + slack
            feasibility = max(0.0, -float(gap.min()))
            product = max(-float(force.min()), float(np.abs(force * gap).max()))
        excess = _NOTHING
        if c.size > c.u.stop or reaction.any():
            (lower, upper), boxed = bounds, y[c.boxed]
            below, above = boxed - lower[c.boxed], upper[c.boxed] - boxed
            allowed = np.zeros(len(boxed))
            if c.size > c.u.stop:  # only changes and states can be beyond their bounds
                beyond = np.maximum(0.0, -np.minimum(below, above))
                excess = np.where(beyond[c.states] > _ROUNDING, beyond[c.states], 0.0)
                if wide is not bounds:
                    low, high = (lower - wide[0])[c.boxed], (wide[1] - upper)[c.boxed]
                    allowed = np.minimum(beyond, np.where(below < 0, low, high))
                yields = np.abs(reaction[c.soft]) >= problem.state_slack_weight
                allowed[c.soft] = np.where(yields, beyond[c.soft], 0.0)
                feasibility = max(feasibility, float((beyond - allowed).max()))
            pushing = reaction != 0
            if pushing.any():
                room = np.abs(reaction * (np.where(reaction > 0, below, above) + allowed))
                product = max(product, float(room[pushing].max()))
        residuals = KKTResiduals(stationarity / scale, feasibility, product / max(1.0, cost))
        return Nominal(
            y, rollout, nu, reaction, pairs, planes, force, slack, excess, cost, residuals
        )


def least_curvature(
    W: FloatArray | None, factors: FloatArray, rows: FloatArray, force: FloatArray
) -> tuple[float, FloatArray]:
    """Smallest curvature of I + W - L'L that the active constraints leave, over its largest.

    Necessary at a minimum is that no direction of the critical cone bends down. The strongly active
    rows take directions away altogether. Of the weakly active ones only half of the directions may
    be gone: where they are free and some direction bends down, it counts if it or its opposite
    moves away from all of them; else they are held.

    Args:
        W: (nv, nv) as above; None for zero.
        factors: (q, nv) L.
        rows: (k, nv) gradients of the active constraints, towards where they allow to go.
        force: (k,) their forces, non-negative.

    Returns:
        The smallest eigenvalue over the largest, and its direction (nv,).
    """
    weak = force <= _STRONG * max(1.0, float(force.max(initial=0.0)))
    least, direction = _smallest(W, factors, rows[~weak])
    if least >= -CURVATURE_TOLERANCE or not weak.any():
        return least, direction
    along = rows[weak] @ direction
    if (along >= -_TOUCH).all() or (along <= _TOUCH).all():
        return least, direction if (along >= -_TOUCH).all() else -direction
    return _smallest(W, factors, rows)


def _smallest(
    W: FloatArray | None, factors: FloatArray, rows: FloatArray
) -> tuple[float, FloatArray]:
    """Smallest eigenvalue on the null space of some rows, over the largest, and its direction."""
    nv = factors.shape[1]
    basis = None
    if len(rows):  # orthonormal rows that span theirs
        sizes, vectors = np.linalg.eigh(rows @ rows.T)
        kept = sizes > _DEPENDENT * sizes[-1]
        basis = (rows.T @ vectors[:, kept]) / np.sqrt(sizes[kept])
        if basis.shape[1] == nv:  # nothing is left to move in
            return 1.0, np.zeros(nv)
    if W is None:  # the eigenvalues of I - L'L on a subspace are those of a matrix as small as L
        inner = factors if basis is None else factors - (factors @ basis) @ basis.T
        values, vectors = np.linalg.eigh(inner @ inner.T)
        if not len(values):
            return 1.0, np.zeros(nv)
        return float(1.0 - values[-1]) / max(1.0, float(values[-1]) - 1.0), vectors[:, -1] @ inner
    M = W - factors.T @ factors
    M.flat[:: nv + 1] += 1.0
    if basis is not None:
        across = basis.T @ M
        M -= basis @ across + across.T @ basis.T - basis @ (across @ basis) @ basis.T
        M += np.abs(M).max() * (basis @ basis.T)  # directions that are gone bend up
    values, vectors = np.linalg.eigh(M)
    return float(values[0]) / max(float(np.abs(values).max()), _LEAST), vectors[:, 0]
