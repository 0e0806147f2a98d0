"""Disturbance rejection in closed loop."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from instances import instance, obstacle, problem, straight_reference

from scp_mpc import (
    MPC,
    BoundsError,
    ConcurrentUseError,
    DoubleIntegrator,
    InvalidArgumentError,
    LinearModel,
    NotFiniteError,
)
from scp_mpc.control import DisturbanceEstimator, Regulator, WindAwareMPC, disturbed
from scp_mpc.control.position_covariance import PositionCovariance
from scp_mpc.models import Disturbed
from scp_mpc.report import centre_distances
from scp_mpc.simulation import SCENARIOS, ConstantPush

VELOCITIES = [1, 3]


def aware(problem_, settings=None, alpha=0.85, affects=None, std=0.08, **options):
    robot = Disturbed(problem_.model, alpha, affects)
    options = {"prediction": "none", **options}
    return WindAwareMPC(problem_, DisturbanceEstimator(robot, std=std), settings, **options)


def settled_error(controller, push, steps=60):
    """Distance from a standing goal after a while of a constant acceleration [m]."""
    model = controller.problem.model
    x, goal = np.zeros(model.nx), np.zeros(model.nx)
    for _ in range(steps):
        x = model.step(x, controller.step(x, goal).u0 + push)
    return np.linalg.norm(x[model.position])


@pytest.mark.parametrize("dim", [2, 3])
def test_no_offset_is_left_by_a_constant_push(dim):
    push = np.array([0.5, -0.3, 0.4])[:dim]
    model = DoubleIntegrator(0.2, dim)
    cheap, dear = (
        problem(model=model, Q=[0.2, 0.05] * dim, R=[R] * dim, margin=None) for R in (1e-6, 1e-3)
    )
    nominal = settled_error(MPC(cheap), push)
    assert nominal > 0.05
    assert settled_error(aware(cheap, alpha=1.0), push) < 1e-6
    # Who expects the push to fade makes up for most of it.
    assert 1e-3 < settled_error(aware(cheap), push) < 0.2 * nominal
    # What an input costs is weighed against the offset that it would remove.
    assert 1e-4 < settled_error(aware(dear, alpha=1.0), push) < 1e-3


def test_the_disturbance_moves_the_plan_as_the_model_says():
    p = problem()
    mpc = aware(p, affects=VELOCITIES)
    x, u, w = np.array([0.0, 2, 0, 0]), None, np.array([0.3, -0.2])
    x_ref = straight_reference(8)
    for _ in range(2):
        plan = mpc.step(x, x_ref, applied=u)
        u = np.array([0.5, 0.5])
        x = p.model.step(x, u) + np.array([0, w[0], 0, w[1]])
    now = mpc.step(x, x_ref, applied=u)
    seen = mpc.estimate
    np.testing.assert_allclose(seen.disturbance, 0.85 * w, rtol=0.05)
    state, push = seen.state, seen.disturbance
    for i, u in enumerate(now.U):
        state = p.model.step(state, u) + np.array([0, push[0], 0, push[1]])
        push = 0.85 * push
        np.testing.assert_allclose(now.X[i + 1], state, atol=1e-9)
    assert now.X.shape == plan.X.shape == (9, 4)
    assert now.iterate.states.shape == (9, 6)


@pytest.mark.parametrize("kind", ["ahead", "crossing"])
def test_without_a_disturbance_nothing_changes(kind):
    case = instance(kind, 8, "exact", 2.0, 3)
    plain, other = MPC(case.problem), aware(case.problem)
    x = case.x0
    for _ in range(4):
        ours, theirs = (m.step(x, case.x_ref, case.obstacles) for m in (other, plain))
        np.testing.assert_allclose(ours.U, theirs.U, atol=1e-6)
        np.testing.assert_allclose(ours.X, theirs.X, atol=1e-6)
        assert ours.status == theirs.status
        assert ours.cost == pytest.approx(theirs.cost, rel=1e-8)
        x = case.problem.model.step(x, theirs.u0)


def test_wind_is_rejected_where_nothing_is_in_the_way():
    """Half of the usual error at most, with the short horizon; the same seed, the same bits."""
    alone = replace(SCENARIOS["scenario-4"].obstacle, track_radius=1e3)
    scenario = replace(SCENARIOS["scenario-4"], horizon=8, obstacle=alone)
    nominal, *runs = (
        scenario.run(controller, steps=120, seed=1)
        for controller in (None, *(aware(scenario.problem(), affects=VELOCITIES) for _ in range(2)))
    )
    np.testing.assert_array_equal(runs[0].states, runs[1].states)
    np.testing.assert_array_equal(runs[0].inputs, runs[1].inputs)
    assert np.median(runs[0].tracking_errors) < 0.5 * np.median(nominal.tracking_errors)
    assert runs[0].states.shape == nominal.states.shape


def test_scenario_2_is_as_before_with_rejection_on():
    scenario = SCENARIOS["scenario-2"]
    plain = scenario.run(steps=25)
    other = scenario.run(aware(scenario.problem(), affects=VELOCITIES), steps=25)
    np.testing.assert_allclose(other.states, plain.states, atol=1e-5)
    assert plain.tracking_errors.max() > 0.2


def test_a_constant_push_among_obstacles():
    scenario = replace(SCENARIOS["scenario-2"], disturbance=ConstantPush((0.4, 0.4)))
    nominal, other = (
        scenario.run(controller, steps=50)
        for controller in (None, aware(scenario.problem(), alpha=0.98))
    )
    assert np.median(other.tracking_errors) < 0.5 * np.median(nominal.tracking_errors)
    assert centre_distances(other).min() > 0.35


def spread_of(prediction, horizon=30, terminal_input_weight=1.0, measurement=None, std=0.08):
    p = problem(horizon)
    robot = Disturbed(p.model, 0.85, VELOCITIES)
    known = DisturbanceEstimator(robot, std=std, measurement_std=0.02, measurement=measurement)
    return PositionCovariance(p, known, prediction, terminal_input_weight), known, p


@pytest.mark.parametrize("measurement", [None, [[1, 0, 0, 0], [0, 0, 1, 0]]])
def test_closed_loop_spread_is_that_of_a_simulation(measurement):
    """The filter and the feedback, run 6,000 times; 20 % is five standard errors and more."""
    spread, known, p = spread_of("closed loop", 10, 100.0, measurement)
    S, robot, H = known.settled(), known.model, known.measurement
    predicted = spread.along(S)
    K = Regulator(p, robot, 100.0).feedback
    rng, n = np.random.default_rng(0), 6000
    z = rng.multivariate_normal(np.zeros(6), S, n)
    guess = np.zeros((n, 6))
    for i in range(1, 11):
        u = -guess @ K.T
        z = z @ robot.A.T + u @ robot.B.T
        z = z + rng.multivariate_normal(np.zeros(6), known.process_noise, n)
        guess = guess @ robot.A.T + u @ robot.B.T
        noise = rng.multivariate_normal(np.zeros(len(H)), known.measurement_noise, n)
        before = known.ahead(S)
        gain = np.linalg.solve(H @ before @ H.T + known.measurement_noise, H @ before).T
        guess = guess + (z @ H.T + noise - guess @ H.T) @ gain.T
        S = known.behind(before)
        sampled = np.cov(z[:, [0, 2]].T)
        np.testing.assert_allclose(
            np.diag(sampled), np.diag(predicted[i]), rtol=0.12, err_msg=f"{i}"
        )


def test_feedback_keeps_the_spread_small():
    open_, known, _ = spread_of("open loop")
    S = known.settled()
    wide, narrow = open_.along(S), spread_of("closed loop")[0].along(S)
    assert wide.shape == narrow.shape == (31, 2, 2)
    np.testing.assert_array_equal(wide[0], narrow[0])
    assert np.sqrt(wide[30, 0, 0]) > 5.0  # metres: nothing could be planned
    assert np.sqrt(narrow[30, 0, 0]) < 0.05
    assert spread_of("none")[0].along(S) is None
    assert (np.diff(wide[:, 0, 0]) > 0).all()
    # The feedback of a thriftier regulator holds less tightly.
    assert (
        spread_of("closed loop", terminal_input_weight=100.0)[0].along(S)[30, 0, 0]
        > narrow[30, 0, 0]
    )
    assert spread_of("closed loop")[0].along(2 * S)[0, 0, 0] == pytest.approx(2 * S[0, 0])


def test_spread_reaches_the_obstacles():
    """With more doubt about itself the robot keeps a larger distance; what is given is added."""
    p = problem(8)
    things = [obstacle(8, (1.6, 0.05))]
    x, x_ref = np.array([0.0, 2, 0, 0]), straight_reference(8)
    costs = [
        aware(p, prediction=prediction).step(x, x_ref, things, robot_covariance=given).cost
        for prediction, given in (
            ("none", None),
            ("closed loop", None),
            ("open loop", None),
            ("none", 0.02 * np.eye(2)),
            ("open loop", 0.02 * np.eye(2)),
        )
    ]
    assert costs[0] < costs[1] < costs[2] < costs[4]
    assert costs[0] < costs[3] < costs[4]


@pytest.mark.parametrize("alpha", [0.85, 1.0])
def test_regulator_is_the_long_horizons_plan(alpha):
    """First input and difference in cost of 300 intervals without bounds and obstacles."""
    p = problem(300, u_min=-1e3, u_max=1e3, R=[0.02, 0.02])
    robot = Disturbed(p.model, alpha, VELOCITIES)
    regulator = Regulator(p, robot)
    x, w = np.array([1.0, -0.5, 0.3, 0.2]), np.array([0.05, -0.02])
    z = np.r_[x, w]
    whole = disturbed(p, robot)
    plan = MPC(whole).step(z, np.zeros(6))
    np.testing.assert_allclose(plan.u0, -regulator.feedback @ z, rtol=1e-6)
    short = MPC(disturbed(problem(4, R=[0.02, 0.02], u_min=-1e3, u_max=1e3), robot)).problem
    ended = MPC(replace(short, Qf=regulator.terminal_weight())).step(z, np.zeros(6))
    # The last stage's own cost is in both Q and the cost-to-go.
    np.testing.assert_allclose(ended.u0, plan.u0, rtol=1e-6)
    assert not np.allclose(MPC(short).step(z, np.zeros(6)).u0, plan.u0, rtol=1e-3)


def test_thrift_is_the_terminal_weight_and_nothing_else():
    p = problem()
    mpc = aware(p, terminal_input_weight=100.0)
    inner = mpc.mpc.problem
    weight = Regulator(p, inner.model, 100.0).terminal_weight()
    np.testing.assert_array_equal(inner.Qf, weight)
    np.testing.assert_array_equal(inner.Q[:4, :4], p.Q)
    assert not inner.Q[4:].any()
    assert mpc.problem is p
    np.testing.assert_array_equal(aware(p).mpc.problem.Qf[:4, :4], p.Qf)


def test_errors_leave_no_trace():
    p = problem()
    mpc, twin = aware(p), aware(p)
    x, x_ref = np.array([0.0, 2, 0, 0]), straight_reference(8)
    for each in (mpc, twin):
        each.step(x, x_ref)
    things = [obstacle(9, (9.0, 9.0))]  # one row too many
    for bad in (
        {"y": x * np.nan},
        {"x_ref": x_ref[:3]},
        {"obstacles": things},
        {"applied": [1.0]},
        {"robot_covariance": -np.eye(2)},
        {"time": np.nan},
    ):
        with pytest.raises(InvalidArgumentError):
            mpc.step(**{"y": x + 0.1, "x_ref": x_ref, **bad})
        assert mpc.estimate.innovation.tobytes() == twin.estimate.innovation.tobytes()
    y = x + [0.1, 0.2, 0.0, 0.1]
    np.testing.assert_array_equal(mpc.step(y, x_ref).U, twin.step(y, x_ref).U)
    mpc.reset()
    assert mpc.estimate is None
    np.testing.assert_array_equal(mpc.step(y, x_ref).U, aware(p).step(y, x_ref).U)


def test_a_second_thread_is_refused_before_anything_changes(monkeypatch):
    """It comes while the first waits inside its step, after the estimator's update."""
    update, measured = DisturbanceEstimator.update, []

    def watched_update(self, y, u=None):
        measured.append(y[0])
        return update(self, y, u)

    p = problem()
    mpc, twin = (
        aware(p, prediction="closed loop"),
        aware(p, prediction="closed loop"),
    )
    x, x_ref = np.array([0.0, 2, 0, 0]), straight_reference(8)
    for each in (mpc, twin):
        each.step(x, x_ref)

    monkeypatch.setattr(DisturbanceEstimator, "update", watched_update)

    def waiting(pool):
        before = mpc.estimate
        for use in (lambda: mpc.step(x + 0.3, x_ref), mpc.reset):
            with pytest.raises(ConcurrentUseError):
                pool.submit(use).result()
        assert mpc.estimate is before
        assert measured == [x[0] + 0.1]
        yield obstacle(8, (1.5, 0.1))

    with ThreadPoolExecutor(1) as pool:
        watched = mpc.step(x + 0.1, x_ref, waiting(pool))
    expected = twin.step(x + 0.1, x_ref, [obstacle(8, (1.5, 0.1))])
    np.testing.assert_array_equal(watched.U, expected.U)
    np.testing.assert_array_equal(mpc.step(x, x_ref).U, twin.step(x, x_ref).U)


