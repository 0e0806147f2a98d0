"""The certificate: the residual that CasADi's own derivatives give, at plans good and bad."""

from concurrent.futures import ThreadPoolExecutor

import casadi
import numpy as np
import pytest
from driving import drive, same
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import KINDS, S_REF, instance, obstacle, problem, straight_reference
from nonlinear_cases import machine_problem, straight
from rebuilt import slopes
from solving import half_spaces

from scp_mpc import MPC, SCP, QPSettings, Settings, Status, Trajectory
from scp_mpc.deadline import Clock
from scp_mpc.geometry.no_go import NoGoSets
from scp_mpc.qp.active_set import QPSolution
from scp_mpc.scp import transcription
from scp_mpc.scp.certificate import least_curvature
from scp_mpc.scp.layout import Layout
from scp_mpc.scp.nodes import Nodes
from scp_mpc.scp.pairs import Pairs
from scp_mpc.scp.step import Step
from scp_mpc.scp.transcription import Transcription
from scp_mpc.trajectory import rollout


def residuals(case, plan):
    """Stationarity in the inputs and the size, by single shooting, with the plan's forces."""
    problem, model, N = case.problem, case.problem.model, case.problem.horizon
    prediction, reach = case.obstacles[0], case.problem.robot_radius + case.obstacles[0].radius
    U, s = casadi.SX.sym("U", 2, N), casadi.SX.sym("s")
    x, cost, g = casadi.DM(case.x0), problem.margin.weight * (s - problem.margin.reference) ** 2, []
    for i in range(N):
        x = model.A @ x + model.B @ U[:, i]
        e = x - casadi.DM(case.x_ref[i + 1])
        cost += e.T @ casadi.DM(problem.Q) @ e + U[:, i].T @ casadi.DM(problem.R) @ U[:, i]
        variances, axes = np.linalg.eigh(prediction.covariances[i + 1])
        y = casadi.DM(axes).T @ (casadi.vertcat(x[0], x[2]) - casadi.DM(prediction.means[i + 1]))
        sigma = np.sqrt(variances)
        shortest = problem.margin.reference * sigma.min() + reach
        g.append(shortest * (casadi.norm_2(y / (s * sigma + reach)) - 1))
    force = casadi.DM(-plan.multipliers.obstacles[0])
    beta, beta_s = -plan.multipliers.inputs.ravel(), -plan.multipliers.margin
    lagrangian = cost - force.T @ casadi.vertcat(*g)
    z = casadi.vertcat(casadi.vec(U), s)
    values = casadi.Function("f", [z], [casadi.gradient(lagrangian, z), casadi.vertcat(*g)])
    at = np.concatenate([plan.U.ravel(), plan.iterate.s])
    gradient, constraint = (np.array(v).ravel() for v in values(at))
    gradient -= np.concatenate([beta, beta_s])
    e = plan.X[1:] - case.x_ref[1:]
    scale = max(1.0, 2 * np.abs(e @ problem.Q).max(), 2 * np.abs(plan.U @ problem.R).max())
    gap = np.array(constraint)
    product = np.abs(np.array(force).ravel() * gap).max() / max(1.0, plan.cost)
    return np.abs(gradient).max() / scale, max(0.0, -gap.min()), product


@pytest.mark.parametrize("limit", [1, 2, 40])
@pytest.mark.parametrize("s_min", [S_REF, 0.5])
@pytest.mark.parametrize("kind", KINDS)
def test_equals_an_independent_computation(monkeypatch, kind, s_min, limit):
    case = instance(kind, 12, "axes", s_min, 1)
    solver = SCP(case.problem, Settings(multi_start=False, max_iterations=limit))
    guess = Trajectory(case.x_ref, np.zeros((12, 2)))
    monkeypatch.setattr(solver, "_rescued", lambda *given: given[2])
    plan = solver.solve(case.x0, case.x_ref, case.obstacles, guess)
    stationarity, feasibility, product = residuals(case, plan)
    assert plan.kkt.stationarity == pytest.approx(stationarity, rel=1e-6, abs=1e-10)
    assert plan.kkt.feasibility == pytest.approx(feasibility, rel=1e-6, abs=1e-10)
    assert plan.kkt.complementarity == pytest.approx(product, rel=1e-5, abs=1e-10)


