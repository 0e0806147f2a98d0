"""The condensed problem: dynamics and cost eliminated, once and for all.

Constraints act on positions, inputs and sizes only. Collect those in y. Every plan that obeys the
dynamics is

    y = y_free + S v,        cost = cost_free + |v|^2 / 2 * 1        (in the program's units)

where y_free is the plan that nothing constrains and v are its inputs (and sizes) in coordinates
that make the Hessian the identity. S depends on model, weights and horizon alone.

Notation:
    y       [p_1 .. p_C | u_0 .. u_{N-1} | s_1 .. s_M], p as deviation from the track
    e       (N, nx)     deviations x_i - xref_i, i = 1 .. N
    nu      (N, nx)     multipliers of the dynamics
    H       2 (R + G'QG), Hessian in the inputs, G the map from inputs to e;  H^-1 = L L',  u = L v
    D e = B u + drift   all stages' dynamics, D block bidiagonal with unit diagonal

    2 Q e + D' nu = phi_e,   2 R u - B' nu = phi_u      (forces phi of the constraints on e and u)
"""

from typing import Any

import numpy as np
from scipy import sparse
from scipy.linalg import solve_triangular
from scipy.sparse.linalg import splu

from scp_mpc.arrays import FloatArray
from scp_mpc.problem import Problem
from scp_mpc.solver.sampling import Sampling


class Condensed:
    """Free plan and response of a problem with linear, time-invariant dynamics.

    Initialisation: factorises the unconstrained problem's KKT matrix.

    Usage: `start` once per control step; `deviations` then belongs to it.

    Attributes:
        response: (ny, nv) S.
        lower: (ny,) bounds of y; infinite for positions.
        upper: (ny,) likewise.
        p: Slice of the positions in y; likewise `u` and `s`.
        boxed: Slice of the entries of y that are bounded and can move.

    Raises:
        numpy.linalg.LinAlgError: The Hessian in the inputs is singular: R = 0, say.
    """

    def __init__(self, problem: Problem, sampling: Sampling | None = None) -> None:
        """Factorise the KKT matrix of the unconstrained problem and build S."""
        self._problem = problem
        model, N, M = problem.model, problem.horizon, problem.max_obstacles
        margin = problem.size
        self.sampling = Sampling(model, N, 1) if sampling is None else sampling
        self._states = N * model.nx
        self.p = slice(0, self.sampling.points * model.dim)
        self.u = slice(self.p.stop, self.p.stop + N * model.nu)
        self.s = slice(self.u.stop, self.u.stop + M)
        # A size that cannot shrink never moves: larger ones only cost more and leave less room.
        self.moving_sizes = M if margin.lower < margin.reference else 0
        self.boxed = slice(self.u.start, self.u.stop + self.moving_sizes)
        steps = sparse.kron(sparse.eye(N, k=-1), model.A)
        D = sparse.csc_matrix(sparse.eye(N * model.nx) - steps)
        # Its own factor: no fill, no pivoting.
        self._dynamics = splu(D, permc_spec="NATURAL", diag_pivot_thresh=0.0)
        self._kkt = splu(self._kkt_matrix(D))
        self._right = np.zeros(self._kkt.shape[0])
        self._drift = np.zeros((N, model.nx))
        self._sizes = np.full(M, margin.reference)
        self.response = self._respond()
        unbounded = np.full(self.p.stop, np.inf)
        self.lower = np.concatenate(
            [-unbounded, np.tile(problem.u_min, N), np.full(M, margin.lower)]
        )
        self.upper = np.concatenate(
            [unbounded, np.tile(problem.u_max, N), np.full(M, margin.upper)]
        )

    def start(self, x0: FloatArray, x_ref: FloatArray) -> FloatArray:
        """Return y of the plan that nothing constrains, from x0 (nx,) along x_ref (N+1, nx)."""
        A = self._problem.model.A
        self._drift = x_ref[:-1] @ A.T - x_ref[1:]
        self._drift[0] = A @ x0 - x_ref[1]
        self._right[-self._states :] = self._drift.ravel()
        e, u = self._parts(self._kkt.solve(self._right))
        p = self.sampling.deviations(e, u)
        return np.concatenate([p.ravel(), u.ravel(), self._sizes])

    def started_like(self, other: "Condensed", y: FloatArray) -> FloatArray:
        """`start` for other points, from the y that another one found for the same step."""
        self._drift = other._drift
        return self.of_inputs(y[other.u], y[other.s])

    def of_inputs(self, u: FloatArray, s: FloatArray) -> FloatArray:
        """Return y of inputs u (N nu,) and sizes s (M,) in this step."""
        inputs = u.reshape(-1, self._problem.model.nu)
        p = self.sampling.deviations(self.deviations(inputs), inputs)
        return np.concatenate([p.ravel(), u, s])

    def deviations(self, inputs: FloatArray) -> FloatArray:
        """Roll inputs (N, nu) out from this step's x0: e (N, nx)."""
        pushed = inputs @ self._problem.model.B.T + self._drift
        e: FloatArray = self._dynamics.solve(pushed.ravel())
        return e.reshape(pushed.shape)

    def costates(self, forces: FloatArray) -> FloatArray:
        """Solve D' nu = forces (N, nx) for nu (N, nx): backwards in time."""
        backwards: Any = self._dynamics.solve
        nu: FloatArray = backwards(forces.ravel(), trans="T")
        return nu.reshape(forces.shape)

    def _kkt_matrix(self, D: sparse.csc_matrix) -> sparse.csc_matrix:
        problem, N = self._problem, self._problem.horizon
        Q = sparse.csc_matrix(sparse.block_diag([2 * problem.Q] * (N - 1) + [2 * problem.Qf]))
        R = sparse.kron(sparse.eye(N), 2 * problem.R)
        B = sparse.kron(sparse.eye(N), problem.model.B)
        blocks: Any = [[Q, None, D.T], [None, R, -B.T], [D, -B, None]]
        return sparse.csc_matrix(sparse.bmat(blocks))

    def _parts(self, solved: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Deviations e (N, nx) and inputs (N, nu) within the KKT system's unknowns."""
        model, inputs = self._problem.model, self._problem.horizon * self._problem.model.nu
        e, u = solved[: self._states], solved[self._states : self._states + inputs]
        return e.reshape(-1, model.nx), u.reshape(-1, model.nu)

    def _respond(self) -> FloatArray:
        """Push every input with a unit force: inputs answer with H^-1, positions with G H^-1."""
        margin, M = self._problem.size, self._problem.max_obstacles
        pushes = self.u.stop - self.u.start
        push = np.zeros((len(self._right), pushes))
        push[self._states + np.arange(pushes), np.arange(pushes)] = 1.0
        parts = [self._parts(column) for column in self._kkt.solve(push).T]
        positions = np.array([self.sampling.deviations(e, u).ravel() for e, u in parts]).T
        moved = np.array([u.ravel() for _, u in parts]).T
        L = np.linalg.cholesky((moved + moved.T) / 2)
        S = np.zeros((self.s.stop, pushes + self.moving_sizes))
        S[self.p, :pushes] = solve_triangular(L, positions.T, lower=True).T
        S[self.u, :pushes] = L
        if self.moving_sizes:
            S[self.s, pushes:] = np.eye(M) / np.sqrt(2 * margin.weight)
        return S
