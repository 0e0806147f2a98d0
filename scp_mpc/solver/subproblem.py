"""The convex subproblem: the only file that knows the order of variables and rows.

Notation:
    e_i = x_i - xref_i      deviation from the reference, so that no number depends on the origin
    C                       points at which obstacles are constrained, K in each interval
    z = [e_1 .. e_N | u_0 .. u_{N-1} | s_1 .. s_M | slack_11 .. slack_MC | excess]
    rows = [dynamics | input bounds | bounds on s | half-spaces | slack | limits]

    dynamics        e_{i+1} - A e_i - B u_i = A xref_i - xref_{i+1}, with A x_0 for A (e_0 + xref_0)
    half-spaces     normal_jc' p_c + slope_jc s_j + slack_jc >= offset_jc - normal_jc' track_c
                        with p_c = e_i[position] at the samples, else C_k e_i + D_k u_i
    slack           slack = 0 (firm) or slack >= 0 at `slack_weight` per metre (soft)
    limits, excess  bounds of states and rates, where there are any: `limits.py`

OSQP's 1/2 against our none makes P = 2 diag(Q, .., Qf, R, .., w, 0).
"""

from dataclasses import replace

import numpy as np
from scipy import sparse

from scp_mpc.arrays import FloatArray, IntArray
from scp_mpc.problem import Problem
from scp_mpc.robots.linear import LinearModel
from scp_mpc.safety.halfspaces import HalfSpaces
from scp_mpc.solver.iterate import Iterate, Multipliers
from scp_mpc.solver.limits import Limits
from scp_mpc.solver.program import KKTResiduals, QuadraticProgram
from scp_mpc.solver.sampling import LinearSampling, Sampling
from scp_mpc.qp.sparse_blocks import SparseBlocks


