"""The filter is as uncertain as it says, where obstacles move as it thinks: chi-square bounds."""

import numpy as np
import pytest
from scipy.stats import binom, chi2

from scp_mpc.tracking import Motion, Tracker, TrackerSettings
from scp_mpc.tracking.kalman import mahalanobis

PEOPLE, STD, DT, LEADS = 400, 0.05, 0.4, 12
CV = TrackerSettings(motions=(Motion(0.05),), speed=1.0)
TURNS = TrackerSettings(
    motions=(Motion(0.005), Motion(0.005, 0.8, 0.5), Motion(0.005, -0.8, 0.5)), dwell_time=4.0
)


def truths(motions, intervals, rng, switching=None):
    """States (K+1, n, 4) that follow the motions, each person one of them or switching."""
    x = np.concatenate([rng.normal(0, 20, (PEOPLE, 2)), rng.normal(0, 1, (PEOPLE, 2))], axis=1)
    shares = np.array([motion.weight for motion in motions])
    shares = shares / shares.sum()
    which = rng.choice(len(motions), PEOPLE, p=shares)
    found = [x]
    for dt in intervals:
        if switching is not None:
            anew = rng.uniform(size=PEOPLE) > np.exp(-dt / switching)
            which = np.where(anew, rng.choice(len(motions), PEOPLE, p=shares), which)
        x = np.empty_like(found[-1])
        for j, motion in enumerate(motions):
            F, Q = motion.transition(dt)
            noise = rng.multivariate_normal(np.zeros(4), Q, PEOPLE)
            x[which == j] = (found[-1] @ F.T + noise)[which == j]
        found.append(x)
    return np.array(found)


def followed(settings, true, intervals, rng, dropouts=0.0):
    """A tracker at the end of the intervals, and the time."""
    tracker = Tracker(DT, LEADS, radius=0.0, measurement_std=STD, settings=settings)
    times = np.concatenate([[0.0], np.cumsum(intervals)])
    for k, t in enumerate(times):
        ends = k in (0, len(times) - 1)
        seen = np.flatnonzero((rng.uniform(size=PEOPLE) >= dropouts) | ends)
        tracker.update(t, true[k, seen, :2] + rng.normal(0, STD, (len(seen), 2)), seen.tolist())
    return tracker


def mean_square(tracker, true):
    """Mean of the estimates' normalised squared errors, and the bounds that hold 99.9 %."""
    means, covariances = tracker.estimates()
    square, _ = mahalanobis(true[list(tracker.names)] - means, covariances)
    return square.mean(), chi2.ppf([0.0005, 0.9995], 4 * PEOPLE) / PEOPLE


def foreseen(tracker, future):
    """Normalised squared errors (LEADS, n) of the predictions, and rms errors (LEADS,) [m]."""
    told = tracker.predictions()
    e = np.stack([future[:, o.name, :2] - o.means for o in told], axis=1)[1:]
    Sigma = np.stack([o.covariances for o in told], axis=1)[1:]
    return mahalanobis(e, Sigma)[0], np.sqrt(np.square(e).sum(axis=-1).mean(axis=1))


@pytest.mark.parametrize("dropouts", [0.0, 0.4])
def test_the_filter_is_consistent_at_irregular_times(dropouts):
    rng = np.random.default_rng(5)
    intervals = rng.uniform(0.05, 0.8, 15)
    true = truths(CV.motions, intervals, rng)
    keep = TrackerSettings(motions=CV.motions, speed=1.0, keep=100.0)
    tracker = followed(keep, true, intervals, rng, dropouts)
    square, (low, high) = mean_square(tracker, true[-1])
    assert low < square < high


@pytest.mark.parametrize("density", [0.0125, 0.2])
def test_the_bounds_notice_a_wrong_density(density):
    rng = np.random.default_rng(5)
    true = truths(CV.motions, np.full(15, DT), rng)
    wrong = TrackerSettings(motions=(Motion(density),), speed=1.0)
    square, (low, high) = mean_square(followed(wrong, true, np.full(15, DT), rng), true[-1])
    assert not low < square < high


def test_ellipses_hold_what_they_promise():
    """50, 90 and 95 % at each of 0.4 to 4.8 s."""
    rng = np.random.default_rng(11)
    true = truths(CV.motions, np.full(12 + LEADS, DT), rng)
    squares = foreseen(followed(CV, true[:13], np.full(12, DT), rng), true[12:])[0]
    for level in (0.5, 0.9, 0.95):
        held = (squares <= chi2.ppf(level, 2)).sum(axis=1)
        low, high = binom.ppf([0.0005, 0.9995], PEOPLE, level)
        assert ((low <= held) & (held <= high)).all(), (level, held)


def test_switching_motions_are_as_far_off_as_predicted():
    """Mixtures are no Gaussians, so ellipses hold other shares; but Sigma is their covariance."""
    rng = np.random.default_rng(11)
    true = truths(TURNS.motions, np.full(12 + LEADS, DT), rng, TURNS.dwell_time)
    squares, _ = foreseen(followed(TURNS, true[:13], np.full(12, DT), rng), true[12:])
    error = squares.std(axis=1) / np.sqrt(PEOPLE)
    assert (np.abs(squares.mean(axis=1) - 2) < 4 * error).all()
    assert (error < 0.25).all()


def test_turns_are_foreseen_by_turning_motions():
    """People on circles: errors 2 s ahead are less than half of a constant velocity's."""
    rng = np.random.default_rng(2)
    circles = (Motion(0.002, 0.8), Motion(0.002, -0.8))
    true = truths(circles, np.full(12 + LEADS, DT), rng)
    errors = {}
    for name, settings in (("cv", CV), ("turns", TURNS)):
        draw = np.random.default_rng(3)
        tracker = followed(settings, true[:13], np.full(12, DT), draw)
        errors[name] = foreseen(tracker, true[12:])[1]
    assert (errors["turns"] < errors["cv"]).all()
    assert errors["turns"][4] < 0.5 * errors["cv"][4]
