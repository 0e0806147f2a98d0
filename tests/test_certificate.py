"""The certificate: the residual that CasADi's own derivatives give, at plans good and bad."""

from concurrent.futures import ThreadPoolExecutor

import casadi
import numpy as np
import pytest
from driving import drive, same
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import KINDS, S_REF, instance, obstacle, problem, straight_reference

from scp_mpc import MPC, SCP, QPSettings, Settings, Status, Trajectory
from scp_mpc.solver import condensed_scp
from scp_mpc.solver.conflicts import Conflicts
from scp_mpc.solver.layout import Layout
from scp_mpc.solver.sampling import Sampling
from scp_mpc.solver.step_data import StepData


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
    engine = solver._resolution.coarse
    guess = Trajectory(case.x_ref, np.zeros((12, 2)))
    monkeypatch.setattr(engine, "descend", lambda start: engine.primary.descend(start, limit))
    monkeypatch.setattr(solver, "_rescue", lambda *given: given[-1])
    plan = solver.solve(case.x0, case.x_ref, case.obstacles, guess)
    stationarity, feasibility, product = residuals(case, plan)
    assert plan.kkt.stationarity == pytest.approx(stationarity, rel=1e-6, abs=1e-10)
    assert plan.kkt.feasibility == pytest.approx(feasibility, rel=1e-6, abs=1e-10)
    assert plan.kkt.complementarity == pytest.approx(product, rel=1e-5, abs=1e-10)


def true_values(case, plan, x0, ref, obstacles):
    step = StepData.read(case, x0, ref, obstacles)
    return step.half_spaces(plan.X, plan.iterate.s).value[: len(obstacles)]


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
    step = StepData.read(case, ref[0], ref, [obstacle(1, offset, covariance=Sigma, growth=0.0)])
    near = step.within(ref[:, [0, 2]], np.array([S_REF]), distance)
    true = case.no_go.clearance(step.sets, ref[1:, [0, 2]])[0, 0]
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


def test_a_program_sent_to_the_rescue_on_purpose_gives_the_same_plan():
    """PIQP at once, OSQP at full accuracy, and the active-set method: one plan."""
    case = instance("beside", 20, "exact", S_REF, 0)
    guess = Trajectory(case.x_ref, np.zeros((20, 2)))
    patient = QPSettings(max_iterations=100_000, rescue=False, cold=1e9)
    ways = {
        "daqp": Settings(multi_start=False),
        "piqp": Settings(multi_start=False, condense=False, qp=QPSettings(cold=1e-300)),
        "osqp": Settings(multi_start=False, condense=False, qp=patient),
    }
    plans = {
        name: SCP(case.problem, how).solve(case.x0, case.x_ref, case.obstacles, guess)
        for name, how in ways.items()
    }
    for name, plan in plans.items():
        assert plan.status is Status.CONVERGED
        assert set(plan.qps) <= {name, "kkt"}
        assert plan.cost == pytest.approx(plans["daqp"].cost, rel=1e-6)
        np.testing.assert_allclose(plan.X, plans["daqp"].X, atol=2e-3)


@pytest.mark.parametrize("inflation", ["exact", "axes"])
def test_pairs_are_linearised_like_the_whole_table(inflation):
    """Also where p = mu, and only the offset one stage earlier tells the side."""
    rng = np.random.default_rng(0)
    case, ref = problem(8, inflation, max_obstacles=3), straight_reference(8)
    x0 = ref[0] + [0.0, 0.0, 0.3, 0.0]
    obstacles = [obstacle(8, (1.0, 0.2)), obstacle(8, (2.0, -0.4), (-0.5, 0.1))]
    layout = Layout(case, Sampling.of(case, 1))
    y = np.zeros(layout.size)
    y[layout.p], y[layout.s] = rng.normal(size=16), [S_REF, 2.0, 1.5]
    states = ref.copy()
    states[1:, [0, 2]] += y[layout.p].reshape(8, 2)
    states[3, [0, 2]] = obstacles[0].means[3]
    states[1, [0, 2]] = obstacles[1].means[1]
    y[layout.p] = (states - ref)[1:, [0, 2]].ravel()
    step = StepData.read(case, x0, ref, obstacles)
    whole = step.half_spaces(states, y[layout.s])
    pairs = Conflicts(step, layout, np.ones((2, 8), dtype=bool))
    tangent = pairs.tangent(y)
    at = pairs.obstacle, pairs.point
    np.testing.assert_allclose(tangent.g, whole.value[at], atol=1e-12)
    np.testing.assert_allclose(tangent.a[:, :2], whole.normal[at], atol=1e-9)
    np.testing.assert_allclose(tangent.a[:, 2], whole.slope[at], atol=1e-9)
    paths = np.stack([states[:, [0, 2]]] * 2)
    paths[:, 0] = x0[[0, 2]]
    a, b = pairs.about(paths, y[layout.s])
    np.testing.assert_allclose(a[1], tangent.a, atol=1e-12)
    residual = (a[1] * y[pairs.at]).sum(axis=1) - b[1]
    np.testing.assert_allclose(residual, whole.value[at], atol=1e-9)


def test_pairs_left_out_come_back_when_the_plan_moves_onto_them(monkeypatch):
    """With nothing but the guess's own pairs, the plan is pushed into the second obstacle."""
    monkeypatch.setattr(condensed_scp, "_NEAR", 0.0)
    case, ref = problem(20, max_obstacles=2), straight_reference(20)
    both = [obstacle(20, (3.0, 0.15)), obstacle(20, (3.4, -1.4))]
    solver = SCP(case, Settings(multi_start=False))
    monkeypatch.setattr(
        solver._resolution.coarse.sparse, "descend", lambda *_: pytest.fail("no need")
    )
    plan = solver.solve(ref[0], ref, both, Trajectory(ref, np.zeros((20, 2))))
    assert plan.status is Status.CONVERGED
    assert true_values(case, plan, ref[0], ref, both).min() >= -1e-6
    assert plan.iterate.touched.any(axis=1).all()


def test_the_slacks_own_multipliers_balance_their_price():
    """Where a pair yields: price + force on the pair + multiplier of slack >= 0 is nothing."""
    case = problem(8)
    x0, ref = np.array([0.0, 4.0, 0.0, 0.0]), straight_reference(8, 4.0)
    plan = SCP(case).solve(x0, ref, [obstacle(8, (1.2, 0.05), covariance=np.eye(2))])
    assert plan.status is Status.SOFTENED
    assert set(plan.qps) <= {"kkt", "daqp"}
    balance = case.slack_weight + plan.multipliers.obstacles + plan.multipliers.slack
    np.testing.assert_allclose(balance, 0.0, atol=1e-6)
    assert (plan.multipliers.slack <= 1e-9).all()
    assert (np.abs(plan.multipliers.slack[plan.slack > 1e-6]) < 1e-6).all()
