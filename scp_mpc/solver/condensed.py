"""The condensed problem of a linear robot: dynamics and cost eliminated, once and for all.

S depends on model, weights and horizon alone; y_free follows from one linear system.

Notation as in `chart.py` and `motion.py`, and
    H       2 (R + G'QG), Hessian in the inputs, G the map from inputs to e;  H^-1 = L L',  u = L v

    2 Q e + D' nu = phi_e,   2 R u - B' nu = phi_u      (forces phi of the constraints on e and u)
"""

from functools import partial
from typing import Any

import numpy as np
from scipy import sparse
from scipy.linalg import solve_triangular
from scipy.sparse.linalg import splu

from scp_mpc.arrays import FloatArray
from scp_mpc.problem import Problem
from scp_mpc.robots.linear import LinearModel
from scp_mpc.solver.chart import Chart, Condensation, Rolled
from scp_mpc.solver.layout import Layout
from scp_mpc.solver.motion import SteadyMotion
from scp_mpc.solver.sampling import LinearSampling
from scp_mpc.solver.step_data import StepData


class Condensed(Condensation):
    """Free plan and response of a problem with linear, time-invariant dynamics.

    Initialisation: factorises the unconstrained problem's KKT matrix.

    Usage: `begin` once per control step; everything else then belongs to it.

    Raises:
        numpy.linalg.LinAlgError: The Hessian in the inputs is singular: R = 0, say.
    """

    def __init__(self, problem: Problem, sampling: LinearSampling | None = None) -> None:
        """Factorise the KKT matrix of the unconstrained problem and build S."""
        model, N = problem.model, problem.horizon
        assert isinstance(model, LinearModel)
        self._problem, self._model = problem, model
        self._linear = LinearSampling(model, N, 1) if sampling is None else sampling
        self.sampling, self.layout = self._linear, Layout(problem, self._linear)
        self._states = N * model.nx
        self._motion = SteadyMotion(model, N, self._linear)
        self._kkt = splu(self._kkt_matrix(self._motion.D))
        self._right = np.zeros(self._kkt.shape[0])
        self._sizes = np.full(problem.max_obstacles, problem.size.reference)
        self.response = self._respond()
        self._boxed = np.ascontiguousarray(self.response[self.layout.boxed])

    def begin(self, step: StepData) -> None:
        """See the base class."""
        A, x_ref = self._model.A, step.x_ref
        self._step = step
        self._drift = x_ref[:-1] @ A.T - x_ref[1:]
        self._drift[0] = A @ step.x0 - x_ref[1]

    def chart(self, free: FloatArray | None = None) -> Chart:
        """The chart of this step; `free` (N, nu) are the inputs that nothing constrains, if known.

        Those of other points of the same step are the same.
        """
        if free is None:
            self._right[-self._states :] = self._drift.ravel()
            e, u = self._parts(self._kkt.solve(self._right))
            p = self._linear.deviations(e, u)
        else:
            rolled = self.rolled(free)
            e, u, p = rolled.deviations, free, rolled.positions
        y = self.layout.outputs(self._step, p, self._sizes, u, e)
        return Chart(y, self.response, self._boxed, partial(self._cost, e, u))

    def _cost(self, e: FloatArray, u: FloatArray) -> float:
        x_ref = self._step.x_ref
        return self._problem.cost(np.concatenate([x_ref[:1], x_ref[1:] + e]), u, self._sizes, x_ref)

    def rolled(self, inputs: FloatArray, guess: FloatArray | None = None) -> Rolled:  # noqa: ARG002
        """See the base class."""
        e = self._motion.roll(inputs @ self._model.B.T + self._drift)
        return Rolled(inputs, e, self._linear.deviations(e, inputs), self._motion)

    def _kkt_matrix(self, D: sparse.csc_matrix) -> sparse.csc_matrix:
        problem, N = self._problem, self._problem.horizon
        Q = sparse.csc_matrix(sparse.block_diag([2 * problem.Q] * (N - 1) + [2 * problem.Qf]))
        R = sparse.kron(sparse.eye(N), 2 * problem.R)
        B = sparse.kron(sparse.eye(N), self._model.B)
        blocks: Any = [[Q, None, D.T], [None, R, -B.T], [D, -B, None]]
        return sparse.csc_matrix(sparse.bmat(blocks))

    def _parts(self, solved: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Deviations e (N, nx) and inputs (N, nu) within the KKT system's unknowns."""
        inputs = self._problem.horizon * self._model.nu
        e, u = solved[: self._states], solved[self._states : self._states + inputs]
        return e.reshape(-1, self._model.nx), u.reshape(-1, self._model.nu)

    def _respond(self) -> FloatArray:
        """Push every input with a unit force: inputs answer with H^-1, deviations with G H^-1."""
        pushes = self._problem.horizon * self._model.nu
        push = np.zeros((len(self._right), pushes))
        push[self._states + np.arange(pushes), np.arange(pushes)] = 1.0
        solved = self._kkt.solve(push)
        parts = [self._parts(column) for column in solved.T]
        positions = np.array([self._linear.deviations(e, u).ravel() for e, u in parts])
        e, moved = solved[: self._states], solved[self._states : self._states + pushes]
        L: FloatArray = np.linalg.cholesky((moved + moved.T) / 2).astype(np.float64)
        along: FloatArray = solve_triangular(L, positions, lower=True).T
        deviations: FloatArray = solve_triangular(L, e.T, lower=True).T
        stages = deviations.reshape(self._problem.horizon, -1, pushes)
        bounded = stages[:, self._problem.bounded_states].reshape(-1, pushes)
        return self.layout.response(along, L, bounded)
