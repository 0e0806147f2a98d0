"""Between the samples: points there, room for what moves between two points, no tunnelling."""

import casadi
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import DT, obstacle, problem, rotated, straight_reference

from scp_mpc import (
    MPC,
    SCP,
    DoubleIntegrator,
    LinearModel,
    Margin,
    ObstaclePrediction,
    Settings,
    StageRisk,
    Status,
)
from scp_mpc.scp.condensing import Derivatives
from scp_mpc.scp.nodes import LinearNodes, Motion, Nodes

N = 12


def position(x, u, t):
    """Of a planar double integrator, t seconds into an interval."""
    return x[[0, 2]] + t * x[[1, 3]] + t * t / 2 * u


def gap(plan, prediction, steps=40):
    """Smallest distance to a mean that moves in straight lines, by looking closely."""
    best = np.inf
    for i in range(len(plan.U)):
        for share in np.linspace(0, 1, steps + 1):
            mean = (1 - share) * prediction.means[i] + share * prediction.means[i + 1]
            p = position(plan.X[i], plan.U[i], share * DT)
            best = min(best, np.linalg.norm(p - mean))
    return best


def thin(x):
    """A thin obstacle that crosses the robot's way at 4 m/s, just between two samples."""
    t = DT * np.arange(N + 1)
    means = np.stack([np.full(N + 1, x), 4.0 * (t - x / 4.0)], axis=1)
    return ObstaclePrediction(means, 1e-4 * np.eye(2), 0.05)


@pytest.mark.parametrize("settings", [Settings(), Settings(solver="piqp")])
@pytest.mark.parametrize("inflation", ["exact", "axes"])
@pytest.mark.parametrize("x", [4.4, 4.2])
def test_nothing_tunnels_through_a_thin_fast_obstacle(x, inflation, settings):
    ref = straight_reference(N, 4.0)
    case = {"robot_radius": 0.1, "inflation": inflation}
    at_samples = SCP(problem(N, **case), settings).solve(ref[0], ref, [thin(x)])
    assert at_samples.ok
    assert gap(at_samples, thin(x)) < 0.01  # right through it
    default = SCP(problem(N, **case, nodes_per_interval=4), settings).solve(ref[0], ref, [thin(x)])
    assert default.status is Status.CONVERGED
    assert gap(default, thin(x)) >= 0.15


@pytest.mark.parametrize("K", [2, 4])
@pytest.mark.parametrize("stage", [3, 4])
def test_nothing_tunnels_that_sets_out_all_at_once(stage, K):
    """An obstacle at rest beside the robot, in touch with it, dashes through it at one stage."""
    means = np.tile([0.0, 0.36], (N + 1, 1))
    means[stage:, 1] = 0.36 - 0.75 * K
    dash = ObstaclePrediction(means, np.zeros((2, 2)), 0.2)
    plan = SCP(problem(N, nodes_per_interval=K)).solve(np.zeros(4), np.zeros(4), [dash])
    assert not plan.ok or gap(plan, dash) >= 0.35


def test_more_points_cost_less():
    """Enlarged radii make any number of points sound; more points need less room."""
    ref = straight_reference(N, 4.0)
    costs = [
        SCP(problem(N, robot_radius=0.1, nodes_per_interval=K)).solve(ref[0], ref, [thin(4.4)]).cost
        for K in (2, 4, 8)
    ]
    assert costs[0] > costs[1] > costs[2] > 0


@settings(deadline=None, max_examples=40)
@given(
    seed=st.integers(0, 10_000),
    speed=st.floats(0.5, 5.0),
    nodes_per_interval=st.sampled_from([2, 3, 4]),
)
def test_plans_that_are_ok_keep_the_radii_at_all_times(seed, speed, nodes_per_interval):
    rng = np.random.default_rng(seed)
    ref = straight_reference(N, speed)
    meet, velocity = rng.uniform(0.3, 1.0) * N * DT, rng.uniform(-3, 3, 2)
    start = [speed * meet, 0.0] - meet * velocity + rng.uniform(-0.3, 0.3, 2)
    moving = obstacle(N, tuple(start), tuple(velocity), 1e-3 * np.eye(2), growth=0.0)
    plan = SCP(problem(N, nodes_per_interval=nodes_per_interval)).solve(ref[0], ref, [moving])
    if plan.ok:
        assert gap(plan, moving) >= 0.35


