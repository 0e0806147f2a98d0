"""The Kalman filter behind disturbance rejection, against what theory says of it."""

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are
from scipy.stats import chi2

from scp_mpc import (
    BoundsError,
    DoubleIntegrator,
    InvalidArgumentError,
    NotFiniteError,
    ShapeError,
)
from scp_mpc.control import DisturbanceEstimator
from scp_mpc.models import Disturbed

POSITION = [[1, 0, 0, 0], [0, 0, 1, 0]]


def model(alpha=0.85, dim=2):
    return Disturbed(DoubleIntegrator(0.2, dim), alpha, affects=range_of(dim))


def range_of(dim):
    return list(range(1, 2 * dim, 2))


def estimator(position_only=False, **changes):
    values = {"std": 0.08, "process_std": 0.01, "measurement_std": 0.02}
    if position_only:
        values["measurement"] = POSITION
    return DisturbanceEstimator(model(), **{**values, **changes})


def test_augmented_model_is_robot_and_disturbance_side_by_side():
    robot, rng = DoubleIntegrator(0.1, dim=3), np.random.default_rng(0)
    x, u, w = rng.standard_normal(6), rng.standard_normal(3), rng.standard_normal(3)
    for affects, E in ((None, robot.B), ([1, 3, 5], np.eye(6)[:, [1, 3, 5]])):
        both = Disturbed(robot, 0.7, affects)
        z = both.step(both.joined(x, w), u)
        np.testing.assert_allclose(z[:6], robot.step(x, u) + E @ w, atol=1e-14)
        np.testing.assert_allclose(z[6:], 0.7 * w)
        assert (both.nx, both.nu, both.nw, both.dim) == (9, 3, 3, 3)
    rows = Disturbed(robot, 0.7).joined(np.stack([x, -x]), w)
    np.testing.assert_array_equal(rows, [[*x, *w], [*(-x), *w]])


@pytest.mark.parametrize("alpha", [0.0, 0.85, 1.0])
def test_between_the_samples_the_disturbance_is_held(alpha):
    robot = DoubleIntegrator(0.2)
    both = Disturbed(robot, alpha)
    C, D = both.between(0.5)
    x, u, w = np.array([1.0, 2, 3, 4]), np.array([0.5, -1]), np.array([2.0, 1])
    expected = DoubleIntegrator(0.1).step(x, u + w)[[0, 2]]  # E = B: w is an input
    np.testing.assert_allclose(C @ np.r_[x, w] + D @ u, expected, atol=1e-12)
    np.testing.assert_allclose(both.between(1.0)[0], both.A[both.position], atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"alpha": 1.1}, BoundsError),
        ({"alpha": -0.1}, BoundsError),
        ({"alpha": np.nan}, NotFiniteError),
        ({"affects": [4]}, InvalidArgumentError),
        ({"affects": [1, 1]}, InvalidArgumentError),
        ({"affects": np.zeros((4, 2))}, ShapeError),
        ({"affects": np.ones((3, 2))}, ShapeError),
    ],
)
def test_disturbed_refuses(changes, error):
    with pytest.raises(error):
        Disturbed(DoubleIntegrator(0.2), **changes)
    with pytest.raises(InvalidArgumentError):
        Disturbed(Disturbed(DoubleIntegrator(0.2)))


def test_an_exact_measurement_shows_last_steps_push():
    """What is left of it is alpha times what the state jumped by."""
    filter_ = DisturbanceEstimator(
        model(), std=0.08, process_std=1e-5, measurement_std=0.0, initial_std=1e-3
    )
    robot, u = filter_.model.nominal, np.array([1.0, -2.0])
    x = np.array([1.0, 0.5, -2.0, 0.3])
    first = filter_.update(x)
    np.testing.assert_allclose(first.state, x, atol=1e-5)
    assert not first.disturbance.any()
    second = filter_.update(robot.step(x, u) + [0, 0.3, 0, -0.1], u)
    np.testing.assert_allclose(second.disturbance, [0.85 * 0.3, -0.85 * 0.1], rtol=1e-3)