def true_values(case, plan, x0, ref, obstacles):
    step = Step.read(case, x0, ref, obstacles)
    return half_spaces(step, plan.X[1:, case.model.position], plan.iterate.s).value


@given(
    seed=st.integers(0, 10_000),
    count=st.integers(1, 6),
    inflation=st.sampled_from(["exact", "axes"]),
)
@settings(max_examples=60, deadline=None)
def test_what_was_left_out_is_never_violated(seed, count, inflation):
    """Whatever the obstacles, a plan that counts as safe keeps clear of each, at every stage."""
    rng = np.random.default_rng(seed)
    case = problem(15, inflation, max_obstacles=6)
    ref = straight_reference(15)
    obstacles = [
        obstacle(
            15,
            tuple(rng.uniform([-1, -3], [7, 3])),
            tuple(rng.uniform(-1.5, 1.5, 2)),
            rng.uniform(0.001, 0.1) * np.eye(2),
        )
        for _ in range(count)
    ]
    plan = SCP(case).solve(ref[0], ref, obstacles)
    value = true_values(case, plan, ref[0], ref, obstacles)
    violated = max(0.0, -value.min())
    if plan.ok:
        assert violated <= 1e-6
    else:
        assert (np.maximum(0.0, -value) <= plan.slack + 1e-6).all()


@given(
    offset=st.tuples(st.floats(-6, 6), st.floats(-6, 6)),
    spread=st.floats(0.0, 1.0),
    distance=st.floats(0.0, 3.0),
)
def test_who_is_screened_out_is_farther_than_asked(offset, spread, distance):
    """Against the signed distance to the exact no-go set."""
    case, ref = problem(1, "exact"), straight_reference(1, 0.0)
    Sigma = np.array([[spread**2, 0.3 * spread**2], [0.3 * spread**2, spread**2 / 2]])
    step = Step.read(case, ref[0], ref, [obstacle(1, offset, covariance=Sigma, growth=0.0)])
    near = step.within(ref[:, [0, 2]], np.array([S_REF]), distance)
    sets = NoGoSets.stacked(step.means[:, 1:], step.covariances[:, 1:], step.radii, 1, step.shapes)
    true = case.no_go.clearance(sets, ref[1:, [0, 2]])[0, 0]
    if near is None:
        assert true > distance - 1e-9
    if true > distance + 2 * S_REF * spread + 1e-6:
        assert near is None


def test_a_clear_free_plan_is_taken_whatever_the_guess():
    case, ref = problem(20), straight_reference(20)
    aside = ref.copy()
    aside[1:, 2] = 3.0
    far = [obstacle(20, (3.0, 2.0))]
    plan = SCP(case).solve(ref[0], ref, far, Trajectory(aside, np.zeros((20, 2))))
    assert plan.status is Status.CONVERGED
    assert plan.iterations == 0
    assert plan.cost == pytest.approx(SCP(case).solve(ref[0], ref).cost, abs=1e-12)


def test_two_threads_give_the_same_bits_as_one():
    case = problem(8)
    alone = [drive(MPC(case), 12) for _ in range(2)]
    with ThreadPoolExecutor(2) as pool:
        together = list(pool.map(lambda _: drive(MPC(case), 12), range(2)))
    assert same(alone[0], alone[1])
    assert same(together[0], alone[0])
    assert same(together[1], alone[0])


def test_with_candidates_a_certified_plan_is_never_worse():
    for kind in KINDS:
        for seed in range(4):
            case = instance(kind, 20, "exact", S_REF, seed)
            guess = Trajectory(case.x_ref, np.zeros((20, 2)))
            kept, best = (
                SCP(case.problem, Settings(multi_start=sides)).solve(
                    case.x0, case.x_ref, case.obstacles, guess
                )
                for sides in (False, True)
            )
            assert kept.status is best.status is Status.CONVERGED
            assert best.cost <= kept.cost * (1 + 1e-9)


