"""The half-spaces: tight, sound, with the right derivatives; joint convexity of the exact set."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from instances import S_REF, obstacle, rotated

from scp_mpc import ObstaclePrediction
from scp_mpc.geometry import AxesInflation, ExactInflation, NoGoSets

STAGES = 6
INFLATIONS = {"exact": ExactInflation(S_REF), "axes": AxesInflation(S_REF)}
both = pytest.mark.parametrize("inflation", INFLATIONS.values(), ids=INFLATIONS.keys())
seeds = st.integers(0, 2**32 - 1)


def scene(seed, slots=2):
    """Random ellipses, positions around and inside them, and sizes s."""
    rng = np.random.default_rng(seed)
    predictions = [
        obstacle(
            STAGES,
            tuple(rng.normal(size=2)),
            tuple(rng.normal(size=2)),
            rotated(tuple(rng.uniform(0.05, 1.0, 2)), rng.uniform(0, np.pi)),
            radius=rng.uniform(0.0, 0.5),
        )
        for _ in range(2)
    ]
    sets = NoGoSets.from_predictions(predictions, 0.15, slots, STAGES, 2)
    p, s = 3 * rng.normal(size=(STAGES, 2)), rng.uniform(0.5, 4.0, slots)
    return rng, predictions, sets, p, s, p[:1] - sets.means[:, 0]


@both
@given(seed=seeds)
def test_tight_at_the_nominal_point(inflation, seed):
    _, _, sets, p, s, start = scene(seed)
    spaces = inflation.linearise(sets, p, s, start)
    np.testing.assert_allclose(spaces.residual(p, s), spaces.value, atol=1e-9)


@both
@given(seed=seeds)
def test_gradient_agrees_with_finite_differences(inflation, seed):
    _, _, sets, p, s, start = scene(seed)
    spaces = inflation.linearise(sets, p, s, start)
    h = 1e-6

    def value(dp, ds):
        return inflation.linearise(sets, p + dp, s + ds, start).value

    for axis in np.eye(2):
        slope = (value(h * axis, 0) - value(-h * axis, 0)) / (2 * h)
        # Near the medial axis the distance has a kink, which differences straddle.
        smooth = spaces.value > -0.02 * sets.deviations.min()
        np.testing.assert_allclose((spaces.normal @ axis)[smooth], slope[smooth], atol=1e-4)
        slope = (value(0, h) - value(0, -h)) / (2 * h)
        np.testing.assert_allclose(spaces.slope[smooth], slope[smooth], atol=1e-4)


@given(seed=seeds)
def test_exact_half_spaces_are_sound(seed):
    """No point that a half-space allows, at any s, is inside the no-go set of that s."""
    rng, _, sets, p, s, start = scene(seed)
    exact = INFLATIONS["exact"]
    spaces = exact.linearise(sets, p, s, start)
    for _ in range(20):
        q, t = 3 * rng.normal(size=(STAGES, 2)), rng.uniform(0.0, 5.0, 2)
        truth = exact.linearise(sets, q, t, start).value
        assert (truth >= spaces.residual(q, t) - 1e-9).all()


@given(seed=seeds)
def test_axes_half_spaces_are_sound_at_fixed_s(seed):
    rng, _, sets, p, s, start = scene(seed)
    axes = INFLATIONS["axes"]
    spaces = axes.linearise(sets, p, s, start)
    for _ in range(20):
        q = 3 * rng.normal(size=(STAGES, 2))
        truth = axes.linearise(sets, q, s, start).value
        assert (truth >= spaces.residual(q, s) - 1e-9).all()


@given(seed=seeds)
def test_signed_distance_is_jointly_convex_in_position_and_size(seed):
    rng, _, sets, p, s, start = scene(seed)
    exact = INFLATIONS["exact"]
    q, t = p + rng.normal(size=p.shape), rng.uniform(0.0, 5.0, 2)

    def g(position, size):
        return exact.linearise(sets, position, size, start).value

    assert (g((p + q) / 2, (s + t) / 2) <= (g(p, s) + g(q, t)) / 2 + 1e-9).all()


def test_exact_value_is_the_distance_to_the_inflated_ellipse():
    """Against points pushed along the normal from the boundary of the ellipse."""
    Sigma = rotated((0.7, 0.2), 0.6)
    sets = NoGoSets.from_predictions([obstacle(1, (1, -2), (0, 0), Sigma, 0.0)], 0.15, 1, 1, 2)
    for angle in np.linspace(0, 2 * np.pi, 25):
        n = np.array([np.cos(angle), np.sin(angle)])
        boundary = sets.means[0, 0] + 2.0 * Sigma @ n / np.sqrt(n @ Sigma @ n)
        for away in (0.0, 0.35, 1.5):
            point = boundary + away * n
            spaces = INFLATIONS["exact"].linearise(
                sets, point[None], np.array([2.0]), np.ones((1, 2))
            )
            assert spaces.value[0, 0] == pytest.approx(away - 0.35, abs=1e-9)
            np.testing.assert_allclose(spaces.normal[0, 0], n, atol=1e-7)


def test_axes_agrees_with_the_reports_quadratic_form():
    """(5a) and (14): g >= 0 where the report's quadratic form is at least 1."""
    rng, predictions, sets, p, s, start = scene(5)
    spaces = INFLATIONS["axes"].linearise(sets, p, s, start)
    for j, prediction in enumerate(predictions):
        for i in range(STAGES):
            variances, R = np.linalg.eigh(prediction.covariances[i + 1])
            E = R @ np.diag((s[j] * np.sqrt(variances) + 0.15 + prediction.radius) ** -2.0) @ R.T
            delta = p[i] - prediction.means[i + 1]
            assert (spaces.value[j, i] >= 0) == (delta @ E @ delta >= 1)
    assert rng is not None