def test_nodes_are_the_same_whatever_the_speed():
    """In any interval of any plan: no change that could make a plan infeasible."""
    mpc = MPC(problem(N, nodes_per_interval=4))
    for speed in (1.0, 4.0, 1.0):
        ref = straight_reference(N, speed)
        for aside in (0.1, 0.7):
            plan = mpc.step(ref[0], ref, [obstacle(N, (0.6 * speed * N * DT, aside))])
            assert plan.status is Status.CONVERGED
            assert plan.iterate.touches
            assert plan.iterate.slack.shape == mpc.nominal().slack.shape == (1, 4 * N)
            assert plan.slack.shape == (1, N)


@pytest.mark.parametrize("dim", [2, 3])
def test_positions_within_an_interval(dim):
    model, rng = DoubleIntegrator(DT, dim), np.random.default_rng(0)
    x, u = rng.normal(size=2 * dim), rng.normal(size=dim)
    for share in (0.25, 0.5, 0.9):
        C, D = model.between(share)
        t = share * DT
        np.testing.assert_allclose(C @ x + D @ u, x[::2] + t * x[1::2] + t * t / 2 * u, atol=1e-12)


def test_a_discrete_model_is_interpolated_between_its_samples():
    """Eigenvalues that no continuous motion has: the straight line has to do."""
    flip = LinearModel(np.diag([-1.0, 0.5]), np.ones((2, 1)), DT, [0, 1])
    C, D = flip.between(0.5)
    x, u = np.array([1.0, 2.0]), np.array([0.3])
    np.testing.assert_allclose(C @ x + D @ u, (x + flip.step(x, u)) / 2)


def test_forces_are_the_adjoint_of_positions():
    rng, model = np.random.default_rng(0), DoubleIntegrator(DT, 3)
    for count in (1, 3):
        nodes = LinearNodes(model, 5, count)
        e, u = rng.normal(size=(5, 6)), rng.normal(size=(5, 3))
        phi = rng.normal(size=(nodes.size, 3))
        A, B = (np.tile(M, (5, 1, 1)) for M in (model.A, model.B))
        along = Derivatives(A, B, *nodes.derivatives(np.zeros((6, 6)), u)[1:])
        on_e, on_u = along.pull(phi.ravel())
        worked = (on_e * e).sum() + (0 if on_u is None else (on_u * u).sum())
        moved = along.moved(e[..., None], u[..., None]).reshape(-1, 3)
        assert worked == pytest.approx((phi * moved).sum())
        states = np.concatenate([np.zeros((1, 6)), e])
        np.testing.assert_allclose(nodes.positions(states, u), moved, atol=1e-12)
        slow = [
            model.between(k / count)[0] @ states[i] + model.between(k / count)[1] @ u[i]
            if k < count
            else states[i + 1, ::2]
            for i in range(5)
            for k in range(1, count + 1)
        ]
        np.testing.assert_allclose(nodes.positions(states, u), slow, atol=1e-12)


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 10_000))
def test_interpolated_covariances_err_on_the_safe_side(seed):
    """For a straight way between two Gaussians of any correlation."""
    rng = np.random.default_rng(seed)
    G = rng.normal(size=(4, 4))
    joint = G @ G.T
    nodes = LinearNodes(DoubleIntegrator(DT), 1, 4)
    ours = nodes.interpolated(np.array([[joint[:2, :2], joint[2:, 2:]]]))[0]
    for k in range(5):
        mix = np.hstack([(1 - k / 4) * np.eye(2), k / 4 * np.eye(2)])
        assert np.linalg.eigvalsh(ours[k] - mix @ joint @ mix.T)[0] >= -1e-9


def moved_past(nodes, ways, radius):
    """Nodes that are just clear of r' at any node, and the least distance between them."""
    robot, thing = ways
    motion, drift = (np.linalg.norm(np.diff(way, axis=0), axis=1) for way in ways)
    motion = Motion(motion, np.zeros(len(motion)))
    wide = nodes.radii(np.full((1, len(drift)), radius), drift[None], motion)[0]
    relative = robot - thing
    clear = np.linalg.norm(relative[1:], axis=1) >= wide
    between = relative[:-1, None] + np.linspace(0, 1, 101)[:, None] * np.diff(
        relative, axis=0
    ).reshape(-1, 1, 2)
    return clear, wide, np.linalg.norm(between, axis=2).min(axis=1)


