"""From a convex step to Newton's: the geometric series that the convex steps would add up to.

The convex subproblem leaves out that half-spaces turn as the plan moves along a curved obstacle. A
step d of it, with forces lambda, is followed by T d, then T^2 d and so on, where

    T = (I - A'(A A')^-1 A) K,    K = sum_k lambda_k L_k L_k'

maps a displacement to the one that the turned half-spaces cause, within the active set A. So the
convex steps converge if and only if T contracts; then their sum is Newton's step on the original
problem's KKT conditions,

    (I - T)^-1 d = d + P L (I - L' P L)^-1 L' d,    P = I - A'(A A')^-1 A

and I - L' P L is positive definite: the second-order condition. Where it is not, the convex steps
lead away from this point, and there is nothing to sum.

Where the dynamics bend, too, the second derivative of the Lagrangian is I + W with any symmetric W,
and Newton's step goes on from the convex one within the null space of A: P (I + W) P z = -P W d.

Notation:
    d   (nv,)       step of the condensed problem
    A   (k, nv)     responses of the active constraints
    L   (q, nv)     responses of the bends, each times the root of its force
    W   (nv, nv)    what the convex program leaves out; -L'L for a linear robot
"""

from dataclasses import replace

import numpy as np
from scipy.linalg.lapack import dposv, dpotrf, dpotrs, dtrtri, dtrtrs

from scp_mpc.arrays import FloatArray
from scp_mpc.solver.active_set import CondensedProgram, Held

_LEAST_BEND = 0.1  # of a direction whose curvature is negative, or nearly none


def summed(held: Held, bends: FloatArray, step: FloatArray) -> Held | None:
    """Return the solution that the convex steps from `held` on tend to; None if they do not.

    Args:
        held: Solution of the convex subproblem.
        bends: (q, nv) L, as above.
        step: (q,) L' d: the convex step as the bends see it.
    """
    bent = np.eye(len(bends)) - bends @ bends.T
    within = np.zeros((0, len(bends)))
    if len(held.indices):
        across = held.rows @ bends.T
        within, _ = dpotrs(held.factor, across)
        bent += across.T @ within
    _, turn, info = dposv(bent, step)
    if info != 0:
        return None
    change = within @ turn
    force = held.force.copy()
    force[held.indices] -= change
    return replace(held, v=held.v + turn @ bends - change @ held.rows, force=force)


def newton_step(held: Held, step: FloatArray, W: FloatArray) -> Held | None:
    """Return the solution to which Newton's step leads; None without the second-order condition.

    Args:
        held: Solution of the convex subproblem.
        step: (nv,) d, from the plan to it.
        W: (nv, nv) as above.
    """
    M = W.copy()
    M.flat[:: len(M) + 1] += 1.0
    left = W @ step
    if len(held.indices):
        R, _ = dtrtrs(held.factor, held.rows, trans=1)  # orthonormal rows that span A's
        across = R @ M
        M -= R.T @ across + across.T @ R - R.T @ (across @ R.T) @ R
        M += R.T @ R
        left = left - R.T @ (R @ left)
    _, z, info = dposv(M, -left)
    if info != 0:
        return None
    force = held.force.copy()
    if len(held.indices):
        change, _ = dpotrs(held.factor, held.rows @ (W @ (step + z)))
        force[held.indices] += change
    return replace(held, v=held.v + z, force=force)


def bent_program(
    program: CondensedProgram, here: FloatArray, W: FloatArray
) -> tuple[CondensedProgram, FloatArray, FloatArray]:
    """Return the program with the Hessian I + W about `here`, in coordinates that make it I.

    The model v'here + (v - here)'(I + W)(v - here) / 2 replaces |v|^2 / 2; directions in which it
    bends the other way, or hardly, are held to a least curvature.

    Args:
        program: The convex program.
        here: (nv,) the plan about which W was found.
        W: (nv, nv).

    Returns:
        The program in w, and `centre` and `root` of v = centre + root w.
    """
    M = W.copy()
    M.flat[:: len(M) + 1] += 1.0
    L, info = dpotrf(M, lower=1, clean=1)
    if info == 0:
        root, _ = dtrtri(L, lower=1)
        root = root.T
    else:
        values, vectors = np.linalg.eigh(M)
        root = vectors / np.sqrt(np.maximum(np.abs(values), _LEAST_BEND))
    centre = here - root @ (root.T @ here)
    F, A = np.ascontiguousarray(program.F @ root), np.ascontiguousarray(program.A @ root)
    away, beyond = program.F @ centre, program.A @ centre
    bent = replace(
        program,
        F=F,
        lower=program.lower - away,
        upper=program.upper - away,
        A=A,
        b=program.b - beyond,
    )
    return bent, centre, root
