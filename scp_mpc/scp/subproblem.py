"""The convex subproblem as a sparse program: pattern once, values many times.

Only this file knows the order of its variables and rows:

    z = [e_1 .. e_N | u_0 .. u_{N-1} | s_1 .. s_M where they move | below | above | slack]
    rows = [dynamics | bounded entries of y, as in `layout.py` | half-spaces | slack >= 0]

    dynamics        e_{i+1} - A_i e_i - B_i u_i = the same of the plan linearised about
    bounded         lower <= y_k + below_k - above_k <= upper
    half-spaces     normal' p_c + slope s_j + slack_c >= offset, with p_c = C e + D u + rest

There is a fixed number of slots for half-spaces at each node, for the nearest obstacles; empty ones
hold zeros. Near pairs beyond that are in the condensed program only, against which `active_set.py`
checks whatever OSQP says, and join there where they must. A hard program has no slack; an elastic
one has below and above for soft states and slack for half-spaces, each at its price per unit: the
exact L1 penalty. OSQP's 1/2 against our none makes P = 2 diag(Q, .., Qf, R, .., w), to which
curvature may be added stage by stage.

Notation:
    C       collision nodes, n d coordinates of them at each sample, S slots at each
    a, g    gradients (K, d+1) and values (K,) of the pairs' constraints, see `pairs.py`
"""

import numpy as np
from scipy import sparse

from scp_mpc.arrays import FloatArray, IntArray
from scp_mpc.models.linear import LinearModel
from scp_mpc.problem import Problem
from scp_mpc.qp.backend import ProgramSolver, Rows
from scp_mpc.qp.program import QuadraticProgram
from scp_mpc.qp.sparse_blocks import SparseBlocks
from scp_mpc.scp.condensing import Derivatives, Rollout
from scp_mpc.scp.layout import Layout
from scp_mpc.scp.nodes import Nodes
from scp_mpc.scp.pairs import Pairs, Planes
from scp_mpc.settings import Settings

_NONE = 1e29  # a bound beyond this is none
_SLOTS = 3  # for half-spaces at each node; more gain nothing
_ELASTIC_SLOTS = 10  # with fewer, a crowd's programs with slack are not solved
_COUPLING = 0.1  # of slack to its row, relative to the row's length: more hides the active set