def test_a_program_sent_to_the_rescue_on_purpose_gives_the_same_plan(monkeypatch):
    """OSQP, PIQP, OSQP that gives up for PIQP, and any other solver: one plan."""
    case = instance("elongated", 20, "exact", S_REF, 0)
    given = case.x0, case.x_ref, case.obstacles
    ways = {
        "osqp": Settings(multi_start=False),
        "alone": Settings(multi_start=False, qp=QPSettings(rescue=False)),
        "piqp": Settings(multi_start=False, solver="piqp"),
        "clarabel": Settings(multi_start=False, solver="clarabel"),
    }
    plans = {name: SCP(case.problem, how).solve(*given) for name, how in ways.items()}
    with monkeypatch.context() as patch:
        patch.setattr("scp_mpc.qp.osqp.OSQP.run", lambda *_: None)
        plans["rescue"] = SCP(case.problem, ways["osqp"]).solve(*given)
    assert plans["rescue"].qps["piqp"] > 0
    assert "osqp" not in plans["rescue"].qps
    for plan in plans.values():
        assert plan.status is Status.CONVERGED
        assert plan.cost == pytest.approx(plans["osqp"].cost, rel=1e-6)
        np.testing.assert_allclose(plan.X, plans["osqp"].X, atol=2e-3)


@pytest.mark.parametrize("inflation", ["exact", "axes"])
def test_pairs_are_linearised_like_the_whole_table(inflation):
    """Also where p = mu, and only the offset one stage earlier tells the side."""
    rng = np.random.default_rng(0)
    case, ref = problem(8, inflation, max_obstacles=3), straight_reference(8)
    x0 = ref[0] + [0.0, 0.0, 0.3, 0.0]
    obstacles = [obstacle(8, (1.0, 0.2)), obstacle(8, (2.0, -0.4), (-0.5, 0.1))]
    layout = Layout(case, Nodes.of(case))
    y = np.zeros(layout.size)
    y[layout.s] = [S_REF, 2.0, 1.5]
    path = rng.normal(size=(8, 2))
    path[2], path[0] = obstacles[0].means[3], obstacles[1].means[1]
    y[layout.p] = (path - x0[[0, 2]]).ravel()
    step = Step.read(case, x0, ref, obstacles)
    whole = half_spaces(step, path, y[layout.s])
    pairs = Pairs(step, layout, np.ones((2, 8), dtype=bool))
    planes = pairs.planes(y)
    at = pairs.obstacle, pairs.node
    np.testing.assert_allclose(planes.g, whole.value[at], atol=1e-12)
    np.testing.assert_allclose(planes.a[:, :2], whole.normal[at], atol=1e-9)
    np.testing.assert_allclose(planes.a[:, 2], whole.slope[at], atol=1e-9)
    for other in pairs.about(np.stack([y, y]))[1:]:
        np.testing.assert_allclose(other.a, planes.a, atol=1e-12)
        np.testing.assert_allclose(other.g, planes.g, atol=1e-12)
        assert other.y is not planes.y
    some = np.zeros((2, 8), dtype=bool)
    some[0, 2:5] = some[1, 0] = True
    few = Pairs(step, layout, some)
    kept = some[at]
    np.testing.assert_allclose(few.planes(y).a, planes.a[kept], atol=1e-12)
    np.testing.assert_allclose(few.planes(y).g, planes.g[kept], atol=1e-12)
    table = few.table(few.planes(y).g)
    np.testing.assert_allclose(table, np.where(some, whole.value, 0.0), atol=1e-12)


