"""Late reports, obstacles that vanish, clocks that are wrong: what the controller makes of them."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from driving import N, good
from instances import DT, obstacle, straight_reference
from watching import NAN, controller, seen, state, step

from scp_mpc import (
    MPC,
    DoubleIntegrator,
    NotFiniteError,
    ObstaclePrediction,
    Problem,
    ShapeError,
    StaleDataError,
    StalenessPolicy,
    Status,
)
from scp_mpc.obstacles import propagated

WEAK = {"u_min": -1.0, "u_max": 1.0}

# Vanished obstacles


def closest(name, keep=1.0, gap=(4, 7)):
    """Drive past a resting obstacle that is not reported in three steps; smallest distance."""
    mpc = controller(keep=keep)
    x, distances = np.array([0.0, 2.0, 0.0, 0.0]), []
    for k in range(14):
        ref = straight_reference(N) + [0.4 * k, 0, 0, 0]
        there = [] if k in range(*gap) else [seen(name=name, at=(3.2, 0.02), velocity=(0, 0))]
        x = mpc.problem.model.step(x, mpc.step(x, ref, there).u0)
        distances.append(np.hypot(x[0] - 3.2, x[2] - 0.02))
    return min(distances)


def test_an_obstacle_that_vanishes_for_three_steps_is_still_avoided():
    radii = 0.15 + 0.2
    assert closest("crate", gap=(0, 0)) > radii
    assert closest("crate") > radii
    # The same without a name, or with nothing kept, is a collision: the test would see it.
    assert closest(None) < radii
    assert closest("crate", keep=0.0) < radii


def test_a_vanished_obstacle_moves_on_and_grows_until_it_is_forgotten():
    mpc = controller(keep=0.6, growth=0.5)
    report = seen(name="crate")
    step(mpc, report)
    for k in range(1, 4):
        plan = step(mpc)
        (kept,) = mpc.obstacles
        expected = propagated(report, k * DT, DT, 0.5)
        np.testing.assert_allclose(kept.means, expected.means, atol=1e-12)
        np.testing.assert_allclose(kept.covariances, expected.covariances, atol=1e-12)
        assert plan.s.shape == (1,)
    assert step(mpc).s.shape == (0,)
    assert mpc.obstacles == ()
    assert not mpc._memory._reports


def test_a_vanished_obstacle_comes_back_as_it_is():
    mpc = controller()
    for there in ([seen(name=7)], [], [seen(name=7, at=(2.5, 0.4))]):
        step(mpc, *there)
    assert mpc.obstacles == tuple(there)


def test_what_vanishes_late_is_kept_from_when_it_was_last_reported():
    mpc = controller(keep=0.5)
    step(mpc, seen(stamp=9.4, name=7), time=10.0)
    step(mpc, time=10.5)
    assert mpc.obstacles[0].stamp == pytest.approx(10.5)
    step(mpc, time=10.6)
    assert mpc.obstacles == ()


def test_unnamed_obstacles_are_not_kept():
    mpc = controller()
    step(mpc, seen(stamp=0.0), time=0.0)
    step(mpc, time=0.2)
    assert mpc.obstacles == ()


def test_those_given_come_first_and_the_farthest_are_left_out(caplog):
    mpc = controller(slots=2, keep=5.0)
    step(mpc, seen(name="a"), seen(name="b", at=(9.0, 9.0)))
    assert step(mpc, seen(name="b", at=(9.0, 9.0))).left_out == 0
    assert [o.name for o in mpc.obstacles] == ["b", "a"]
    assert not caplog.records
    assert step(mpc, seen(name="c", at=(6.0, -6.0))).left_out == 1
    assert [o.name for o in mpc.obstacles] == ["c", "a"]
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert "3 obstacles, but max_obstacles = 2" in record.getMessage()
    assert step(mpc).left_out == 1  # "b" is kept, and left out again
    assert len(caplog.records) == 1


# Late reports


def test_a_late_report_is_moved_on_and_grown():
    mpc = controller(grow_after=0.1, growth=0.5)
    fresh, late = seen(stamp=10.0), seen(stamp=9.7)
    step(mpc, fresh, time=10.1)
    assert mpc.obstacles == (fresh,)
    step(mpc, late, time=10.2)
    (used,) = mpc.obstacles
    expected = propagated(late, 0.5, DT, 0.5)
    np.testing.assert_allclose(used.means, expected.means, atol=1e-9)
    np.testing.assert_allclose(used.covariances, expected.covariances, atol=1e-9)
    assert (np.linalg.eigvalsh(used.covariances - late.covariances) > 0.2).all()


def test_a_late_report_is_planned_with_as_if_it_had_been_handed_over_aged():
    late = seen(stamp=9.7)
    aged_by_hand = replace(propagated(late, 0.3, DT, StalenessPolicy().growth), stamp=None)
    automatic, by_hand = controller(), controller()
    one, other = step(automatic, late, time=10.0), step(by_hand, aged_by_hand)
    np.testing.assert_allclose(one.X, other.X, atol=1e-9)
    assert not np.allclose(one.X, step(controller(), replace(late, stamp=None)).X)


def test_without_a_given_time_the_clock_runs_by_intervals():
    mpc = controller()
    for k in range(4):
        step(mpc, seen(stamp=0.0))
        assert mpc.obstacles[0].means[0, 0] == pytest.approx(3.0 + 0.3 * DT * k)
    step(mpc, seen(stamp=20.0), time=20.0)
    with pytest.raises(StaleDataError, match="time: missing, but a step before had one"):
        step(mpc, seen(stamp=20.2))
    step(mpc, seen(name="a"))  # without a stamp: of now


@pytest.mark.parametrize("dt", [0.01, 0.05, 0.2, 1.0])
@pytest.mark.parametrize("rate", [0.5, 0.9, 1.5, 3.0])
def test_stamps_of_another_clock_are_refused_without_a_time(dt, rate):
    """Called at another rate than once in an interval: found before it makes a difference."""
    given = {"max_obstacles": 1, "nodes_per_interval": 1}
    mpc = MPC(Problem(DoubleIntegrator(dt), horizon=3, Q=np.ones(4), R=np.ones(2), **WEAK, **given))
    means = np.tile([9.0, 0.0], (4, 1))
    for k in range(60):
        there = ObstaclePrediction(means, np.eye(2), 0.2, stamp=rate * dt * k)
        if abs(rate - 1) * dt * k > 0.05 + 1e-5:
            with pytest.raises(StaleDataError, match=rf"time: missing.*steps of {dt:g} s"):
                mpc.step(np.zeros(4), np.zeros(4), [there])
            break
        mpc.step(np.zeros(4), np.zeros(4), [there])
    else:
        raise AssertionError("believed for ever")
    mpc.reset()
    for k in range(5):  # the same with times is fine, and so is the right rate
        there = ObstaclePrediction(means, np.eye(2), 0.2, stamp=rate * dt * k)
        mpc.step(np.zeros(4), np.zeros(4), [there], time=rate * dt * k)
    mpc.reset()
    for k in range(60):
        there = ObstaclePrediction(means, np.eye(2), 0.2, stamp=dt * k)
        mpc.step(np.zeros(4), np.zeros(4), [there])
        assert mpc.obstacles == (there,)


def test_stamps_ahead_of_the_clock_that_counts_steps_are_refused():
    for stamp in (DT, 0.1, 100.0):
        with pytest.raises(StaleDataError, match="off the clock that counts steps"):
            step(controller(), seen(stamp=stamp))


@pytest.mark.parametrize("ahead", [0.01, 0.05, 0.1, 0.24])
def test_stamps_of_the_future_are_moved_back_to_now(ahead):
    """As much as they are ahead; nothing becomes surer."""
    mpc, report = controller(), seen(stamp=10.0 + ahead, velocity=(2.0, 0.5))
    step(mpc, report, time=10.0)
    (used,) = mpc.obstacles
    np.testing.assert_allclose(used.means, report.means - ahead * np.array([2.0, 0.5]), atol=1e-12)
    np.testing.assert_array_equal(used.covariances[0], report.covariances[0])
    share = ahead / DT - np.floor(ahead / DT)
    first = int(np.floor(ahead / DT))
    older = share * report.covariances[1] + (1 - share) * report.covariances[2]
    np.testing.assert_allclose(used.covariances[2 + first], older, atol=1e-12)
    assert used.stamp == pytest.approx(10.0)


def test_a_clock_that_jumps_ahead_forgets_who_vanished_and_brakes_for_old_reports():
    mpc = controller()
    step(mpc, seen(stamp=10.0, name="a"), time=10.0)
    assert step(mpc, seen(stamp=10.2, name="a"), time=1e6).status is Status.STALE
    plan = step(mpc, seen(stamp=1e6, name="b"), time=1e6 + DT)
    assert [o.name for o in mpc.obstacles] == ["b"]
    assert plan.ok
    with pytest.raises(StaleDataError, match=r"time: 10.6 s is before .* reset\(\) forgets that"):
        step(mpc, seen(stamp=10.6), time=10.6)
    mpc.reset()
    assert step(mpc, seen(stamp=10.6), time=10.6).ok


@pytest.mark.parametrize("epoch", [0.0, 1.8e9])
def test_limits_are_met_exactly_whatever_the_epoch(epoch):
    """Five intervals of 0.2 s are one second, also in floating point."""
    mpc = controller(beyond="refuse", keep=1.0)
    report = seen(stamp=epoch, name=7)
    for k in range(6):
        step(mpc, report, time=epoch + k * DT)
    with pytest.raises(StaleDataError):
        step(mpc, report, time=epoch + 6 * DT)
    for k in range(6, 11):
        step(mpc, time=epoch + k * DT)
        assert len(mpc.obstacles) == 1
    step(mpc, time=epoch + 11 * DT)
    assert mpc.obstacles == ()


# Too old


def test_a_report_that_is_too_old_is_refused_where_so_configured():
    mpc = controller(slots=2, beyond="refuse", stop_after=0.5)
    step(mpc, time=10.0)
    before = state(mpc)
    with pytest.raises(StaleDataError, match=r"obstacles\[1\].stamp: 9.6 s is 0.6 s old") as error:
        step(mpc, seen(stamp=10.1, name="a"), seen(stamp=9.6, name="b"), time=10.2)
    assert error.value.argument == "obstacles[1].stamp"
    assert state(mpc) == before


def test_a_report_that_is_too_old_brakes(caplog):
    mpc = controller(stop_after=0.5)
    x, speeds = np.array([0.0, 2.0, 0.0, 0.4]), []
    for k in range(8):
        plan = mpc.step(x, straight_reference(N), [seen(stamp=9.0, name="a")], time=10.0 + k * DT)
        assert plan.status is Status.STALE
        assert not plan.ok
        assert (np.abs(plan.u0) <= 3.0).all()
        x = mpc.problem.model.step(x, plan.u0)
        speeds.append(np.hypot(x[1], x[3]))
    assert speeds == sorted(speeds, reverse=True)
    assert speeds[-1] < 1e-6
    assert mpc.counts == {Status.STALE: 8}
    assert "obstacles[0].stamp: 9.0 s is 1 s old" in caplog.text
    # A report in time ends it.
    plan = mpc.step(x, straight_reference(N), [seen(stamp=11.6, name="a")], time=11.6)
    assert plan.ok, plan.status


def test_an_absurdly_old_report_brakes_too():
    assert step(controller(), seen(stamp=-9e14), time=9e14).status is Status.STALE


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"x0": [0, 0, NAN, 0]}, NotFiniteError),
        ({"x_ref": np.zeros(3)}, ShapeError),
        ({"obstacles": [replace(obstacle(N + 1, (1, 0)), stamp=0.0, name=1)]}, ShapeError),
    ],
)
def test_bad_arguments_are_refused_before_braking(change, error):
    mpc = controller()
    step(mpc, time=5.0)
    before = state(mpc)
    arguments = good() | {"obstacles": [seen(stamp=0.0, name=1)]} | change
    with pytest.raises(error):
        mpc.step(**arguments, time=5.2)
    assert state(mpc) == before


def test_what_was_too_old_is_kept_when_it_vanishes():
    mpc = controller()
    report = seen(stamp=8.5, name="a")
    assert step(mpc, report, time=10.0).status is Status.STALE
    step(mpc, time=10.2)
    np.testing.assert_allclose(
        mpc.obstacles[0].covariances, propagated(report, 1.7, DT, 0.1).covariances, atol=1e-9
    )
