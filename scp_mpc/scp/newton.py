"""From a convex step to Newton's: the geometric series that the convex steps would add up to.

The convex subproblem leaves out that half-spaces turn as the plan moves along a curved obstacle. A
step d of it, with forces lambda, is followed by T d, then T^2 d and so on, where

    T = (I - A'(A A')^-1 A) L'L

maps a displacement to the one that the turned half-spaces cause, within the active set A. So the
convex steps converge if and only if T contracts; then their sum is Newton's step on the original
problem's KKT conditions,

    (I - T)^-1 d = d + P L'(I - L P L')^-1 L d,    P = I - A'(A A')^-1 A

and I - L P L' is positive definite: the second-order condition. Where it is not, the convex steps
lead away from this point, and there is nothing to sum.

Where the dynamics bend, too, the second derivative of the Lagrangian is I + W with any symmetric W,
and Newton's step goes on from the convex one within the null space of A: P (I + W) P z = -P W d.

Where Newton's step would leave the active set, the program is solved again with that second
derivative for its Hessian, negative curvature replaced by a little that is positive.

Notation:
    d   (nv,)       step of the condensed problem
    A   (k, nv)     responses of the active constraints
    L   (q, nv)     responses of the curvature factors, each times the root of its force
    W   (nv, nv)    what the convex program leaves out; -L'L for a linear robot
"""

from dataclasses import replace

import numpy as np
from scipy.linalg.lapack import dposv, dpotrf, dpotrs, dtrtrs

from scp_mpc.arrays import FloatArray
from scp_mpc.qp.active_set import CondensedQP, QPSolution, holds, settled
from scp_mpc.scp.certificate import CURVATURE_TOLERANCE, Nominal
from scp_mpc.scp.transcription import Program, Transcription

_STEPS = (0.5, 0.1, 0.02)  # of the inputs' range, to leave a saddle
_LESS = 1e-9  # relative fall of the merit that is none
_FLAT = 0.1  # least curvature of a program, relative to that of the cost
_CHANGES = 30  # of the active set, in a program with the Lagrangian's Hessian
_RESTORATIONS, _MOST = 3, 100  # steps, and changes of the active set in each


def refined(at: Transcription, program: Program, solution: QPSolution) -> QPSolution:
    """Go on from a convex step to Newton's: on its active set, or else with one that changes."""
    qp, here, nf = program.qp, program.condensed.here, len(program.qp.F)
    if at.linear:
        factors, push, L = at.curvature_factors(program, solution.force[nf:])
        if not len(push):
            return solution
        moved = program.condensed.y(solution.v) - program.planes.y
        turned = np.einsum("kwm,kw->km", L, moved[program.pairs.at[push]])
        whole = summed(solution, factors, turned.ravel())
    else:
        W = at.curvature(program, solution)
        whole = newton_step(solution, solution.v - here, W)
    if whole is not None and holds(qp, whole):
        return whole
    if at.linear:
        _, roots, vectors = np.linalg.svd(factors, full_matrices=False)
        values, vectors = 1.0 - roots * roots, vectors.T
    else:
        values, vectors = np.linalg.eigh(W)
        values += 1.0
    return newton_program(qp, here, values, vectors, solution) or solution


def second_order_correction(program: Program, solution: QPSolution, trial: Nominal) -> QPSolution:
    """The second-order correction: the least change that takes the active pairs back to g = 0.

    A step bends away from its linearised constraints by its square, which the merit would hold
    against it wherever it is, also next to the optimum (Maratos, 1978).
    """
    nf = len(program.qp.F)
    pairs = solution.indices >= nf
    if not pairs.any() or not np.isfinite(trial.cost):
        return solution
    rows, g = solution.rows, trial.pairs.table(trial.planes.g)
    at = program.pairs.obstacle, program.pairs.node
    wanted = np.zeros(len(rows))
    wanted[pairs] = -g[at][solution.indices[pairs] - nf]
    change, *_ = np.linalg.lstsq(rows, wanted)
    return replace(solution, v=solution.v + change)


def restored(at: Transcription, plan: Nominal, tolerance: float) -> Nominal | None:
    """The nearest plan that keeps every constraint, for one that nearly does; None for none.

    Steps of least length onto the linearised constraints, whose error falls with its square.
    """
    for _ in range(_RESTORATIONS):
        condensed = at.linearise(plan)
        program = at.write(plan, condensed, plan.planes)
        qp, here = program.qp, condensed.here
        nearby = replace(
            qp, lower=qp.lower - qp.F @ here, upper=qp.upper - qp.F @ here,
            b=qp.b - qp.A @ here + tolerance / 2,
        )  # fmt: skip
        nobody = np.zeros(len(qp.rows), dtype=np.bool_)
        end = settled(nearby, nobody.astype(np.intp), nobody, _MOST)
        if end.solution is None:
            return None
        force = np.concatenate([plan.reaction, plan.force])
        v = here + end.solution.v
        plan = at.certify(program, replace(end.solution, v=v, force=force, relaxed=nobody))
        deep = max(plan.residuals.feasibility, float(plan.excess.max(initial=0.0)))
        if deep <= tolerance and at.screen(plan) is None:
            return plan
    return None