@pytest.mark.parametrize("same_speed", [True, False])
def test_radii_leave_room_for_the_way_between_two_nodes(same_speed):
    """The chord of a circle: neighbours just clear of r' at either end, and what lies between."""
    rng, nodes, found = np.random.default_rng(0), LinearNodes(DoubleIntegrator(DT), 3, 1), 0
    for _ in range(3000):
        robot, thing = rng.uniform(0.1, 1) * rng.normal(size=(2, 4, 2))
        if same_speed:
            step = np.diff(robot, axis=0)
            step *= 0.8 / np.linalg.norm(step, axis=1, keepdims=True)
            robot[1:], thing = robot[0] + np.cumsum(step, axis=0), 0 * thing
        clear, _, gaps = moved_past(nodes, (robot, thing), 0.35)
        both = clear[:-1] & clear[1:]
        found += int(both.sum())
        assert (gaps[1:][both] >= 0.35 - 1e-12).all()
    assert found > 100


def test_radii_grow_by_half_the_chord_and_the_deviation_interval_by_interval():
    nodes, radii = LinearNodes(DoubleIntegrator(DT), 3, 2), np.full((1, 6), 0.35)
    motion = Motion(np.array([0.0, 0.6, 0.2]), np.array([0.1, 0.05, 0.0]))
    still = nodes.radii(radii, np.zeros((1, 6)), motion)[0]
    assert still[0] == pytest.approx(0.45)
    np.testing.assert_allclose(still[2:4], 0.5)
    assert still[5] == pytest.approx(np.hypot(0.35, 0.1))
    moving = nodes.radii(radii, np.full((1, 6), 0.1), motion)[0]
    assert moving[5] == pytest.approx(np.hypot(0.35, 0.15))


@pytest.mark.parametrize("K", [1, 2, 4])
def test_motion_is_what_lies_between_two_nodes(K):
    """A double integrator: the chord between instants, and an arc of height |u| t^2 / 8."""
    rng, model = np.random.default_rng(K), DoubleIntegrator(DT)
    nodes, U = LinearNodes(model, 4, K), rng.normal(size=(4, 2))
    states = [rng.normal(size=4)]
    for u in U:
        states.append(model.step(states[-1], u))
    motion = nodes.motion(np.array(states), U)
    for i, u in enumerate(U):
        path = np.array([position(states[i], u, k * DT / K) for k in range(K + 1)])
        assert motion.chord[i] == pytest.approx(np.linalg.norm(np.diff(path, axis=0), axis=1).max())
        assert motion.deviation[i] == pytest.approx(np.linalg.norm(u) * (DT / K) ** 2 / 8)
    most = LinearNodes(model, 4, K, np.array([3.0, 4.0])).most_deviation
    assert most == pytest.approx(5.0 * (DT / K) ** 2 / 8)


def test_what_is_assumed_of_the_motion_covers_neighbours_with_a_reserve():
    mine = Motion(np.array([0.0, 1.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 0.1]))
    other = Motion(np.array([0.0, 0.0, 0.0, 0.5]), np.zeros(4))
    assumed = mine.reserved(other, least=0.05)
    np.testing.assert_allclose(assumed.chord, 1.2 * np.array([1.0, 1.0, 1.0, 0.5]))
    np.testing.assert_allclose(assumed.deviation, [0.05, 0.05, 0.12, 0.12])
    assert assumed.covers(mine)
    assert assumed.covers(other)
    assert not mine.covers(assumed)
    assert not assumed.covers(Motion(np.array([0.0, 0.0, 0.0, 0.7]), np.zeros(4)))


@pytest.mark.parametrize("K", [2, 4])
def test_a_plan_that_outruns_what_was_assumed_is_not_called_safe(monkeypatch, K):
    """Assume that nothing moves between two points: the plan's own way is checked all the same."""
    monkeypatch.setattr(Nodes, "motion", lambda *_: Motion(np.zeros(N), np.zeros(N)))
    ref, case = straight_reference(N, 4.0), problem(N, robot_radius=0.1, nodes_per_interval=K)
    for x in (4.4, 4.3, 4.2):
        careless = SCP(case).solve(ref[0], ref, [thin(x)])
        if careless.ok and gap(careless, thin(x)) < 0.15:
            break
    else:
        pytest.fail("the assumption does not matter here")
    monkeypatch.undo()
    monkeypatch.setattr(Motion, "reserved", lambda *_: Motion(np.zeros(N), np.zeros(N)))
    checked = SCP(case).solve(ref[0], ref, [thin(x)])
    assert not checked.ok or gap(checked, thin(x)) >= 0.15
    if not checked.ok:  # then it says by how much
        assert checked.slack.max() == checked.kkt.feasibility > 0


