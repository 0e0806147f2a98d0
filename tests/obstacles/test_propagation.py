"""Predictions that grow old: where they go, and that they never grow more certain."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import obstacle

from scp_mpc import BoundsError, InvalidArgumentError, NotFiniteError, ObstaclePrediction
from scp_mpc.obstacles import propagated

DT = 0.2


def positive(matrix):
    """Whether a symmetric matrix is positive semi-definite, up to rounding."""
    return np.linalg.eigvalsh(matrix)[0] >= -1e-9 * max(1.0, np.abs(matrix).max())


def drawn(seed, rows=9, dim=2):
    """A prediction that wanders; its covariance rises and falls at random."""
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(rows, dim, dim))
    return ObstaclePrediction(
        rng.normal(scale=3.0, size=(rows, dim)), roots @ np.swapaxes(roots, 1, 2), 0.3
    )


def steady(dim, growth=0.05, rows=9):
    """Constant velocity, and a covariance that grows by the same matrix in each interval."""
    i = np.arange(rows)[:, None]
    rate = growth * (np.eye(dim) + 0.5)
    return ObstaclePrediction(
        np.arange(1.0, dim + 1) + 0.3 * i * np.arange(1, dim + 1),
        0.1 * np.eye(dim) + i[..., None] * rate,
        0.2,
        stamp=5.0,
        name="steady",
    )


def slowly(prediction, age, dt, growth):
    """`propagated`, row by row and word by word."""
    mu, Sigma, N = prediction.means, prediction.covariances, prediction.horizon
    means, covariances = [], []
    values, vectors = np.linalg.eigh(Sigma[N] - Sigma[N - 1])
    rate = sum(max(v, 0.0) * np.outer(e, e) for v, e in zip(values, vectors.T, strict=True)) / dt
    velocity = (mu[N] - mu[N - 1]) / dt
    for i in range(N + 1):
        t = i * dt + age
        if t >= N * dt:
            means.append(mu[N] + (t - N * dt) * velocity)
            now = Sigma[N] + (t - N * dt) * rate
        else:
            before = max(k for k in range(N) if k * dt <= t)
            share = t / dt - before
            means.append((1 - share) * mu[before] + share * mu[before + 1])
            now = (1 - share) * Sigma[before] + share * Sigma[before + 1]
        covariances.append(now + age * growth * np.eye(prediction.dim))
    return np.array(means), np.array(covariances)


ages = st.floats(0.0, 5.0)
seeds = st.integers(0, 10_000)
dims = st.sampled_from([2, 3])
growths = st.floats(0.0, 2.0)


@settings(max_examples=150, deadline=None)
@given(seeds, dims, ages, growths, st.integers(2, 12))
def test_agrees_with_the_slow_computation(seed, dim, age, growth, rows):
    prediction = drawn(seed, rows, dim)
    result = propagated(prediction, age, DT, growth)
    means, covariances = slowly(prediction, age, DT, growth)
    np.testing.assert_allclose(result.means, means, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(result.covariances, covariances, rtol=1e-9, atol=1e-9)
    assert result.means.shape == prediction.means.shape
    assert (result.radius, result.name) == (prediction.radius, prediction.name)


@settings(max_examples=100, deadline=None)
@given(seeds, dims, ages, growths)
def test_what_is_returned_could_have_been_made_from_scratch(seed, dim, age, growth):
    """The result is not checked, so it must need no check: same spread, read-only, valid."""
    result = propagated(drawn(seed, dim=dim), age, DT, growth)
    again = ObstaclePrediction(result.means, result.covariances, result.radius)
    np.testing.assert_allclose(result.largest_std, again.largest_std, rtol=1e-12)
    if age > 0:
        for array in (result.means, result.covariances, result.largest_std):
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 1.0


@settings(max_examples=150, deadline=None)
@given(seeds, dims, ages, growths)
def test_never_more_certain_than_the_prediction_was_for_that_time(seed, dim, age, growth):
    prediction = drawn(seed, dim=dim)
    result, N = propagated(prediction, age, DT, growth), prediction.horizon
    ungrown = propagated(prediction, age, DT, 0.0)
    for i in range(N + 1):
        more = result.covariances[i] - ungrown.covariances[i]
        assert positive(more - 0.999999 * age * growth * np.eye(dim))
        if i + age / DT >= N:
            assert positive(result.covariances[i] - prediction.covariances[N])


def test_whole_intervals_shift_the_rows():
    prediction = drawn(3)
    result = propagated(prediction, 3 * DT, DT, 0.0)
    np.testing.assert_allclose(result.means[:6], prediction.means[3:], atol=1e-12)
    np.testing.assert_allclose(result.covariances[:6], prediction.covariances[3:], atol=1e-12)


def test_age_zero_changes_nothing():
    prediction = drawn(1)
    assert propagated(prediction, 0.0, DT, 0.1) is prediction


@settings(max_examples=100, deadline=None)
@given(dims, ages, ages, growths)
def test_two_ages_in_a_row_are_one(dim, first, second, growth):
    prediction = steady(dim)
    twice = propagated(propagated(prediction, first, DT, growth), second, DT, growth)
    once = propagated(prediction, first + second, DT, growth)
    np.testing.assert_allclose(twice.means, once.means, atol=1e-9)
    np.testing.assert_allclose(twice.covariances, once.covariances, atol=1e-9)
    assert twice.stamp == pytest.approx(once.stamp)
    assert once.stamp == pytest.approx(5.0 + first + second)


def test_a_shrinking_covariance_stays():
    shrinking = obstacle(8, (1.0, 0.0), growth=-0.05)
    result = propagated(shrinking, 4.0, DT, 0.0)
    np.testing.assert_array_equal(result.covariances, np.tile(shrinking.covariances[-1], (9, 1, 1)))


def test_a_covariance_that_turns_grows_where_it_grew():
    Sigma = np.diag([1.0, 1.0]) + np.arange(9)[:, None, None] * np.diag([0.1, -0.1])
    result = propagated(ObstaclePrediction(np.zeros((9, 2)), Sigma, 0.2), 2.0, DT, 0.0)
    np.testing.assert_allclose(result.covariances[-1], np.diag([2.8, 0.2]))


@pytest.mark.parametrize("age", [1e3, 1e6, 1e9])
@pytest.mark.parametrize("dim", [2, 3])
def test_large_ages_stay_finite(age, dim):
    result = propagated(steady(dim), age, DT, 0.1)
    assert np.isfinite(result.means).all()
    assert (np.linalg.eigvalsh(result.covariances) > 0).all()


@pytest.mark.parametrize("covariance", [np.zeros((2, 2)), np.diag([1.0, 0.0]), 1e12 * np.eye(2)])
def test_singular_and_huge_covariances_age(covariance):
    result = propagated(obstacle(8, (1.0, 0.0), covariance=covariance), 0.33, DT, 0.1)
    ObstaclePrediction(result.means, result.covariances, 0.2)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((-0.1, DT, 0.1), "age: -0.1"),
        ((np.nan, DT, 0.1), "age: nan"),
        ((0.1, 0.0, 0.1), "dt: 0.0"),
        ((0.1, DT, -1.0), "growth: -1.0"),
        ((1e15, DT, 1e3), "age: .* exceeds"),
    ],
)
def test_bad_ages_are_refused(arguments, message):
    with pytest.raises((BoundsError, NotFiniteError), match=message):
        propagated(steady(2), *arguments)


def test_stamps_and_names_are_optional_and_checked():
    plain = obstacle(8, (1.0, 0.0))
    assert (plain.stamp, plain.name) == (None, None)
    known = replace(plain, stamp=np.float32(2.0), name=("track", 7))
    assert (known.stamp, known.name) == (2.0, ("track", 7))
    np.testing.assert_array_equal(known.means, plain.means)
    np.testing.assert_array_equal(known.largest_std, plain.largest_std)
    for stamp in (np.nan, np.inf):
        with pytest.raises(NotFiniteError, match="stamp"):
            replace(plain, stamp=stamp)
    for stamp in ("now", [1.0, 2.0]):
        with pytest.raises(InvalidArgumentError, match="stamp"):
            replace(plain, stamp=stamp)
    with pytest.raises(InvalidArgumentError, match=r"name: \[7\] is not hashable"):
        replace(plain, name=[7])