def test_pairs_left_out_come_back_when_the_plan_moves_onto_them(monkeypatch):
    """With nothing but the guess's own pairs, the plan is pushed into the second obstacle."""
    monkeypatch.setattr(transcription, "_NEAR", 0.0)
    case, ref = problem(20, max_obstacles=2), straight_reference(20)
    both = [obstacle(20, (3.0, 0.15)), obstacle(20, (3.4, -1.4))]
    solver = SCP(case, Settings(multi_start=False))
    plan = solver.solve(ref[0], ref, both, Trajectory(ref, np.zeros((20, 2))))
    assert plan.status is Status.CONVERGED
    assert true_values(case, plan, ref[0], ref, both).min() >= -1e-6
    assert plan.iterate.touched.any(axis=1).all()


def test_the_slacks_own_multipliers_balance_their_price():
    """Where a pair yields: price + force on the pair + multiplier of slack >= 0 is nothing."""
    case = problem(8)
    standing = obstacle(8, (1.2, 0.05), covariance=np.eye(2), growth=0.0)
    plan = SCP(case).solve(np.zeros(4), straight_reference(8, -4.0), [standing])
    assert plan.status is Status.SOFTENED
    balance = case.slack_weight + plan.multipliers.obstacles + plan.multipliers.slack
    np.testing.assert_allclose(balance, 0.0, atol=1e-6)
    assert (plan.multipliers.slack <= 1e-9).all()
    assert (np.abs(plan.multipliers.slack[plan.slack > 1e-6]) < 1e-6).all()


# Second order


def drawn(seed, n=5, k=3, given=True):
    """A symmetric W or none, bends L, and rows; the second derivative is I + W - L'L."""
    rng = np.random.default_rng(seed)
    W, L = rng.normal(size=(n, n)), rng.uniform(0, 0.8) * rng.normal(size=(rng.integers(0, 4), n))
    W = W + W.T if given else None
    return rng, W, L, rng.normal(size=(k, n)), np.eye(n) + (0 if W is None else W) - L.T @ L


@given(seed=st.integers(0, 10_000), k=st.integers(0, 4), given=st.booleans())
def test_curvature_left_by_strongly_active_constraints_is_an_eigenvalue(seed, k, given):
    rng, W, L, rows, M = drawn(seed, k=k, given=given)
    least, direction = least_curvature(W, L, rows, rng.uniform(0.5, 2.0, k))
    basis = np.linalg.svd(rows)[2][k:] if k else np.eye(5)
    values = np.linalg.eigvalsh(basis @ M @ basis.T)
    # It is relative to a number that is at least about the largest of them.
    assert np.sign(np.round(least, 9)) == np.sign(np.round(values[0], 9))
    assert abs(least) <= abs(values[0]) / np.abs(values).max() + 1e-9 or values[0] > 0
    if direction.any() and values[0] < 0:
        d = direction / np.linalg.norm(direction)
        np.testing.assert_allclose(rows @ d, 0.0, atol=1e-7)
        assert d @ M @ d == pytest.approx(values[0], abs=1e-7)
    assert values[0] > 0 or direction.any()


@given(seed=st.integers(0, 10_000), weak=st.integers(1, 3), given=st.booleans())
def test_no_direction_of_the_critical_cone_bends_down_unless_it_is_said_so(seed, weak, given):
    """Against a dense fan of directions in the cone: one weak constraint takes none away."""
    rng, W, L, rows, M = drawn(seed, n=4, k=weak + 1, given=given)
    least, direction = least_curvature(W, L, rows, np.append(rng.uniform(0.5, 2.0), np.zeros(weak)))
    basis = np.linalg.svd(rows[:1])[2][1:]
    fan = rng.normal(size=(20_000, 3)) @ basis
    fan /= np.linalg.norm(fan, axis=1, keepdims=True)
    inside = fan[(fan @ rows[1:].T >= 0).all(axis=1)]
    bends = np.einsum("ki,ij,kj->k", inside, M, inside)
    if least < -1e-6:  # then here is one
        assert direction @ M @ direction < 0
        assert abs(rows[0] @ direction) < 1e-7
        assert (rows[1:] @ direction >= -1e-6).all()
    if weak == 1:
        # A direction or its opposite is always allowed: nothing may be overlooked.
        assert least < 0 or bends.min() > -1e-3
        assert least > 0 or bends.min() < 1e-2