@pytest.mark.parametrize("position_only", [False, True])
def test_errors_and_innovations_are_chi_square(position_only):
    """NEES and NIS, each within the 99.8 % interval of their mean over independent runs."""
    runs, steps = 100, 10
    nees, nis = np.zeros((2, runs, steps))
    for run in range(runs):
        filter_, rng = estimator(position_only), np.random.default_rng([7, run])
        H = filter_.measurement
        drift = np.sqrt(np.diag(filter_.process_noise))
        error = np.sqrt(np.diag(filter_.measurement_noise))
        now = filter_.update(rng.standard_normal(len(H)))
        # A truth that is as uncertain as the filter says.
        z = np.r_[now.state, now.disturbance]
        z = z + np.linalg.cholesky(now.covariance) @ rng.standard_normal(6)
        for k in range(steps):
            u = rng.uniform(-3, 3, 2)
            z = filter_.model.step(z, u) + drift * rng.standard_normal(6)
            now = filter_.update(H @ z + error * rng.standard_normal(len(H)), u)
            away = z - np.r_[now.state, now.disturbance]
            nees[run, k] = away @ np.linalg.solve(now.covariance, away)
            nis[run, k] = now.surprise
    for values, freedom in ((nees, 6), (nis, len(H))):
        low, high = chi2.ppf([0.001, 0.999], freedom * runs) / runs
        inside = (low < values.mean(axis=0)) & (values.mean(axis=0) < high)
        assert inside.all(), values.mean(axis=0)


@pytest.mark.parametrize("position_only", [False, True])
def test_covariance_converges_to_riccatis(position_only):
    filter_ = estimator(position_only)
    F, H = filter_.model.A, filter_.measurement
    for _ in range(200):
        now = filter_.update(np.zeros(len(H)), np.zeros(2))
    np.testing.assert_allclose(now.covariance, filter_.settled(), rtol=1e-6, atol=1e-12)
    ahead = solve_discrete_are(F.T, H.T, filter_.process_noise, filter_.measurement_noise)
    np.testing.assert_allclose(filter_.ahead(now.covariance), ahead, rtol=1e-6, atol=1e-12)
    assert np.linalg.eigvalsh(now.covariance)[0] > 0
    np.testing.assert_array_equal(now.covariance, now.covariance.T)


def test_what_cannot_be_seen_has_no_steady_state():
    """Positions are not seen in velocities: their doubt grows for ever."""
    blind = estimator(measurement=[[0, 1, 0, 0], [0, 0, 0, 1]])
    with pytest.raises(InvalidArgumentError, match="measurement"):
        blind.settled()


def test_misuse_is_refused_and_leaves_no_trace():
    filter_, other = estimator(), estimator()
    y, u = np.ones(4), np.ones(2)
    for each in (filter_, other):
        each.update(y)
    for bad_y, bad_u, error in (
        (y * np.nan, u, NotFiniteError),
        (y, u * np.inf, NotFiniteError),
        (np.ones(3), u, ShapeError),
        (y, np.ones(3), ShapeError),
        (y, None, InvalidArgumentError),
    ):
        with pytest.raises(error):
            filter_.update(bad_y, bad_u)
    for name in ("state", "disturbance", "covariance"):
        ours, theirs = (getattr(each.update(y, u), name) for each in (filter_, other))
        np.testing.assert_array_equal(ours, theirs)
        filter_.restore(other.estimate)
    filter_.reset()
    assert filter_.estimate is None


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"std": -0.1}, BoundsError),
        ({"std": [0.1, 0.1, 0.1]}, ShapeError),
        ({"process_std": np.nan}, NotFiniteError),
        ({"measurement": np.ones((2, 3))}, ShapeError),
        ({"measurement": np.zeros((0, 4))}, InvalidArgumentError),
        ({"measurement_std": -1.0}, BoundsError),
    ],
)
def test_estimator_refuses(changes, error):
    with pytest.raises(error):
        estimator(**changes)
    with pytest.raises(InvalidArgumentError, match="model"):
        DisturbanceEstimator(DoubleIntegrator(0.2), std=0.1)
