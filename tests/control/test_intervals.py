"""Time steps that differ: predictions, trackers and references carry theirs, and are refused."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scp_mpc import (
    MPC,
    SCP,
    BoundsError,
    CircularReference,
    ConstantVelocityPredictor,
    DisturbanceEstimator,
    Disturbed,
    DoubleIntegrator,
    InvalidArgumentError,
    ObstaclePrediction,
    Path,
    PathReference,
    Preview,
    Problem,
    ReportPredictor,
    Settings,
    ShapeError,
    Tracker,
    Unicycle,
    WindAwareMPC,
)
from scp_mpc.simulation import Body

N = 8
STEPS = (0.01, 0.05, 0.2, 1.0)
GOAL = np.array([9.0, 0.0, 0.0, 0.0])


def problem(dt, **changes):
    values = {
        "horizon": N, "Q": [1, 0.1, 1, 0.1], "R": [0.1, 0.1], "u_min": -3, "u_max": 3,
        "robot_radius": 0.3, "max_obstacles": 2, "nodes_per_interval": 1, **changes,
    }  # fmt: skip
    return Problem(DoubleIntegrator(dt), **values)


def tracked(dt):
    tracker = Tracker(dt, N, radius=0.3, measurement_std=0.05)
    for k in range(5):
        tracker.update(0.1 * k, [[4.0, 0.05 * k]], ["ann"])
    return tracker.predictions()[0]


def predicted(dt, predictor):
    return predictor.predict(np.array([4.0, 1.0]), np.array([-1.0, 0.0]), 0.3, N, dt)


MAKERS = {
    "tracker": tracked,
    "constant velocity": lambda dt: predicted(dt, ConstantVelocityPredictor()),
    "report": lambda dt: predicted(dt, ReportPredictor()),
    "body": lambda dt: Body([4.0, 1.0], 0.3).predicted(0.0, dt, N),
    "by hand": lambda dt: ObstaclePrediction(np.ones((N + 1, 2)), np.eye(2), 0.3, dt=dt),
    "moved on": lambda dt: replace(tracked(dt), stamp=None, name="b"),
}
REFERENCES = {
    "path": lambda dt: PathReference(
        Path.polyline([[0, 0], [9, 0]]), speed=1.0, model=DoubleIntegrator(dt), horizon=N
    ).states(np.zeros(4)),
    "circle": lambda dt: CircularReference().states(0.0, N, dt),
    "circle, moved": lambda dt: CircularReference().states(0.0, N, dt) + [1.0, 0, 0, 0],
}


@pytest.mark.parametrize("dt", STEPS)
@pytest.mark.parametrize("kind", MAKERS)
def test_predictions_of_another_interval_are_refused_with_both_numbers(kind, dt):
    told = MAKERS[kind](dt)
    assert told.dt == dt
    mpc, scp = MPC(problem(dt), Settings(deadline=None)), SCP(problem(2 * dt))
    assert mpc.step(np.zeros(4), GOAL, [told], time=0.4).step.count == 1
    other = MPC(problem(2 * dt), Settings(deadline=None))
    for solve in (lambda *a: other.step(*a, time=0.4), scp.solve):
        with pytest.raises(InvalidArgumentError, match=rf"{dt:g} s apart.* {2 * dt:g} s") as error:
            solve(np.zeros(4), GOAL, [told])
        assert error.value.argument == "obstacles[0].dt"
    again = told.resampled(2 * dt, N)
    assert again.dt == 2 * dt
    assert other.step(np.zeros(4), GOAL, [again], time=0.4).step.count == 1


@pytest.mark.parametrize("dt", STEPS)
@pytest.mark.parametrize("kind", REFERENCES)
def test_references_of_another_interval_are_refused_with_both_numbers(kind, dt):
    x_ref = REFERENCES[kind](dt)
    MPC(problem(dt)).step(x_ref[0], x_ref)
    plain = problem(2 * dt)
    wind = WindAwareMPC(
        plain, DisturbanceEstimator(Disturbed(plain.model, alpha=0.8, affects=[1, 3]), std=0.1)
    )
    for refuse in (MPC(plain).step, SCP(plain).solve, wind.step):
        with pytest.raises(InvalidArgumentError, match=rf"x_ref.*{dt:g} s apart.* {2 * dt:g} s"):
            refuse(x_ref[0], x_ref)


def test_a_long_reference_of_another_interval_is_refused():
    preview = Preview(problem(0.2, Qf="lqr"), rows=5)
    preview.fold(CircularReference().states(0.0, N + 5, 0.2))
    with pytest.raises(InvalidArgumentError, match=r"0\.1 s apart"):
        preview.fold(CircularReference().states(0.0, N + 5, 0.1))


def test_what_does_not_know_its_interval_is_believed():
    means = np.tile([4.0, 1.0], (N + 1, 1))
    told, x_ref = (
        ObstaclePrediction(means, np.eye(2), 0.3),
        CircularReference().states(0, 2 * N, 0.1),
    )
    assert told.dt is None
    assert x_ref[::2].dt is None  # every other row: at 0.2 s now
    plan = MPC(problem(0.2)).step(np.zeros(4), x_ref[::2], [told])
    assert plan.X.shape == (N + 1, 4)
    assert type(plan.step.x_ref) is np.ndarray


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.01, 1.0), st.floats(0.01, 1.0), st.integers(1, 20))
def test_resampling_is_a_loop_over_rows(seed, dt, other, horizon):
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(N + 1, 2, 2))
    told = ObstaclePrediction(
        rng.normal(size=(N + 1, 2)), roots @ np.swapaxes(roots, 1, 2), 0.3, 5.0, "ann", dt=dt
    )
    again = told.resampled(other, horizon)
    kept = (again.stamp, again.name, again.radius, again.dt, again.horizon)
    assert kept == (5.0, "ann", 0.3, other, horizon)
    values, vectors = np.linalg.eigh(told.covariances[N] - told.covariances[N - 1])
    growth = vectors @ np.diag(np.maximum(values, 0)) @ vectors.T
    for i in range(horizon + 1):
        row = i * other / dt
        if row < N:
            k = int(row)
            mean = told.means[k] + (row - k) * (told.means[k + 1] - told.means[k])
            Sigma = (1 - row + k) * told.covariances[k] + (row - k) * told.covariances[k + 1]
        else:
            mean = told.means[N] + (row - N) * (told.means[N] - told.means[N - 1])
            Sigma = told.covariances[N] + (row - N) * growth
        np.testing.assert_allclose(again.means[i], mean, atol=1e-9)
        np.testing.assert_allclose(again.covariances[i], Sigma, atol=1e-9)
    ObstaclePrediction(again.means, again.covariances, 0.3)  # could have been made from scratch


def test_misuse_of_intervals():
    told = tracked(0.1)
    with pytest.raises(InvalidArgumentError, match="dt: not known"):
        replace(told, dt=None).resampled(0.2, N)
    for dt in (0.0, -0.1):
        with pytest.raises(BoundsError, match="dt"):
            told.resampled(dt, N)
        with pytest.raises(BoundsError, match="dt"):
            replace(told, dt=dt)
    with pytest.raises(ShapeError, match=r"obstacles\[0\]\.means"):
        MPC(problem(0.2)).step(np.zeros(4), GOAL, [told.resampled(0.2, N + 1)], time=0.4)


@pytest.mark.parametrize("turns", [-3, 0, 2])
@pytest.mark.parametrize("start", [3.1, -3.1, 0.0])
def test_own_headings_are_unwrapped_from_the_states(start, turns):
    """A gentle turn across pi, as arctan2 gives it: the plan is that of the unwrapped headings."""
    model = Unicycle(0.1)
    task = Problem(model, horizon=20, Q=[1, 1, 1, 0.1], R=[0.05, 0.05], u_min=-3, u_max=3)
    angle = start + 0.06 * np.arange(21)
    way = np.cumsum(0.1 * np.stack([np.cos(angle), np.sin(angle)], axis=1), axis=0)
    smooth = np.column_stack([way, angle, np.ones(21)])
    wrapped = smooth.copy()
    wrapped[:, 2] = np.arctan2(np.sin(angle), np.cos(angle))
    given = wrapped.copy()
    x0 = np.array([0.0, 0.0, start + 2 * np.pi * turns, 1.0])
    plan = MPC(task, Settings(deadline=None)).step(x0, given)
    wanted = MPC(task, Settings(deadline=None)).step([0.0, 0.0, start, 1.0], smooth)
    assert np.array_equal(given, wrapped)
    np.testing.assert_allclose(plan.U, wanted.U, atol=1e-5)
    assert abs(plan.X[-1, 2] - x0[2] - 1.2) < 0.2
    np.testing.assert_allclose(plan.step.x_ref[:, 2], angle + 2 * np.pi * turns, atol=1e-9)


def test_a_goal_one_turn_away_is_here():
    task = Problem(Unicycle(0.1), horizon=20, Q=[1, 1, 1, 0.1], R=[0.05, 0.05], u_min=-3, u_max=3)
    for goal in (2 * np.pi, -4 * np.pi):
        plan = SCP(task).solve(np.zeros(4), [0.0, 0.0, goal, 0.0])
        assert np.abs(plan.U).max() < 1e-6


@pytest.mark.parametrize("seed", range(2))
def test_a_measured_heading_that_jumps_by_a_turn_changes_nothing(seed):
    """The compass says +pi, then -pi: the plans are those of a heading that counts on."""
    rng = np.random.default_rng(seed)
    task = Problem(
        Unicycle(0.1), horizon=15, Q=[1, 1, 0.5, 0.1], R=[0.05, 0.05], u_min=-3, u_max=3,
        robot_radius=0.3,
    )  # fmt: skip
    post = ObstaclePrediction.static(15, [-1.5, 0.05], 0.2)
    smooth, compass = (MPC(task, Settings(deadline=None)) for _ in range(2))
    x, goal = np.array([0.0, 0.0, rng.uniform(2.9, 3.1), 0.5]), np.array([-3.0, 0.0, np.pi, 0.0])
    for k in range(10):
        y = x.copy()
        y[2] += 2 * np.pi * (k % 3 - 1)
        one, other = smooth.step(x, goal, [post]), compass.step(y, goal, [post])
        np.testing.assert_allclose(other.U, one.U, atol=0.01)
        x = task.model.step(x, one.u0)