def test_an_interrupted_step_leaves_no_trace():
    p = problem()
    mpc, twin = aware(p), aware(p)
    x, x_ref = np.array([0.0, 2, 0, 0]), straight_reference(8)
    for each in (mpc, twin):
        each.step(x, x_ref)

    def interrupted():
        raise KeyboardInterrupt
        yield

    with pytest.raises(KeyboardInterrupt):
        mpc.step(x + 0.3, x_ref, interrupted())
    np.testing.assert_array_equal(mpc.step(x, x_ref).U, twin.step(x, x_ref).U)


def test_misuse_is_refused():
    p = problem()
    with pytest.raises(InvalidArgumentError, match="estimator"):
        WindAwareMPC(p, None)
    with pytest.raises(InvalidArgumentError, match="prediction"):
        aware(p, prediction="clairvoyant")
    with pytest.raises(BoundsError, match="terminal_input_weight"):
        aware(p, terminal_input_weight=0.0)
    with pytest.raises(NotFiniteError):
        aware(p, std=np.nan)
    stranger = Disturbed(DoubleIntegrator(0.1))
    with pytest.raises(InvalidArgumentError, match="robot"):
        WindAwareMPC(p, DisturbanceEstimator(stranger, std=0.1))
    runaway = LinearModel(2 * np.eye(4), np.eye(4)[:, :2], 0.2, np.array([0, 2]))
    with pytest.raises(InvalidArgumentError, match="regulator"):
        Regulator(replace(p, model=runaway), Disturbed(runaway))