def test_the_risk_of_an_interval_is_shared_by_its_points():
    ref = straight_reference(N, 4.0)
    ahead = obstacle(N, (5.0, 0.2), covariance=0.04 * np.eye(2))
    plan = SCP(problem(N, margin=StageRisk(0.05), nodes_per_interval=4)).solve(ref[0], ref, [ahead])
    assert plan.ok
    assert 0.01 <= plan.risk.stages.max() <= 0.05 * (1 + 1e-6)


def written_out(case, step):
    """The program with its points between the samples, in CasADi's own words."""
    U, s = casadi.SX.sym("U", 2, N), casadi.SX.sym("s")
    x, cost, g = casadi.DM(step.x0), case.size.weight * (s - case.size.reference) ** 2, []
    K = step.nodes.count
    for i in range(N):
        for k in range(1, K + 1):
            t, c = k * DT / K, i * K + k
            p = casadi.vertcat(x[0] + t * x[1], x[2] + t * x[3]) + t * t / 2 * U[:, i]
            variances, axes = np.linalg.eigh(step.covariances[0, c])
            y = casadi.DM(axes).T @ (p - casadi.DM(step.means[0, c]))
            sigma, r = np.sqrt(variances), step.radii[0, c - 1]
            shortest = case.size.reference * sigma.min() + r
            g.append(shortest * (casadi.norm_2(y / (s * sigma + r)) - 1))
        x = case.model.A @ x + case.model.B @ U[:, i]
        e = x - casadi.DM(step.x_ref[i + 1])
        cost += e.T @ casadi.DM(case.Q) @ e + U[:, i].T @ casadi.DM(case.R) @ U[:, i]
    return casadi.vertcat(casadi.vec(U), s), cost, casadi.vertcat(*g)


@pytest.mark.parametrize("solver", ["osqp", "piqp"])
@pytest.mark.parametrize("s_min", [2.4, 0.5])
@pytest.mark.parametrize("seed", range(3))
def test_certificate_and_optimum_agree_with_ipopt(seed, s_min, solver):
    rng = np.random.default_rng(seed)
    margin = Margin(2.4, s_min)
    case = problem(N, "axes", margin=margin, nodes_per_interval=4)
    ref = straight_reference(N, 4.0)
    Sigma = rotated((0.25, 0.1), rng.uniform(0, np.pi))
    ahead = obstacle(N, (5.0, rng.uniform(-0.3, 0.3)), (0.5, rng.uniform(-0.1, 0.1)), Sigma)
    patient = Settings(solver=solver, max_iterations=200)
    x0 = ref[0] + [-0.2, 0.3, 0.15, -0.2]  # neither here nor along the reference at rest
    ref[:, 3] += 0.1
    plan = SCP(case, patient).solve(x0, ref, [ahead])
    assert plan.status is Status.CONVERGED
    step = plan.step
    assert step.nodes.count == 4
    z, cost, g = written_out(case, step)
    force = casadi.DM(-plan.multipliers.obstacles[0])
    slope = casadi.Function("f", [z], [casadi.gradient(cost - force.T @ g, z), cost, g])
    gradient, value, constraint = slope(np.append(plan.U.ravel(), plan.iterate.s))
    bounds = np.append(plan.multipliers.inputs.ravel(), plan.multipliers.margin)
    assert np.abs(np.array(gradient).ravel() + bounds).max() < 1e-5
    assert float(value) == pytest.approx(plan.cost, rel=1e-9)
    assert np.array(constraint).min() >= -1e-6
    options = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.tol": 1e-9}
    solver = casadi.nlpsol("s", "ipopt", {"x": z, "f": cost, "g": g}, options)
    limits = np.full(2 * N, 3.0)
    end = solver(
        x0=np.append(plan.U.ravel(), plan.iterate.s),
        lbx=np.append(-limits, margin.lower),
        ubx=np.append(limits, margin.upper),
        lbg=0.0,
    )
    assert plan.cost <= float(end["f"]) * (1 + 1e-5)  # an interior point may leave for a worse one
