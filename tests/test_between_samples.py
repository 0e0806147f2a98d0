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
from scp_mpc.solver.sampling import LinearSampling
from scp_mpc.solver.step_data import StepData
from scp_mpc.solver.sweep import Sweep, swept

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


@pytest.mark.parametrize("settings", [Settings(), Settings(condense=False)])
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


def test_slow_robots_are_constrained_at_the_samples_alone():
    case = problem(N, nodes_per_interval=4)
    for speed, points in ((1.0, N), (4.0, 4 * N)):
        ref = straight_reference(N, speed)
        beside = [obstacle(N, (0.6 * speed * N * DT, 0.7))]
        plan = SCP(case).solve(ref[0], ref, beside)
        assert plan.status is Status.CONVERGED
        assert plan.iterate.touches
        assert plan.iterate.slack.shape == (1, points)
        assert plan.slack.shape == (1, N)


def test_a_controller_changes_between_both_as_the_speed_changes():
    mpc = MPC(problem(N, nodes_per_interval=4))
    for speed in (1.0, 4.0, 1.0):
        ref = straight_reference(N, speed)
        plan = mpc.step(ref[0], ref, [obstacle(N, (0.6 * speed * N * DT, 0.1))])
        assert plan.status is Status.CONVERGED
        assert mpc.nominal().slack.shape[1] in (N, 4 * N)


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
        sampling = LinearSampling(model, 5, count)
        e, u = rng.normal(size=(5, 6)), rng.normal(size=(5, 3))
        phi = rng.normal(size=(sampling.points, 3))
        on_e, on_u = sampling.pull(phi.ravel())
        worked = (on_e * e).sum() + (0 if on_u is None else (on_u * u).sum())
        assert worked == pytest.approx((phi * sampling.deviations(e, u)).sum())
        states = np.concatenate([np.zeros((1, 6)), e])
        np.testing.assert_allclose(sampling.positions(states, u), sampling.deviations(e, u))
        slow = [
            model.between(k / count)[0] @ states[i] + model.between(k / count)[1] @ u[i]
            if k < count
            else states[i + 1, ::2]
            for i in range(5)
            for k in range(1, count + 1)
        ]
        np.testing.assert_allclose(sampling.positions(states, u), slow, atol=1e-12)


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 10_000))
def test_interpolated_covariances_err_on_the_safe_side(seed):
    """For a straight way between two Gaussians of any correlation."""
    rng = np.random.default_rng(seed)
    G = rng.normal(size=(4, 4))
    joint = G @ G.T
    sampling = LinearSampling(DoubleIntegrator(DT), 1, 4)
    ours = sampling.interpolated(np.array([[joint[:2, :2], joint[2:, 2:]]]))[0]
    for k in range(5):
        mix = np.hstack([(1 - k / 4) * np.eye(2), k / 4 * np.eye(2)])
        assert np.linalg.eigvalsh(ours[k] - mix @ joint @ mix.T)[0] >= -1e-9


def test_radii_leave_room_for_the_way_between_two_points():
    """The chord of a circle: two points just clear of r', and what lies between."""
    N2, rng = 2, np.random.default_rng(0)
    case = problem(N2, nodes_per_interval=1)
    still = ObstaclePrediction(np.zeros((N2 + 1, 2)), np.zeros((2, 2)), 0.2)
    step = StepData.read(case, np.zeros(4), np.zeros(4), [still])
    for _ in range(200):
        path = rng.normal(size=(3, 2))
        sweep = Sweep.of(path)
        r = swept(step, sweep).radii[0]
        between = path[:-1, None] + np.linspace(0, 1, 101)[:, None] * np.diff(path, axis=0)[:, None]
        if (np.linalg.norm(path, axis=1) >= np.append(r, r[-1])).all():
            assert np.linalg.norm(between, axis=2).min() >= 0.35
    assert Sweep.of(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.8]])).sag == pytest.approx(0.1)
    np.testing.assert_allclose(swept(step, Sweep(0.0, 0.1)).radii, 0.45)
    np.testing.assert_allclose(swept(step, Sweep(0.6, 0.05)).radii, 0.5)


@pytest.mark.parametrize("K", [2, 4])
def test_a_plan_that_outruns_what_was_assumed_is_not_called_safe(monkeypatch, K):
    """Assume that nothing moves between two points: the plan's own way is checked all the same."""
    monkeypatch.setattr(Sweep, "of", lambda _: Sweep(0.0, 0.0))
    ref, case = straight_reference(N, 4.0), problem(N, robot_radius=0.1, nodes_per_interval=K)
    for x in (4.4, 4.3, 4.2):
        careless = SCP(case).solve(ref[0], ref, [thin(x)])
        if careless.ok and gap(careless, thin(x)) < 0.15:
            break
    else:
        pytest.fail("the assumption does not matter here")
    monkeypatch.undo()
    monkeypatch.setattr(Sweep, "and_more", lambda *_: Sweep(0.0, 0.0))
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
    U, s = casadi.MX.sym("U", 2, N), casadi.MX.sym("s")
    x, cost, g = casadi.DM(step.x0), case.size.weight * (s - case.size.reference) ** 2, []
    K = step.sampling.count
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


@pytest.mark.parametrize("condense", [True, False])
@pytest.mark.parametrize("s_min", [2.4, 0.5])
@pytest.mark.parametrize("seed", range(3))
def test_certificate_and_optimum_agree_with_ipopt(seed, s_min, condense):
    rng = np.random.default_rng(seed)
    margin = Margin(2.4, s_min)
    case = problem(N, "axes", margin=margin, nodes_per_interval=4)
    ref = straight_reference(N, 4.0)
    Sigma = rotated((0.25, 0.1), rng.uniform(0, np.pi))
    ahead = obstacle(N, (5.0, rng.uniform(-0.3, 0.3)), (0.5, rng.uniform(-0.1, 0.1)), Sigma)
    patient = Settings(condense=condense, max_iterations=200)
    x0 = ref[0] + [-0.2, 0.3, 0.15, -0.2]  # neither here nor along the reference at rest
    ref[:, 3] += 0.1
    plan = SCP(case, patient).solve(x0, ref, [ahead])
    assert plan.status is Status.CONVERGED
    step = plan.commitment.args[0]
    assert step.sampling.count == 4
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