class Subproblem:
    """The sparse program about a plan, and the solvers set up for its pattern.

    Args:
        problem: The problem.
        nodes: Where its plans are constrained.
        layout: What y holds.
        settings: Who solves the program.
        elastic: Whether soft states and half-spaces may yield.

    Attributes:
        program: The values as last written.
        about: The plan that the dynamics were last written about in this control step; or None.
        solver: Solves it.
    """

    def __init__(
        self, problem: Problem, nodes: Nodes, layout: Layout, settings: Settings, elastic: bool
    ) -> None:
        """Lay out variables and rows, and set up the solvers."""
        self._problem, self._nodes, self._layout, self.elastic = problem, nodes, layout, elastic
        model, N, M = problem.model, problem.horizon, problem.max_obstacles
        self._slots = min(M, _ELASTIC_SLOTS if elastic else _SLOTS)
        spaces = nodes.size * self._slots
        states = len(layout.soft) if elastic else 0
        columns = [N * model.nx, N * model.nu, layout.moving, states, states]
        columns.append(spaces if elastic else 0)
        self._e, self._u, self._s, self._below, self._above, self._slack = _slices(columns)
        rows = [N * model.nx, layout.size - layout.boxed.start, spaces, sum(columns[3:])]
        self._dynamics, self._bounded, self._spaces, self._pins = _slices(rows)
        shape = self._pins.stop, self._slack.stop
        # The columns of e that positions at the samples depend on.
        heads = [] if model.heading is None or isinstance(model, LinearModel) else [model.heading]
        self._support = np.unique(np.append(model.position, heads).astype(np.intp))
        self._coupling = self._couplings()
        A, self._places = self._constraints(shape)
        q, lower, upper = np.zeros(shape[1]), np.full(shape[0], -np.inf), np.full(shape[0], np.inf)
        q[self._u] = -2 * np.tile(problem.R @ model.equilibrium_input, N)
        q[self._s] = -2 * problem.size.weight * problem.size.reference
        q[self._below] = q[self._above] = problem.state_slack_weight * self._coupling[0]
        q[self._slack] = problem.slack_weight * self._coupling[1]
        lower[self._dynamics] = upper[self._dynamics] = 0.0
        lower[self._pins] = 0.0
        self.program = QuadraticProgram(self._hessian(), q, A, lower, upper)
        self._blocks = _stage_blocks(self.program.P, N, model.nx, model.nu)
        self._plain = self.program.P.data.copy()
        self.about: Rollout | None = None
        self._linear = isinstance(model, LinearModel)
        if isinstance(model, LinearModel):
            at = np.zeros((N, 1, 1))
            self._write_matrices(at + model.A, at + model.B)
        equations = np.arange(self._dynamics.start, self._dynamics.stop)
        self.solver = ProgramSolver(self.program, equations, settings.solver, settings.qp)

    def write_dynamics(self, about: Rollout, curvature: FloatArray | None = None) -> None:
        """Write the dynamics about a plan, and its curvature (N, nx+nu, nx+nu) into P."""
        A, B, e, u = about.along.A, about.along.B, about.deviations, about.inputs
        if not self._linear:
            self._write_matrices(A, B)
        right = e - (B @ u[..., None])[..., 0]
        right[1:] -= (A[1:] @ e[:-1, :, None])[..., 0]
        self.program.lower[self._dynamics] = self.program.upper[self._dynamics] = right.ravel()
        rest = about.positions.ravel() - about.along.moved(e[..., None], u[..., None])[:, 0]
        self._rest, self.about = rest, about
        if self._linear:
            return
        self.program.P.data[:] = self._plain
        if curvature is not None:
            np.add.at(self.program.P.data, self._blocks[0], curvature.ravel()[self._blocks[1]])

    def write_bounds(self, lower: FloatArray, upper: FloatArray, u_last: FloatArray | None) -> None:
        """Write bounds (nf,) of the bounded entries; the first rates count from u_last (nu,)."""
        program, rates = self.program, self._layout.inputs.stop
        below, above = program.lower[self._bounded], program.upper[self._bounded]
        below[:] = np.where(lower <= -_NONE, -np.inf, lower)
        above[:] = np.where(upper >= _NONE, np.inf, upper)
        if u_last is not None and self._layout.states.start > rates:
            below[rates : rates + len(u_last)] += u_last
            above[rates : rates + len(u_last)] += u_last

    def write_half_spaces(
        self,
        pairs: Pairs,
        planes: Planes,
        along: Derivatives,
        relaxable: bool = True,
    ) -> Rows:
        """Write the half-spaces of the nearest pairs; return which row is whose.

        Args:
            pairs: All pairs that are near.
            planes: Their half-spaces.
            along: How positions depend on states and inputs, about the plan of the dynamics.
            relaxable: In an elastic program, whether the obstacles may yield, too.
        """
        layout, nodes, S, program = self._layout, self._nodes, self._slots, self.program
        d, N, data = self._problem.model.dim, layout.shape[0], self.program.A.data
        kept, slot = self._assigned(pairs.node, planes.g)
        normal = np.zeros((nodes.size * S, d))
        normal[slot] = planes.a[kept, :d]
        grouped = normal.reshape(N, nodes.count, S, d)
        n = nodes.discs
        at = along.at.reshape(N, n, d, -1)[..., self._support]
        data[self._places["at"]] = (grouped[:, -n:] @ at).ravel()
        if along.between is not None:
            C, D = (M.reshape(N, nodes.count - n, d, -1) for M in along.between)
            data[self._places["along states"]] = (grouped[1:, :-n] @ C[1:]).ravel()
            data[self._places["along inputs"]] = (grouped[:, :-n] @ D).ravel()
        if layout.moving:
            slope = np.zeros((nodes.size * S, layout.moving))
            slope[slot, pairs.obstacle[kept]] = planes.a[kept, d]
            data[self._places["slopes"]] = slope.ravel()
        places = pairs.at[kept]
        moved = planes.y[places]
        moved[:, :d] -= self._rest[places[:, :d]]
        offset = np.add.reduce(planes.a[kept] * moved, axis=1) - planes.g[kept]
        if not layout.moving:
            offset -= planes.a[kept, d] * moved[:, d]
        program.lower[self._spaces] = -np.inf
        program.lower[self._spaces.start + slot] = offset
        nf, K = self._bounded.stop - self._bounded.start, len(pairs.node)
        place = np.full(nf + K, -1, dtype=np.intp)
        place[:nf] = np.arange(self._bounded.start, self._bounded.stop)
        place[nf + kept] = self._spaces.start + slot
        self._kept, self._slot = kept, slot
        if not self.elastic:
            return Rows(place)
        below, above = np.full((2, nf + K), -1, dtype=np.intp)
        states = self._below.stop - self._below.start
        if states:
            below[layout.soft] = self._pins.start + np.arange(states)
            above[layout.soft] = self._pins.start + states + np.arange(states)
        if relaxable:
            below[nf + kept] = self._pins.start + 2 * states + slot
        data[self._places["slack"]] = self._coupling[1] * relaxable
        return Rows(place, below, above)

    def start(
        self, e: FloatArray, u: FloatArray, s: FloatArray, nu: FloatArray, force: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return z and its multipliers for the half-spaces that were written last.

        Args:
            e: (N, nx) deviations.
            u: (N, nu) inputs.
            s: (M,) sizes.
            nu: (N, nx) multipliers of the dynamics.
            force: (nf + K,) forces.
        """
        z, y = np.zeros(len(self.program.q)), np.zeros(len(self.program.lower))
        nf = self._bounded.stop - self._bounded.start
        z[self._e], z[self._u] = e.ravel(), u.ravel()
        z[self._s] = s[: self._layout.moving]
        y[self._dynamics], y[self._bounded] = nu.ravel(), -force[:nf]
        y[self._spaces.start + self._slot] = -force[nf + self._kept]
        if self.elastic:
            price, states = self._problem.slack_weight, self._below.stop - self._below.start
            pins = np.zeros(self._pins.stop - self._pins.start)
            if states:
                toll, pull = self._problem.state_slack_weight, force[self._layout.soft]
                pins[:states] = -np.maximum(toll - pull, 0.0) * self._coupling[0]
                pins[states : 2 * states] = -np.maximum(toll + pull, 0.0) * self._coupling[0]
            spaces = y[self._spaces]
            pins[2 * states :] = -np.maximum(price + spaces, 0.0) * self._coupling[1]
            y[self._pins] = pins
            values = self.program.A @ z
            short, over = self.program.lower - values, values - self.program.upper
            z[self._slack] = np.maximum(short[self._spaces], 0.0) / self._coupling[1]
            if states:
                held = self._bounded.start + self._layout.soft
                z[self._below] = np.maximum(short[held], 0.0) / self._coupling[0]
                z[self._above] = np.maximum(over[held], 0.0) / self._coupling[0]
        return z, y

    def box(self, z: FloatArray) -> FloatArray:
        """Sizes that move and inputs (nv,) in z."""
        return np.concatenate([z[self._s], z[self._u]])

    def _assigned(self, node: IntArray, room: FloatArray) -> tuple[IntArray, IntArray]:
        """Which pairs get a slot, and which: the nearest ones at each node."""
        S = self._slots
        order = np.lexsort((room, node))
        first = np.searchsorted(node[order], node[order])
        rank = np.arange(len(order)) - first
        within = rank < S
        kept = order[within]
        return kept, node[kept] * S + rank[within]

    def _write_matrices(self, A: FloatArray, B: FloatArray) -> None:
        data = self.program.A.data
        data[self._places["A"]], data[self._places["B"]] = -A[1:].ravel(), -B.ravel()

    def _couplings(self) -> tuple[FloatArray, float]:
        """Coefficients of slack: of soft states at all stages, and of half-spaces."""
        problem = self._problem
        length = 1 / np.sqrt(np.where(np.diag(problem.Q) > 0, 2 * np.diag(problem.Q), 1.0))
        soft = problem.bounded_states[problem.soft_rows[: len(problem.bounded_states)]]
        states = np.tile(_COUPLING * length[soft], problem.horizon)
        states = states[: self._below.stop - self._below.start]
        return states, float(_COUPLING * length[problem.model.position].mean())

    def _hessian(self) -> sparse.csc_matrix:
        problem, N, nx = self._problem, self._problem.horizon, self._problem.model.nx
        nu, blocks = problem.model.nu, SparseBlocks()
        linear = isinstance(problem.model, LinearModel)
        weights = np.stack([problem.Q] * (N - 1) + [problem.Qf])
        i, x, u = np.arange(N)[:, None, None], np.arange(nx), np.arange(nu)
        state, control = self._e.start + i * nx, self._u.start + i * nu
        # A linear robot's zeros stay out of the pattern; curvature may come where they are.
        row, column = (np.broadcast_to(k, (N, nx, nx)) for k in (state + x[:, None], state + x))
        there = np.broadcast_to((weights != 0).any(axis=0) | (not linear), weights.shape)
        blocks.add("Q", row[there], column[there], 2 * weights[there])
        effort = np.broadcast_to(problem.R, (N, nu, nu))
        row, column = (np.broadcast_to(k, (N, nu, nu)) for k in (control + u[:, None], control + u))
        there = np.broadcast_to((problem.R != 0) | (not linear), effort.shape)
        blocks.add("R", row[there], column[there], 2 * effort[there])
        sizes = np.arange(self._s.start, self._s.stop)
        blocks.add("s", sizes, sizes, 2 * problem.size.weight)
        if not linear:
            rows, columns = np.broadcast_arrays(state[:-1] + x[:, None], control[1:] + u)
            blocks.add("ex", rows, columns, 0.0)
            blocks.add("xe", columns, rows, 0.0)
        n = self._slack.stop
        return blocks.build((n, n))[0]

    def _constraints(self, shape: tuple[int, int]) -> tuple[sparse.csc_matrix, dict[str, IntArray]]:
        problem, nodes, layout, S = self._problem, self._nodes, self._layout, self._slots
        model, N = problem.model, problem.horizon
        i = np.arange(N)[:, None, None]
        row = self._dynamics.start + i * model.nx + np.arange(model.nx)[:, None]
        state = self._e.start + i * model.nx + np.arange(model.nx)
        control = self._u.start + i * model.nu + np.arange(model.nu)
        blocks = SparseBlocks()
        diagonal = np.arange(N * model.nx)
        blocks.add("next", self._dynamics.start + diagonal, self._e.start + diagonal, 1.0)
        blocks.add("A", row[1:], state[:-1], 0.0)
        blocks.add("B", row, control, 0.0)
        bounded = self._bounded.start
        sizes, inputs = np.arange(layout.moving), np.arange(N * model.nu)
        blocks.add("s", bounded + sizes, self._s.start + sizes, 1.0)
        blocks.add("u", bounded + layout.inputs.start + inputs, self._u.start + inputs, 1.0)
        rates = np.arange(layout.inputs.stop, layout.states.start)
        blocks.add("du", bounded + rates, self._u.start + np.arange(len(rates)), 1.0)
        later = rates[model.nu :]
        blocks.add("du before", bounded + later, self._u.start + np.arange(len(later)), -1.0)
        which, entry = np.nonzero(problem.state_rows)
        first = bounded + layout.states.start + len(problem.state_rows) * np.arange(N)[:, None]
        values = np.tile(problem.state_rows[which, entry], N)
        blocks.add("z", (first + which).ravel(), state[:, 0, entry].ravel(), values)
        inner = nodes.count - nodes.discs
        space = self._spaces.start + np.arange(nodes.size * S).reshape(N, nodes.count, S, 1)
        state, control = state[:, :, None], control[:, :, None]
        blocks.add("at", space[:, inner:], state[..., self._support], 0.0)
        if inner:
            blocks.add("along states", space[1:, :inner], state[:-1], 0.0)
            blocks.add("along inputs", space[:, :inner], control, 0.0)
        if layout.moving:
            s = self._s.start + sizes
            blocks.add(
                "slopes", space.reshape(-1, 1), np.broadcast_to(s, (space.size, len(s))), 0.0
            )
        if self.elastic:
            pins = np.arange(self._pins.start, self._pins.stop)
            blocks.add("pins", pins, np.arange(self._below.start, self._slack.stop), 1.0)
            for name, part, sign in (("below", self._below, 1.0), ("above", self._above, -1.0)):
                columns = np.arange(part.start, part.stop)
                rows = bounded + layout.soft[: len(columns)]
                blocks.add(name, rows, columns, sign * self._coupling[0])
            slack = np.arange(self._slack.start, self._slack.stop)
            blocks.add("slack", space.ravel(), slack, self._coupling[1])
        return blocks.build(shape)


def _slices(sizes: list[int]) -> list[slice]:
    stops = np.cumsum(sizes).tolist()
    return [slice(stop - size, stop) for stop, size in zip(stops, sizes, strict=True)]


def _stage_blocks(P: sparse.csc_matrix, N: int, nx: int, nu: int) -> tuple[IntArray, IntArray]:
    """Where curvature blocks (N, nx+nu, nx+nu) in (x_i, u_i) go: places in P.data, and in them.

    The state of stage 0 is given: its block has nowhere to go.
    """
    n = nx + nu
    column = np.repeat(np.arange(P.shape[1]), np.diff(P.indptr))
    place = {key: k for k, key in enumerate(zip(P.indices.tolist(), column.tolist(), strict=True))}
    to, source = [], []
    for i in range(N):
        at = [(i - 1) * nx + k if i else -1 for k in range(nx)]
        at += [N * nx + i * nu + k for k in range(nu)]
        for row in range(n):
            for col in range(n):
                key = at[row], at[col]
                if min(key) >= 0 and key in place:
                    to.append(place[key])
                    source.append((i * n + row) * n + col)
    return np.array(to, dtype=np.intp), np.array(source, dtype=np.intp)