class Subproblem:
    """The quadratic program about a nominal plan: pattern once, values many times.

    Initialisation: everything that depends on the problem alone, the dynamics included.

    Usage: `write_step` once per control step, `write_half_spaces` once per SCP iteration;
    `program` then holds the values, and `unpack` turns its solution into an `Iterate`.
    """

    def __init__(self, problem: Problem, sampling: Sampling | None = None) -> None:
        """Lay out variables and rows and write the constant values."""
        self._problem = problem
        model, N, M = problem.model, problem.horizon, problem.max_obstacles
        sampling = Sampling.of(problem, 1) if sampling is None else sampling
        assert isinstance(model, LinearModel)
        assert isinstance(sampling, LinearSampling)
        self._model, self._sampling = model, sampling
        C = self._sampling.points
        columns = [N * model.nx, N * model.nu, M, M * C]
        rows = [N * model.nx, N * model.nu, M, M * C, M * C]
        self._x, self._u, self._s, self._slack = _slices(columns)
        self._dynamics, self._inputs, self._margin, self._spaces, self._pins = _slices(rows)
        self._limits = Limits(problem)
        self._limits.place(sum(columns), sum(rows))
        n, m = sum(columns) + self._limits.columns, sum(rows) + self._limits.rows
        A, self._places = self._constraints((m, n))
        self.program = QuadraticProgram(
            self._hessian(), np.zeros(n), A, np.full(m, -np.inf), np.full(m, np.inf)
        )
        lower, upper = self.program.lower, self.program.upper
        lower[self._inputs] = np.tile(problem.u_min, N)
        upper[self._inputs] = np.tile(problem.u_max, N)
        lower[self._margin], upper[self._margin] = problem.size.lower, problem.size.upper
        lower[self._pins] = 0.0
        self._limits.write_constants(self.program)
        self.program.q[self._s] = -2 * problem.size.weight * problem.size.reference
        self._x0 = np.zeros(model.nx)
        self._reference = np.zeros((N, model.nx))
        self.write_step(self._x0, np.zeros((N + 1, model.nx)))
        self.soft = False

    @property
    def soft(self) -> bool:
        """Whether the slack is free (soft) or pinned to zero (firm)."""
        return self._soft

    @soft.setter
    def soft(self, soft: bool) -> None:
        self._soft = soft
        self.program.upper[self._pins] = np.inf if soft else 0.0
        self.program.q[self._slack] = self._problem.slack_weight if soft else 0.0

    def write_step(
        self, x0: FloatArray, x_ref: FloatArray, u_last: FloatArray | None = None
    ) -> None:
        """Write a control step: state x0 (nx,), reference x_ref (N+1, nx), input before (nu,)."""
        self._x0, self._reference, self._u_last = x0, x_ref[1:], u_last
        self._limits.write_step(self.program, self._reference, u_last)
        before = np.concatenate([x0[None], x_ref[1:-1]])
        drift = before @ self._model.A.T - x_ref[1:]
        self.program.lower[self._dynamics] = self.program.upper[self._dynamics] = drift.ravel()
        model = self._problem.model
        still = np.zeros((len(before), model.nu))
        self._track = self._sampling.positions(np.concatenate([before, x_ref[-1:]]), still)

    def write_half_spaces(self, spaces: HalfSpaces) -> None:
        """Write normals, slopes and offsets into the rows of the half-spaces."""
        problem, K, d = self._problem, self._sampling.count, self._problem.model.dim
        data = self.program.A.data
        normal = spaces.normal.reshape(problem.max_obstacles, problem.horizon, K, d)
        data[self._places["normals"]] = normal[:, :, -1].ravel()
        data[self._places["slopes"]] = spaces.slope.ravel()
        if K > 1:
            inner = normal[:, :, :-1, None]
            C, D = (m.reshape(K - 1, d, m.shape[1]) for m in (self._sampling.C, self._sampling.D))
            data[self._places["along states"]] = (inner[:, 1:] @ C)[..., 0, :].ravel()
            data[self._places["along inputs"]] = (inner @ D)[..., 0, :].ravel()
        along = np.einsum("mnd,nd->mn", spaces.normal, self._track)
        self.program.lower[self._spaces] = (spaces.offset - along).ravel()

    def pack(self, iterate: Iterate) -> tuple[FloatArray, FloatArray]:
        """Flatten an iterate into z and y; missing multipliers are zero."""
        deviations = iterate.states[1:] - self._reference
        z, y = np.zeros(len(self.program.q)), np.zeros(len(self.program.lower))
        z[: self._slack.stop] = np.concatenate(
            [deviations.ravel(), iterate.inputs.ravel(), iterate.s, iterate.slack.ravel()]
        )
        self._limits.pack(iterate, z, y)
        if iterate.multipliers is not None:
            duals = iterate.multipliers
            y[self._dynamics] = duals.dynamics.ravel()
            y[self._inputs] = duals.inputs.ravel()
            y[self._margin] = duals.margin
            y[self._spaces] = duals.obstacles.ravel()
            y[self._pins] = duals.slack.ravel()
        return z, y

    def unpack(self, z: FloatArray, y: FloatArray) -> Iterate:
        """Name the parts of z and y; inputs and sizes are moved into their bounds."""
        problem = self._problem
        N, model = problem.horizon, problem.model
        slots = problem.max_obstacles, self._sampling.points
        y.setflags(write=False)
        return Iterate(
            np.concatenate([self._x0[None], self._reference + z[self._x].reshape(N, model.nx)]),
            problem.limited(z[self._u].reshape(N, model.nu), self._u_last),
            np.clip(z[self._s], problem.size.lower, problem.size.upper),
            np.maximum(z[self._slack].reshape(slots), 0.0),
            Multipliers(
                y[self._dynamics].reshape(N, model.nx),
                y[self._inputs].reshape(N, model.nu),
                y[self._margin],
                y[self._spaces].reshape(slots),
                y[self._pins].reshape(slots),
                *self._limits.unpack(y),
            ),
        )

    def residuals(self, iterate: Iterate) -> KKTResiduals:
        """KKT residuals of the program as it stands at an iterate and its multipliers."""
        return self.program.residuals(*self.pack(iterate))

    def started(self, iterate: Iterate) -> Iterate:
        """A copy of the iterate with the state of this control step in row 0."""
        return replace(
            iterate,
            states=np.concatenate([self._x0[None], iterate.states[1:]]),
            inputs=iterate.inputs.copy(),
            s=iterate.s.copy(),
            slack=iterate.slack.copy(),
        )

    def resting(self, states: FloatArray) -> Iterate:
        """An iterate with the given states (N+1, nx), no input, s = s_ref and no slack."""
        problem = self._problem
        N, M = problem.horizon, problem.max_obstacles
        s = np.full(M, problem.size.reference)
        slack = np.zeros((M, self._sampling.points))
        return Iterate(states, np.zeros((N, problem.model.nu)), s, slack)

    def _hessian(self) -> sparse.csc_matrix:
        problem = self._problem
        N, M = problem.horizon, problem.max_obstacles
        weights = [problem.Q] * (N - 1) + [problem.Qf] + [problem.R] * N
        blocks = [sparse.csc_matrix(2 * block) for block in weights]  # without the blocks' zeros
        blocks.append(2 * problem.size.weight * sparse.eye(M, format="csc"))
        blocks.append(sparse.csc_matrix((M * self._sampling.points + self._limits.columns,) * 2))
        return sparse.csc_matrix(sparse.block_diag(blocks, format="csc"))

    def _constraints(self, shape: tuple[int, int]) -> tuple[sparse.csc_matrix, dict[str, IntArray]]:
        problem = self._problem
        model, N, M, d = problem.model, problem.horizon, problem.max_obstacles, problem.model.dim
        i = np.arange(N)[:, None, None]
        row = self._dynamics.start + i * model.nx + np.arange(model.nx)[:, None]
        state = self._x.start + i * model.nx + np.arange(model.nx)
        control = self._u.start + i * model.nu + np.arange(model.nu)
        blocks = SparseBlocks()
        diagonal = np.arange(N * model.nx)
        blocks.add("next", self._dynamics.start + diagonal, self._x.start + diagonal, 1.0)
        blocks.add("A", row[1:], state[:-1], -self._model.A)
        blocks.add("B", row, control, -self._model.B)
        for name, rows, columns in (
            ("inputs", self._inputs, self._u),
            ("margin", self._margin, self._s),
            ("pins", self._pins, self._slack),
            ("slack", self._spaces, self._slack),
        ):
            blocks.add(name, np.arange(rows.start, rows.stop), _range(columns), 1.0)
        K = self._sampling.count
        space = self._spaces.start + np.arange(M * N * K).reshape(M, N, K, 1)
        position = self._x.start + np.arange(N)[:, None] * model.nx + model.position
        blocks.add("normals", space[:, :, -1], np.broadcast_to(position, (M, N, d)), 0.0)
        blocks.add("slopes", space[..., 0], self._s.start + np.arange(M)[:, None, None], 0.0)
        if K > 1:
            blocks.add("along states", space[:, 1:, :-1], state[:-1], 0.0)
            blocks.add("along inputs", space[:, :, :-1], control, 0.0)
        self._limits.add(blocks, state[:, 0], control[:, 0])
        return blocks.build(shape)


def _slices(sizes: list[int]) -> list[slice]:
    stops = np.cumsum(sizes).tolist()
    return [slice(stop - size, stop) for stop, size in zip(stops, sizes, strict=True)]


def _range(part: slice) -> IntArray:
    return np.arange(part.start, part.stop)