def summed(solution: QPSolution, factors: FloatArray, step: FloatArray) -> QPSolution | None:
    """Return the solution that the convex steps from this one on tend to; None if they do not.

    Args:
        solution: Of the convex subproblem.
        factors: (q, nv) L, as above.
        step: (q,) L d: the convex step as the curvature factors see it.
    """
    bent = np.eye(len(factors)) - factors @ factors.T
    within = np.zeros((0, len(factors)))
    if len(solution.indices):
        across = solution.rows @ factors.T
        within, _ = dpotrs(solution.factor, across)
        bent += across.T @ within
    _, turn, info = dposv(bent, step)
    if info != 0:
        return None
    change = within @ turn
    force = solution.force.copy()
    force[solution.indices] -= change
    v = solution.v + turn @ factors - change @ solution.rows
    return replace(solution, v=v, force=force)


def newton_step(solution: QPSolution, step: FloatArray, W: FloatArray) -> QPSolution | None:
    """Return the solution to which Newton's step leads; None without the second-order condition.

    Args:
        solution: Of the convex subproblem.
        step: (nv,) d, from the plan to it.
        W: (nv, nv) as above.
    """
    M = W.copy()
    M.flat[:: len(M) + 1] += 1.0
    left = W @ step
    if len(solution.indices):
        R, _ = dtrtrs(solution.factor, solution.rows, trans=1)  # orthonormal rows that span A's
        across = R @ M
        M -= R.T @ across + across.T @ R - R.T @ (across @ R.T) @ R
        M += R.T @ R
        left = left - R.T @ (R @ left)
    _, z, info = dposv(M, -left)
    if info != 0:
        return None
    force = solution.force.copy()
    if len(solution.indices):
        change, _ = dpotrs(solution.factor, solution.rows @ (W @ (step + z)))
        force[solution.indices] += change
    return replace(solution, v=solution.v + z, force=force)


def newton_program(
    qp: CondensedQP,
    here: FloatArray,
    values: FloatArray,
    vectors: FloatArray,
    solution: QPSolution,
) -> QPSolution | None:
    """Solve a program again with the Lagrangian's own Hessian H; None where that is not reached.

    For where the active set changes on the way of Newton's step. With C = H^(1/2), curvatures that
    are negative or small replaced, the objective is |w|^2 / 2 in w = C (v - here) + C^-1 here, so
    that the program is of the same kind.

    Args:
        qp: The convex program.
        here: (nv,) the point about which it was made.
        values: (q,) eigenvalues of H; all others are one.
        vectors: (nv, q) their eigenvectors.
        solution: Of the convex program: the active set to begin with.
    """
    stretch = 1 / np.sqrt(np.maximum(values, _FLAT)) - 1
    back = (vectors * stretch) @ vectors.T  # C^-1
    back.flat[:: len(back) + 1] += 1.0
    origin = here - back @ (back @ here)
    nf, moved = len(qp.F), qp.rows @ origin
    turned = replace(
        qp, F=qp.F @ back, A=qp.A @ back, lower=qp.lower - moved[:nf], upper=qp.upper - moved[:nf],
        b=qp.b - moved[nf:],
    )  # fmt: skip
    end = settled(turned, solution.active, solution.relaxed, _CHANGES).solution
    if end is None:
        return None
    rows = qp.rows[end.indices]
    return replace(end, v=origin + back @ end.v, rows=rows, factor=dpotrf(rows @ rows.T)[0])


def negative_curvature_step(
    at: Transcription, saddle: Nominal, direction: FloatArray
) -> Nominal | None:
    """Leave a saddle along a direction (N, nu) of negative curvature; None where that is in vain.

    The first of some ever shorter steps, to either side, after which the merit is less.
    """
    problem = at.problem
    span = np.where(problem.u_max > problem.u_min, problem.u_max - problem.u_min, 1.0)
    largest = float(np.abs(direction / span).max())
    if not (saddle.residuals.curvature < -CURVATURE_TOLERANCE and largest > 0):
        return None
    before = _merit(at, saddle)
    s = saddle.y[at.layout.s]
    for length in _STEPS:
        for sign in (length, -length):
            inputs = saddle.rollout.inputs + sign / largest * direction
            y, rollout = at.rolled(inputs, s)
            trial = at.nominal(y, rollout, saddle.reaction, saddle.pairs, 0 * saddle.force)
            if _merit(at, trial) < before - _LESS * abs(before):
                return trial
    return None


def _merit(at: Transcription, plan: Nominal) -> float:
    return at.merit(plan.cost, float(np.maximum(-plan.planes.g, 0.0).sum()), plan.excess)
