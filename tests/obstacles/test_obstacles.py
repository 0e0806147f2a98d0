"""The report's obstacle and the two predictors, against the report's numbers."""

import numpy as np
import pytest

from scp_mpc import CircularObstacle, ConstantVelocityPredictor, ReportPredictor

DT, N = 0.2, 30


@pytest.fixture
def start():
    obstacle = CircularObstacle()
    return obstacle.position(0.0), obstacle.velocity(0.0)


def test_obstacle_starts_as_in_the_report(start):
    np.testing.assert_allclose(start[0], [4.588, 6.553], atol=1e-3)
    np.testing.assert_allclose(start[1], [-0.786, 0.551], atol=1e-3)


def test_velocity_is_the_derivative_of_the_position():
    obstacle, h = CircularObstacle(), 1e-6
    for t in (0.0, 3.3, 40.0):
        slope = (obstacle.position(t + h) - obstacle.position(t - h)) / (2 * h)
        np.testing.assert_allclose(obstacle.velocity(t), slope, atol=1e-8)


def test_report_mean_follows_the_circle(start):
    """(11a) is a trapezoid: its error after 6 s is of order dt^2."""
    prediction = ReportPredictor().predict(*start, 0.2, N, DT)
    truth = np.array([CircularObstacle().position(DT * i) for i in range(N + 1)])
    assert np.abs(prediction.means - truth).max() < 1e-3
    np.testing.assert_array_equal(prediction.means[0], start[0])


def test_report_covariance_is_the_trapezoid_of_11b(start):
    prediction = ReportPredictor().predict(*start, 0.2, N, DT)
    Sigma = np.array([[0.5, 0.3], [0.3, 0.2]])
    previous = np.array([[0.3, 0.1], [0.1, 0.1]])
    np.testing.assert_array_equal(prediction.covariances[0], Sigma)
    for i in range(1, N + 1):
        velocity = (1 + 0.1 * i) * np.array([[0.08, 0.05], [0.05, 0.03]])
        Sigma = Sigma + DT**2 / 4 * (velocity + previous)
        previous = velocity
        np.testing.assert_allclose(prediction.covariances[i], Sigma, rtol=1e-12)
    assert prediction.covariances[N, 0, 0] == pytest.approx(0.62, abs=0.01)
    assert (np.linalg.eigvalsh(prediction.covariances) > 0).all()


def test_constant_velocity_error_grows_with_time(start):
    prediction = ConstantVelocityPredictor().predict(*start, 0.2, N, DT)
    assert prediction.covariances[N, 0, 0] == pytest.approx(0.5 + 36 * 0.3)
    np.testing.assert_allclose(prediction.means[N], start[0] + 6.0 * start[1])


def test_constant_velocity_covariance_is_that_of_samples(start):
    rng = np.random.default_rng(0)
    predictor = ConstantVelocityPredictor()
    p = rng.multivariate_normal(start[0], predictor.position_covariance, 200_000)
    v = rng.multivariate_normal(start[1], predictor.velocity_covariance, 200_000)
    prediction = predictor.predict(*start, 0.2, N, DT)
    for i in (1, 10, 30):
        sample = np.cov((p + i * DT * v).T)
        np.testing.assert_allclose(prediction.covariances[i], sample, rtol=0.03)


def test_constant_velocity_works_in_space():
    predictor = ConstantVelocityPredictor(0.1 * np.eye(3), 0.2 * np.eye(3))
    prediction = predictor.predict(np.zeros(3), np.ones(3), 0.3, 5, DT)
    assert prediction.dim == 3
    assert prediction.horizon == 5
