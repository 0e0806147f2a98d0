"""Coverage: counted by hand, near its promise where people walk as the tracker thinks."""

import numpy as np
import pytest
from recordings import street

from scp_mpc.errors import BoundsError, InvalidArgumentError
from scp_mpc.report import coverage_numbers, coverage_table
from scp_mpc.simulation import Recording, measure_coverage
from scp_mpc.tracking import WALKING, Motion, Tracker, TrackerSettings


def walkers(motion, people=120, frames=20, seed=4):
    """People who walk as a motion says."""
    rng = np.random.default_rng(seed)
    F, Q = motion.transition(0.4)
    x = np.concatenate([rng.normal(0, 9, (people, 2)), rng.normal(0, 0.8, (people, 2))], axis=1)
    path = [x]
    for _ in range(frames - 1):
        path.append(path[-1] @ F.T + rng.multivariate_normal(np.zeros(4), Q, people))
    places = np.array(path)[..., :2].reshape(-1, 2)
    names = np.tile(np.arange(people), frames)
    return Recording.from_rows(np.repeat(0.4 * np.arange(frames), people), names, places)


@pytest.fixture(scope="module")
def model():
    motion = Motion(0.05)
    settings = TrackerSettings(motions=(motion,), speed=0.8)
    return walkers(motion), settings, measure_coverage(walkers(motion), settings=settings)


def test_promises_are_kept_by_people_of_the_model(model):
    _, _, found = model
    assert [round(row.lead, 6) for row in found.leads] == [round(0.4 * i, 6) for i in range(1, 13)]
    for row in found.leads:
        for level, share, error in zip(found.levels, row.shares, row.errors, strict=True):
            assert 0 < error < 0.04
            assert abs(share - level) < 4 * error
        assert row.nees == pytest.approx(2.0, abs=0.3)
        assert row.rms_predicted == pytest.approx(row.rms_error, rel=0.1)
        assert row.mean_error < row.rms_error
        assert row.people == 120
    assert found.leads[0].samples == 120 * 18  # from the second frame to the last but one


def test_overconfidence_shows(model):
    recording, _, _ = model
    sure = TrackerSettings(motions=(Motion(0.05),), std_inflation=0.5)
    for row in measure_coverage(recording, settings=sure).leads:
        assert row.nees > 5
        assert row.shares[2] < 0.8


TWICE = TrackerSettings(confirmations=2)


def test_counts_are_those_of_a_loop():
    """One lead time, with explicit loops over frames and people."""
    recording, noise, lead = street(), 0.1, 5
    found = measure_coverage(recording, noise=noise, seed=3).leads[lead - 1]
    rng = np.random.default_rng(3)
    tracker = Tracker(recording.interval, 12, radius=0, measurement_std=noise, settings=TWICE)
    squares, errors = [], []
    for k, (names, places) in enumerate(zip(recording.names, recording.positions, strict=True)):
        measured = places + noise * rng.standard_normal(places.shape)
        tracker.update(recording.times[k], measured, names.tolist())
        if k + lead >= len(recording.times):
            continue
        later = dict(zip(recording.names[k + lead], recording.positions[k + lead], strict=True))
        for o in tracker.predictions():
            if o.name in names and o.name in later:
                e = later[o.name] - o.means[lead]
                squares.append(e @ np.linalg.inv(o.covariances[lead]) @ e)
                errors.append(np.linalg.norm(e))
    assert found.samples == len(squares)
    assert found.nees == pytest.approx(np.mean(squares))
    assert found.mean_error == pytest.approx(np.mean(errors))
    inside = np.array(squares) <= 5.991464547
    assert found.shares[2] == pytest.approx(inside.mean())


def test_same_seed_same_numbers(model):
    recording, settings, found = model
    assert measure_coverage(recording, settings=settings) == found
    assert measure_coverage(recording, settings=settings, seed=1) != found


def test_bad_arguments_are_refused():
    recording = street()
    for values, error in (
        ({"noise": 0.0}, BoundsError),
        ({"seed": -1}, BoundsError),
        ({"levels": (0.5, 1.0)}, BoundsError),
        ({"longest": 0.1}, InvalidArgumentError),
    ):
        with pytest.raises(error):
            measure_coverage(recording, **values)
    one = Recording.from_rows(np.zeros(2), np.array([1, 2]), np.zeros((2, 2)))
    with pytest.raises(InvalidArgumentError, match="no two frames"):
        measure_coverage(one)
    brief = Recording.from_rows(np.array([0, 0.4]), np.array([1, 1]), np.zeros((2, 2)))
    with pytest.raises(InvalidArgumentError, match="nobody is seen long enough"):
        measure_coverage(brief)


def test_default_motions_are_those_of_walking():
    assert TrackerSettings().motions == WALKING


def test_table_and_numbers(model):
    found = model[2]
    header, *rows = coverage_table(found)
    assert len(rows) == 12
    assert {len(row) for row in rows} == {len(header)}
    numbers = coverage_numbers(found)
    assert numbers["leads"][3]["shares"] == found.leads[3].shares
