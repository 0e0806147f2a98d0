"""Sampled obstacle paths have the predicted marginals; swept contact against dense sampling."""

import numpy as np
import pytest
from instances import obstacle, rotated
from scipy.stats import chi2

from scp_mpc import (
    BoundsError,
    ConstantVelocityPredictor,
    CovarianceError,
    DoubleIntegrator,
    InvalidArgumentError,
    ObstaclePrediction,
    ReportPredictor,
    ShapeError,
)
from scp_mpc.simulation import (
    COUPLINGS,
    applicable_couplings,
    contacts,
    robot_path,
    sample_paths,
)
from scp_mpc.trajectory import rollout

N, COUNT = 6, 40_000
SPREAD = 5.0  # standard errors


def growing():
    """Constant unknown velocity: every coupling applies."""
    given = ConstantVelocityPredictor(rotated((0.5, 0.1), 0.7), rotated((0.3, 0.05), -0.4))
    return given.predict(np.array([1.0, 2.0]), np.array([-1.0, 0.5]), 0.2, N, 0.2)


def whitened(paths, prediction):
    """Deviations from the mean at each stage, (n, N+1, d), standard normal if all is right."""
    L = np.linalg.cholesky(prediction.covariances)
    return np.linalg.solve(L, (paths - prediction.means)[..., None])[..., 0]


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_marginals_are_those_of_the_prediction(coupling):
    prediction = growing()
    paths = sample_paths(prediction, COUNT, np.random.default_rng(1), coupling)
    assert paths.shape == (COUNT, N + 1, 2)
    z = whitened(paths, prediction)
    squares = (z**2).sum(axis=-1)
    for i in range(N + 1):
        # Sum of squares and of means: chi-square; entries of the Wishart matrix: standard errors.
        assert chi2.sf(squares[:, i].sum(), 2 * COUNT) > 1e-6
        assert chi2.cdf(squares[:, i].sum(), 2 * COUNT) > 1e-6
        assert chi2.sf(COUNT * (z[:, i].mean(axis=0) ** 2).sum(), 2) > 1e-6
        error = z[:, i].T @ z[:, i] / COUNT - np.eye(2)
        assert (np.abs(error) < SPREAD * np.sqrt((1 + np.eye(2)) / COUNT)).all()
        assert abs((squares[:, i] > chi2.isf(0.05, 2)).mean() - 0.05) < SPREAD * 0.22 / COUNT**0.5


def test_couplings_differ_in_how_stages_hang_together():
    prediction = growing()
    last = {}
    for coupling in COUPLINGS:
        paths = sample_paths(prediction, COUNT, np.random.default_rng(2), coupling)
        z = paths - prediction.means
        last[coupling] = z[:, 0].T @ z[:, N] / COUNT
    S = [rotated((0.5, 0.1), 0.7), prediction.covariances[N]]
    roots = [np.linalg.cholesky(s) for s in S]
    for coupling in ("velocity", "walk"):  # the later error is independent of the first
        np.testing.assert_allclose(last[coupling], S[0], atol=SPREAD * 0.4 / COUNT**0.5)
    # One z for all stages: no other coupling has a larger correlation in the trace norm.
    nuclear = np.linalg.svd(roots[0].T @ roots[1], compute_uv=False).sum()
    assert np.trace(last["offset"]) <= nuclear + 0.01
    assert np.trace(last["offset"]) > np.trace(last["walk"]) + 0.02


def test_velocity_paths_are_straight_and_walks_are_not():
    prediction = growing()
    straight = sample_paths(prediction, 50, np.random.default_rng(3), "velocity")
    assert np.abs(np.diff(straight, 2, axis=1)).max() < 1e-12
    walk = sample_paths(prediction, 50, np.random.default_rng(3), "walk")
    assert np.abs(np.diff(walk, 2, axis=1)).max() > 1e-2


def test_the_same_generator_gives_the_same_paths_and_singular_covariances_are_fine():
    flat = obstacle(N, (1.0, 0.0), covariance=np.diag([0.04, 0.0]))
    for coupling in ("offset", "walk"):
        first, second = (
            sample_paths(flat, 10, np.random.default_rng(4), coupling) for _ in range(2)
        )
        np.testing.assert_array_equal(first, second)
        assert np.abs(first[..., 1]).max() < 1e-12
        assert np.abs(first[:, 0, 0] - 1.0).max() > 0.05


