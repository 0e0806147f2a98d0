"""The subproblem: fixed pattern, values through index maps, against a slow dense rebuild."""

import numpy as np
import pytest
from instances import S_REF, instance, problem

from scp_mpc import DoubleIntegrator
from scp_mpc.solver.iterate import Iterate, Multipliers
from scp_mpc.solver.sparse_blocks import SparseBlocks
from scp_mpc.solver.step_data import StepData
from scp_mpc.solver.subproblem import Subproblem


def dense(problem, step, spaces, soft):
    """Build the program row by row, the obvious way."""
    model, N, M = problem.model, problem.horizon, problem.max_obstacles
    nx, nu, margin = model.nx, model.nu, problem.margin
    at_x, at_u, at_s, at_slack = 0, N * nx, N * (nx + nu), N * (nx + nu) + M
    n = at_slack + M * N
    P, q = np.zeros((n, n)), np.zeros(n)
    rows, lower, upper = [], [], []

    def row(lo, up, *entries):
        a = np.zeros(n)
        for where, what in entries:
            a[where] += what
        rows.append(a)
        lower.append(lo)
        upper.append(up)

    for i in range(N):
        weight = problem.Qf if i == N - 1 else problem.Q
        x = slice(at_x + i * nx, at_x + (i + 1) * nx)
        u = slice(at_u + i * nu, at_u + (i + 1) * nu)
        P[x, x], P[u, u] = 2 * weight, 2 * problem.R
    for j in range(M):
        P[at_s + j, at_s + j] = 2 * margin.weight
        q[at_s + j] = -2 * margin.weight * margin.reference
    if soft:
        q[at_slack:] = problem.slack_weight
    for i in range(N):
        for a in range(nx):
            entries = [(at_x + i * nx + a, 1.0)]
            entries += [(at_u + i * nu + b, -model.B[a, b]) for b in range(nu)]
            before = step.x0 if i == 0 else step.x_ref[i]
            known = model.A[a] @ before - step.x_ref[i + 1][a]
            if i > 0:
                entries += [(at_x + (i - 1) * nx + b, -model.A[a, b]) for b in range(nx)]
            row(known, known, *entries)
    for i in range(N):
        for a in range(nu):
            row(problem.u_min[a], problem.u_max[a], (at_u + i * nu + a, 1.0))
    for j in range(M):
        row(margin.lower, margin.upper, (at_s + j, 1.0))
    for j in range(M):
        for i in range(N):
            entries = [
                (at_x + i * nx + c, v)
                for c, v in zip(model.position, spaces.normal[j, i], strict=True)
            ]
            entries += [(at_s + j, spaces.slope[j, i]), (at_slack + j * N + i, 1.0)]
            along = spaces.normal[j, i] @ step.x_ref[i + 1][model.position]
            row(spaces.offset[j, i] - along, np.inf, *entries)
    for k in range(M * N):
        row(0.0, np.inf if soft else 0.0, (at_slack + k, 1.0))
    return P, q, np.array(rows), np.array(lower), np.array(upper)