def test_axes_lies_inside_the_exact_set_and_falls_short_by_8_centimetres():
    """The report's own numbers: between the axes its ellipse is 8.5 cm short of safe."""
    Sigma = np.array([[0.5, 0.3], [0.3, 0.2]])
    sets = NoGoSets.from_predictions([obstacle(1, (0, 0), (0, 0), Sigma, 0.0)], 0.15, 1, 1, 2)
    variances, R = np.linalg.eigh(Sigma)
    angle = np.linspace(0, 2 * np.pi, 2001)
    boundary = np.stack([np.cos(angle), np.sin(angle)], 1) * (S_REF * np.sqrt(variances) + 0.35)
    gaps = np.array(
        [INFLATIONS["exact"].clearance(sets, point[None])[0, 0] for point in boundary @ R.T]
    )
    assert gaps.max() <= 1e-9
    assert gaps.min() == pytest.approx(-0.085, abs=0.001)


@both
def test_inactive_slots_constrain_nothing(inflation):
    _, predictions, sets, p, s, start = scene(3)
    padded = NoGoSets.from_predictions(predictions, 0.15, 3, STAGES, 2)
    spaces = inflation.linearise(padded, p, np.append(s, 1.0), np.ones((3, 2)))
    assert not spaces.normal[2].any()
    assert not spaces.slope[2].any()
    assert (spaces.offset[2] == -np.inf).all()
    full = inflation.linearise(sets, p, s, start)
    np.testing.assert_array_equal(spaces.normal[:2], full.normal)


@both
def test_robot_on_the_obstacle_gets_a_finite_normal_on_the_side_it_came_from(inflation):
    prediction = obstacle(2, (1.0, 0.0), (0.0, 0.0))
    sets = NoGoSets.from_predictions([prediction], 0.15, 1, 2, 2)
    p = np.array([[1.0, 0.0], [1.0, 0.0]])
    spaces = inflation.linearise(sets, p, np.array([2.0]), np.array([[-0.4, 0.1]]))
    assert np.isfinite(spaces.normal).all()
    assert spaces.normal[0, 0] @ [-0.4, 0.1] > 0
    assert np.isfinite(spaces.normal[0, 1]).all()
    assert np.linalg.norm(spaces.normal[0, 1]) > 0.1


@both
@pytest.mark.parametrize("seed", range(4))
def test_in_space_against_the_boundary_reached_along_a_normal(inflation, seed):
    """A covariance whose eigenvectors are no reflection tells R from R'."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 3)) * [1.0, 0.5, 0.2]
    Sigma, mean = root @ root.T, rng.normal(size=3)
    prediction = ObstaclePrediction(np.tile(mean, (2, 1)), Sigma, 0.2)
    sets = NoGoSets.from_predictions([prediction], 0.15, 1, 1, 3)
    n = rng.normal(size=3)
    n /= np.linalg.norm(n)
    spread = np.sqrt(n @ Sigma @ n)
    if inflation is INFLATIONS["exact"]:
        boundary = mean + S_REF * Sigma @ n / spread + 0.35 * n
    else:
        variances, R = np.linalg.eigh(Sigma)
        semi = S_REF * np.sqrt(variances) + 0.35
        boundary = mean + R @ (semi * (local := R.T @ n)) / np.linalg.norm(local)
    s, start = np.array([S_REF]), np.ones((1, 3))
    spaces = inflation.linearise(sets, boundary[None], s, start)
    assert spaces.value[0, 0] == pytest.approx(0.0, abs=1e-9)
    assert inflation.clearance(sets, boundary[None])[0, 0] == pytest.approx(0.0, abs=1e-9)
    if inflation is INFLATIONS["exact"]:
        np.testing.assert_allclose(spaces.normal[0, 0], n, atol=1e-7)
        assert spaces.slope[0, 0] == pytest.approx(-spread, abs=1e-9)
    h = 1e-6
    for axis in np.eye(3):
        ahead, behind = (
            inflation.linearise(sets, (boundary + sign * h * axis)[None], s, start).value[0, 0]
            for sign in (1, -1)
        )
        assert spaces.normal[0, 0] @ axis == pytest.approx((ahead - behind) / (2 * h), abs=1e-5)