def test_where_nothing_can_move_nothing_bends():
    for W in (-9.0 * np.eye(2), None):
        least, direction = least_curvature(W, 5.0 * np.eye(2), np.eye(2), np.ones(2))
        assert least > 0
        assert not direction.any()


@pytest.mark.parametrize("name", ["unicycle", "bicycle", "planar quadrotor"])
def test_the_second_derivative_is_that_of_the_rolled_out_cost(name):
    """In coordinates in which the Gauss-Newton part is the identity; no constraint is active."""
    case, N = machine_problem(name, 4, x_min=None, x_max=None), 4
    model, rng = case.model, np.random.default_rng(2)
    x_ref = straight(model, N)
    x0 = x_ref[0] + 0.3 * rng.normal(size=model.nx)
    at = Transcription(case, Settings(), Nodes.of(case))
    at.begin(Step.read(case, x0, x_ref, [], nodes=at.nodes), Clock())
    U = case.limited(model.equilibrium_input + 0.2 * rng.normal(size=(N, model.nu)))
    plan = at.plain(U)
    program = at.write(plan, at.linearise(plan), plan.planes)
    here, nothing = program.condensed.here, np.zeros(len(program.qp.F), dtype=np.intp)
    none = np.zeros((0, 0))
    there = QPSolution(here, 0.0 * nothing, nothing, nothing > 0, none, nothing[:0], none)
    least = at.second_order(plan, program, there)[0].residuals.curvature

    def errors(u):
        return (rollout(model.step, x0, u.reshape(N, -1)).states - x_ref)[1:].ravel()

    def cost(u):
        e = errors(u)
        push = u - np.tile(model.equilibrium_input, N)
        return e @ weights @ e + push @ np.kron(np.eye(N), case.R) @ push

    weights = np.kron(np.eye(N), case.Q)
    weights[-model.nx :, -model.nx :] = case.Qf
    u, n, h = U.ravel(), U.size, 1e-4
    G = slopes(errors, u)
    gauss = 2 * (G.T @ weights @ G + np.kron(np.eye(N), case.R))
    H, steps = np.zeros((n, n)), h * np.eye(n)
    for i, j in np.ndindex(n, n):
        signs = ((1, 1), (1, -1), (-1, 1), (-1, -1))
        corners = [a * b * cost(u + a * steps[i] + b * steps[j]) for a, b in signs]
        H[i, j] = sum(corners) / (4 * h * h)
    L = np.linalg.cholesky(gauss)
    whole = np.linalg.solve(L, np.linalg.solve(L, H).T)
    values = np.linalg.eigvalsh((whole + whole.T) / 2)
    assert least == pytest.approx(values[0] / np.abs(values).max(), abs=1e-3)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_a_unicycle_at_rest_with_its_goal_abeam_does_not_stand_still(side):
    """Standing still meets all conditions of first order there: a saddle."""
    case = machine_problem("unicycle", 15)
    x0, goal = np.zeros(4), np.array([0.0, side * 2.0, 0.0, 0.0])
    plan = SCP(case).solve(x0, goal)
    rest = case.cost(np.zeros((16, 4)), np.zeros((15, 2)), np.full(1, 2.0), np.tile(goal, (16, 1)))
    assert plan.status is Status.CONVERGED
    assert plan.cost < 0.9 * rest
    assert plan.kkt.curvature >= -1e-6
    mpc, x = MPC(case), x0
    for _ in range(60):
        x = case.model.step(x, mpc.step(x, goal).u0)
    assert np.linalg.norm(x[:2] - goal[:2]) < 0.5


def test_certified_plans_say_how_they_are_curved():
    for kind in KINDS:
        case = instance(kind, 12, "exact", S_REF, 0)
        plan = SCP(case.problem).solve(case.x0, case.x_ref, case.obstacles)
        assert plan.status is Status.CONVERGED
        if plan.iterate.touches:
            assert plan.kkt.curvature >= -1e-6