def test_a_coupling_that_does_not_apply_is_refused():
    linear = obstacle(N, (1.0, 0.0))  # grows with time, not with its square
    rng = np.random.default_rng(0)
    with pytest.raises(CovarianceError, match="no constant velocity"):
        sample_paths(linear, 5, rng, "velocity")
    assert applicable_couplings(linear) == ("offset", "walk")
    shrinking = obstacle(N, (1.0, 0.0), growth=-0.05)
    for coupling, word in (("velocity", "no constant velocity"), ("walk", "increment")):
        with pytest.raises(CovarianceError, match=word):
            sample_paths(shrinking, 5, rng, coupling)
    slower = ObstaclePrediction(
        np.zeros((N + 1, 2)), [(1 - 0.01 * i**2) * np.eye(2) for i in range(N + 1)], 0.2
    )
    with pytest.raises(CovarianceError, match=r"eigenvalue -0\.01"):
        sample_paths(slower, 5, rng, "velocity")
    assert applicable_couplings(slower) == ("offset",)
    assert applicable_couplings(obstacle(N, (1.0, 0.0), growth=0.0)) == ("offset",)
    assert applicable_couplings(growing()) == COUPLINGS
    with pytest.raises(InvalidArgumentError, match="'bridge' is none of"):
        sample_paths(linear, 5, rng, "bridge")
    with pytest.raises(BoundsError, match="count: 0"):
        sample_paths(linear, 0, rng)


def test_the_report_s_prediction_shrinks_across_its_long_axis():
    """As printed its velocity covariance is indefinite, so that no walk has these marginals."""
    report = ReportPredictor().predict(np.zeros(2), np.ones(2), 0.2, 30, 0.2)
    assert applicable_couplings(report) == ("offset",)


def dense(model, x0, inputs, paths, radius, steps=4000):
    """Contact by looking at very many times of each interval."""
    X = rollout(model.step, x0, inputs).states
    touched = np.zeros((len(paths), len(inputs)), dtype=bool)
    for i, u in enumerate(inputs):
        position = X[i].reshape(-1, 2)[:, 0]
        velocity = X[i].reshape(-1, 2)[:, 1]
        for f in np.linspace(0.0, 1.0, steps):
            t = f * model.dt
            robot = position + t * velocity + t**2 / 2 * u
            there = paths[:, i] + f * (paths[:, i + 1] - paths[:, i])
            touched[:, i] |= np.linalg.norm(robot - there, axis=1) <= radius
    return touched


@pytest.mark.parametrize("dim", [2, 3])
def test_contact_is_that_of_a_dense_loop(dim):
    rng = np.random.default_rng(dim)
    model = DoubleIntegrator(0.2, dim)
    x0 = model.state(np.zeros(dim), rng.uniform(-3, 3, dim))
    inputs = rng.uniform(-30, 30, (5, dim))
    X = rollout(model.step, x0, inputs).states
    near = X[:, model.position] + rng.normal(0, 0.6, (300, 6, dim))
    path = robot_path(model, X, inputs)
    for radius in (0.0, 0.15, 0.4):
        found = contacts(path, near, radius)
        slow = dense(model, x0, inputs, near, radius)
        assert (found != slow).mean() < 2e-3  # grazing ones
        assert radius == 0 or 0.02 < found.mean() < 0.9


def test_what_passes_between_two_samples_is_seen():
    model = DoubleIntegrator(0.2)
    X = rollout(model.step, np.zeros(4), np.zeros((2, 2))).states
    path = robot_path(model, X, np.zeros((2, 2)))
    through = np.array([[[-1.0, 0.1], [1.0, 0.1], [3.0, 0.1]]])
    np.testing.assert_array_equal(contacts(path, through, 0.11), [[True, False]])
    np.testing.assert_array_equal(contacts(path, through, 0.09), [[False, False]])
    resting = np.array([[[0.1, 0.0]] * 3])
    np.testing.assert_array_equal(contacts(path, resting, 0.1), [[True, True]])


def test_the_curve_counts_not_its_chord():
    model = DoubleIntegrator(1.0)
    x0, u = np.array([0.0, 1.0, 0.0, 2.0]), np.array([[0.0, -4.0]])  # up to y = 0.5 and back
    X = rollout(model.step, x0, u).states
    path = robot_path(model, X, u)
    assert path[0, 16, 1] == pytest.approx(0.5)
    above = np.array([[[0.5, 0.6], [0.5, 0.6]]])
    assert contacts(path, above, 0.11).all()
    assert not contacts(path, above, 0.09).any()
    assert not contacts(path[:, [0, -1]], above, 0.11).any()


def test_chunks_do_not_matter():
    model = DoubleIntegrator(0.2)
    inputs = np.ones((4, 2))
    X = rollout(model.step, np.zeros(4), inputs).states
    path = robot_path(model, X, inputs)
    paths = X[:, model.position] + np.random.default_rng(5).normal(0, 0.3, (20_000, 5, 2))
    whole = contacts(path, paths, 0.2)
    parts = np.concatenate([contacts(path, part, 0.2) for part in np.array_split(paths, 7)])
    np.testing.assert_array_equal(whole, parts)


def test_contact_refuses_what_does_not_fit():
    path = np.zeros((3, 2, 2))
    with pytest.raises(ShapeError, match="obstacles"):
        contacts(path, np.zeros((5, 3, 2)), 0.1)
    with pytest.raises(ShapeError, match="1 point"):
        contacts(path[:, :1], np.zeros((5, 4, 2)), 0.1)
    with pytest.raises(BoundsError, match=r"-0\.1 m"):
        contacts(path, np.zeros((5, 4, 2)), -0.1)