def random_program(dim=2, soft=False, seed=0):
    """A subproblem with two slots, one used, filled about random points."""
    rng = np.random.default_rng(seed)
    case = instance("crossing", 8, "exact", 0.5, seed)
    changes = {"max_obstacles": 2, "Qf": [3.0, 0.4, 2.0, 0.1], "u_min": [-1.0, -2.0]}
    if dim == 3:
        changes = {
            "model": DoubleIntegrator(0.1, dim=3),
            "Q": rng.uniform(0, 1, 6),
            "R": np.ones(3),
            "max_obstacles": 2,
        }
    this = problem(8, "exact", 0.5, **changes)
    nx = this.model.nx
    obstacles = case.obstacles if dim == 2 else []
    step = StepData.read(this, rng.normal(size=nx), rng.normal(size=(9, nx)), obstacles)
    spaces = step.half_spaces(rng.normal(size=(9, nx)), rng.uniform(1, 3, 2))
    subproblem = Subproblem(this)
    subproblem.soft = soft
    subproblem.write_step(step.x0, step.x_ref)
    subproblem.write_half_spaces(spaces)
    return this, step, spaces, subproblem


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("soft", [False, True])
def test_equals_the_dense_rebuild(dim, soft):
    this, step, spaces, subproblem = random_program(dim, soft)
    P, q, A, lower, upper = dense(this, step, spaces, soft)
    program = subproblem.program
    np.testing.assert_array_equal(program.P.toarray(), P)
    np.testing.assert_allclose(program.q, q, rtol=1e-15)
    np.testing.assert_array_equal(program.A.toarray(), A)
    np.testing.assert_allclose(program.lower, lower, rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(program.upper, upper, rtol=1e-14, atol=1e-14)


def test_no_zero_is_stored_in_the_hessian():
    """With diagonal weights, one entry for each state, input and size; none for the slack."""
    N, M = 30, 12
    P = Subproblem(problem(N, max_obstacles=M)).program.P
    assert P.nnz == N * 6 + M


def test_updated_equals_freshly_built_and_keeps_its_pattern():
    this, step, spaces, fresh = random_program(seed=1)
    _, other_step, other_spaces, _ = random_program(seed=2)
    used = Subproblem(this)
    pattern = used.program.A.indices.copy(), used.program.A.indptr.copy()
    data = used.program.A.data
    used.soft = True
    used.write_step(other_step.x0, other_step.x_ref)
    used.write_half_spaces(other_spaces)
    used.soft = False
    used.write_step(step.x0, step.x_ref)
    used.write_half_spaces(spaces)
    for name in ("q", "lower", "upper"):
        np.testing.assert_array_equal(getattr(used.program, name), getattr(fresh.program, name))
    np.testing.assert_array_equal(used.program.A.data, fresh.program.A.data)
    assert used.program.A.data is data
    np.testing.assert_array_equal(used.program.A.indices, pattern[0])
    np.testing.assert_array_equal(used.program.A.indptr, pattern[1])


def test_pack_and_unpack_are_inverse():
    this, step, _, subproblem = random_program()
    rng = np.random.default_rng(0)
    N, M = 8, 2
    iterate = Iterate(
        np.vstack([step.x0, rng.normal(size=(N, 4))]),
        rng.uniform(-1, 1, (N, 2)),
        rng.uniform(1, 2, M),
        rng.uniform(0, 1, (M, N)),
        Multipliers(
            rng.normal(size=(N, 4)),
            rng.normal(size=(N, 2)),
            rng.normal(size=M),
            rng.normal(size=(M, N)),
            rng.normal(size=(M, N)),
        ),
    )
    again = subproblem.unpack(*subproblem.pack(iterate))
    for name in ("states", "inputs", "s", "slack"):
        np.testing.assert_allclose(getattr(again, name), getattr(iterate, name), rtol=1e-14)
    for name in ("dynamics", "inputs", "margin", "obstacles", "slack"):
        np.testing.assert_array_equal(
            getattr(again.multipliers, name), getattr(iterate.multipliers, name)
        )
    assert this.horizon == N


def test_unpack_clips_what_rounding_lets_through():
    this, _, _, subproblem = random_program()
    z, y = np.full(len(subproblem.program.q), 99.0), np.zeros(len(subproblem.program.lower))
    high, low = subproblem.unpack(z, y), subproblem.unpack(-z, y)
    assert (high.inputs == this.u_max).all()
    assert (low.inputs == this.u_min).all()
    assert (high.s == 10.0).all()
    assert (low.s == 0.5).all()
    assert (low.slack == 0.0).all()


def test_the_objective_is_the_problems_cost():
    this, step, _, subproblem = random_program()
    rng = np.random.default_rng(3)
    z, y = rng.uniform(0.5, 1.0, len(subproblem.program.q)), np.zeros(0)
    iterate = subproblem.unpack(z, np.zeros(len(subproblem.program.lower)))
    z, y = subproblem.pack(iterate)
    program = subproblem.program
    constant = 2 * this.margin.weight * S_REF**2
    value = z @ (program.P @ z) / 2 + program.q @ z + constant
    cost = this.cost(iterate.states, iterate.inputs, iterate.s, step.x_ref)
    assert value == pytest.approx(cost, rel=1e-12)
    assert y is not None


def test_blocks_refuse_to_overlap():
    blocks = SparseBlocks()
    blocks.add("one", [0, 1], [0, 1], 1.0)
    blocks.add("two", [1], [1], 2.0)
    with pytest.raises(ValueError, match="same entry"):
        blocks.build((2, 2))


def test_blocks_keep_zeros_in_the_pattern():
    blocks = SparseBlocks()
    blocks.add("values", [[2, 0], [1, 0]], [[0, 1], [1, 0]], [[0.0, 3.0], [4.0, 5.0]])
    matrix, places = blocks.build((3, 2))
    assert matrix.nnz == 4
    matrix.data[places["values"]] = [1.0, 2.0, 3.0, 4.0]
    np.testing.assert_array_equal(matrix.toarray(), [[4, 2], [0, 3], [1, 0]])
