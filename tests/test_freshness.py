"""Late reports, obstacles that vanish, clocks that are wrong: what the controller makes of them."""

import logging
from dataclasses import replace
from threading import Event, Thread

import numpy as np
import pytest
from driving import N, drive, good, same
from instances import DT, obstacle, problem, straight_reference

from scp_mpc import (
    MPC,
    BoundsError,
    ConcurrentUseError,
    Freshness,
    InvalidArgumentError,
    NotFiniteError,
    ObstaclePrediction,
    Settings,
    ShapeError,
    StaleDataError,
    Status,
    TooManyObstaclesError,
)
from scp_mpc.control.memory import ObstacleMemory
from scp_mpc.obstacles import aged

NAN = np.nan


def settings(**changes):
    return Settings(freshness=Freshness(**changes))


def seen(stamp=None, name=None, at=(3.0, 0.1), velocity=(0.3, 0.0)):
    return replace(obstacle(N, at, velocity), stamp=stamp, name=name)


def controller(slots=1, **changes):
    return MPC(problem(N, max_obstacles=slots), settings(**changes))


def step(mpc, *obstacles, time=None):
    ref = straight_reference(N)
    return mpc.step(ref[0], ref, obstacles, time=time)


def state(mpc):
    """Everything that a step may change, to compare by identity."""
    memory = mpc._memory
    return (mpc._last, mpc._steps_touching, mpc.obstacles, mpc.counts, mpc.overruns) + (
        memory._time,
        dict(memory._reports),
    )


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
        expected = aged(report, k * DT, DT, 0.5)
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


def test_those_given_come_first_and_the_oldest_kept_are_left_out(caplog):
    mpc = controller(slots=2, keep=5.0)
    step(mpc, seen(name="a"), seen(name="b", at=(9.0, 9.0)))
    step(mpc, seen(name="b", at=(9.0, 9.0)))
    assert [o.name for o in mpc.obstacles] == ["b", "a"]
    assert not caplog.records
    step(mpc, seen(name="c", at=(9.0, -9.0)))
    assert [o.name for o in mpc.obstacles] == ["c", "b"]
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert "room for 1" in record.getMessage()
    # There is room again, and "a" was heard of 0.6 s ago.
    step(mpc)
    assert [o.name for o in mpc.obstacles] == ["c", "b"]
    with pytest.raises(TooManyObstaclesError):
        step(mpc, *(seen(name=i) for i in range(3)))


# Late reports


def test_a_late_report_is_moved_on_and_grown():
    mpc = controller(grow_after=0.1, growth=0.5)
    fresh, late = seen(stamp=10.0), seen(stamp=9.7)
    step(mpc, fresh, time=10.1)
    assert mpc.obstacles == (fresh,)
    step(mpc, late, time=10.2)
    (used,) = mpc.obstacles
    expected = aged(late, 0.5, DT, 0.5)
    np.testing.assert_allclose(used.means, expected.means, atol=1e-9)
    np.testing.assert_allclose(used.covariances, expected.covariances, atol=1e-9)
    assert (np.linalg.eigvalsh(used.covariances - late.covariances) > 0.2).all()


def test_a_late_report_is_planned_with_as_if_it_had_been_handed_over_aged():
    late = seen(stamp=9.7)
    aged_by_hand = replace(aged(late, 0.3, DT, Freshness().growth), stamp=None)
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
    step(mpc, seen(stamp=20.0))
    assert mpc.obstacles[0].stamp == pytest.approx(20.2)


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
        ({"obstacles": [seen(stamp=0.0, name=j) for j in range(2)]}, TooManyObstaclesError),
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
        mpc.obstacles[0].covariances, aged(report, 1.7, DT, 0.1).covariances, atol=1e-9
    )


# Wrong clocks, missing stamps, same names


BAD = [
    ({"time": 9.9}, StaleDataError, "time: 9.9 s is before the last step's 10.0 s"),
    ({"time": NAN}, NotFiniteError, "time"),
    ({"time": "noon"}, InvalidArgumentError, "time"),
    ({"time": [10.2, 10.4]}, InvalidArgumentError, "time"),
    ({"time": 1e18}, BoundsError, "time"),  # nanoseconds
    (
        {"obstacles": [seen(stamp=10.5)], "time": 10.2},
        StaleDataError,
        r"\[0\].stamp: 10.5 s is 0.3",
    ),
    ({"obstacles": [seen(stamp=1.8e9)]}, StaleDataError, "ahead of this step's time 10.2 s"),
    ({"obstacles": [seen(name=1), seen(name=1)]}, InvalidArgumentError, r"\[1\].name: 1 is given"),
    ({"obstacles": seen(name=1)}, InvalidArgumentError, "obstacles"),
    ({"obstacles": [seen(name=1), None]}, InvalidArgumentError, r"obstacles\[1\]: None"),
    ({"obstacles": [seen(name=1)], "x0": [NAN, 0, 0, 0]}, NotFiniteError, "x0"),
    ({"obstacles": [replace(obstacle(N + 1, (1, 0)), name=1)]}, ShapeError, r"obstacles\[0\]"),
]


@pytest.mark.parametrize(("change", "error", "message"), BAD)
def test_a_bad_step_is_refused_and_leaves_no_trace(change, error, message):
    mpc = controller()
    step(mpc, seen(stamp=9.9, name="crate"), time=10.0)
    before = state(mpc)
    with pytest.raises(error, match=message):
        mpc.step(**(good() | change))
    assert state(mpc) == before


def test_a_solver_that_fails_leaves_no_trace(monkeypatch):
    mpc = controller()
    step(mpc, seen(stamp=9.9, name="crate"), time=10.0)
    before = state(mpc)
    with monkeypatch.context() as broken:
        broken.setattr(mpc._solver, "solve_from", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            step(mpc, seen(stamp=10.2, name="barrel"), time=10.2)
    assert state(mpc) == before
    step(mpc, time=10.2)
    assert [o.name for o in mpc.obstacles] == ["crate"]


def test_the_same_time_twice_and_a_little_ahead_are_fine():
    mpc = controller()
    for stamp in (10.0, 10.25):
        report = seen(stamp=stamp)
        step(mpc, report, time=10.0)
        assert mpc.obstacles == (report,)


def test_stamps_may_be_required():
    mpc = controller(stamps="required")
    for obstacles, time, message in (
        ((), None, "time: missing"),
        ((seen(),), 0.0, r"obstacles\[0\].stamp: missing"),
        ((seen(name="a"),), 0.0, r"obstacles\[0\].stamp: missing"),
    ):
        with pytest.raises(StaleDataError, match=message):
            step(mpc, *obstacles, time=time)
    step(mpc, seen(stamp=0.0), time=0.0)
    step(mpc, time=0.2)


# Counters, reset, threads, the last guard


def test_names_and_stamps_of_the_present_change_nothing():
    """Memory on or off: the same plans, bit for bit, while nothing is late and nobody vanishes."""
    plain, known = MPC(problem(N)), MPC(problem(N))
    ref = straight_reference(N)
    for k in range(5):
        report = seen(at=(2.0 + 0.06 * k, 0.1))
        one = plain.step(ref[0], ref, [report])
        other = known.step(ref[0], ref, [replace(report, stamp=k * DT, name="a")], time=k * DT)
        assert same([one], [other])


def test_reset_forgets_obstacles_time_and_counts():
    mpc = MPC(problem(N), Settings(deadline=1e-9))
    first = drive(MPC(problem(N), Settings(deadline=1e-9)), 6)
    step(mpc, seen(stamp=50.0, name="crate", at=(1.5, 0.1)), time=50.0)
    assert mpc.overruns == sum(mpc.counts.values()) == 1
    mpc.reset()
    assert (mpc.overruns, mpc.counts, mpc.obstacles) == (0, {}, ())
    assert same(first, drive(mpc, 6))


def test_steps_are_counted_by_status():
    mpc = MPC(problem(N))
    plans = drive(mpc, 6)
    assert mpc.counts == {s: [p.status for p in plans].count(s) for s in {p.status for p in plans}}
    assert mpc.overruns == 0
    mpc.counts[Status.CONVERGED] += 1  # a copy
    assert sum(mpc.counts.values()) == 6


def test_a_second_thread_is_refused_before_anything_is_read():
    mpc = controller()
    step(mpc, seen(name="crate"))
    inside, done = Event(), Event()

    def waiting():
        inside.set()
        assert done.wait(10)
        yield seen(name="barrel")

    ref = straight_reference(N)
    thread = Thread(target=lambda: mpc.step(ref[0], ref, waiting()))
    thread.start()
    try:
        assert inside.wait(10)
        before = state(mpc)
        for use in (lambda: step(mpc, None, time=NAN), mpc.reset):
            with pytest.raises(ConcurrentUseError):
                use()
        assert state(mpc) == before
    finally:
        done.set()
        thread.join()
    step(mpc)
    assert {o.name for o in mpc.obstacles} <= {"crate", "barrel"}
    mpc.reset()


@pytest.mark.parametrize("wrong", [NAN, np.inf, 3.001, -3.001])
def test_the_input_is_checked_last(monkeypatch, caplog, wrong):
    mpc = controller()
    plan = step(mpc)
    U = plan.U.copy()
    U[0, 1] = wrong
    broken = replace(plan, U=U, iterate=replace(plan.iterate, inputs=U))
    with monkeypatch.context() as patched:
        patched.setattr(mpc._solver, "solve_from", lambda *_, **__: broken)
        guarded = mpc.step([0.0, 2.0, 0.0, 0.0], straight_reference(N))
    assert guarded.status is Status.FALLBACK
    np.testing.assert_array_equal(guarded.u0, [-3.0, 0.0])
    assert [r.levelno for r in caplog.records] == [logging.ERROR]
    assert mpc.counts[Status.FALLBACK] == 1
    # Nothing of the broken plan is used again.
    assert mpc.nominal() is None
    assert np.isfinite(step(mpc).X).all()


def test_even_a_brake_that_is_broken_gives_an_input_within_its_bounds(monkeypatch):
    mpc = controller()
    plan = step(mpc)
    for wrong in (NAN, np.inf, -1e9):
        broken = replace(plan, U=np.full((N, 2), wrong))
        monkeypatch.setattr(mpc._solver, "solve_from", lambda *_, plan=broken, **__: plan)
        monkeypatch.setattr(mpc._solver, "brake", lambda *_, plan=broken: plan)
        assert (np.abs(step(mpc).U) <= 3.0).all()


# Settings


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"grow_after": -0.1}, "freshness.grow_after: -0.1"),
        ({"stop_after": NAN}, "freshness.stop_after"),
        ({"grow_after": 2.0}, "freshness.stop_after: 1.0 s is before"),
        ({"keep": -1}, "freshness.keep"),
        ({"growth": -0.1}, "freshness.growth"),
        ({"growth": "much"}, "freshness.growth"),
        ({"beyond": "pray"}, "'pray' is none of brake, refuse"),
        ({"beyond": []}, "freshness.beyond"),
        ({"stamps": None}, "None is none of optional, required"),
    ],
)
def test_bad_freshness_is_refused(values, message):
    with pytest.raises(InvalidArgumentError, match=message):
        Freshness(**values)
    with pytest.raises(InvalidArgumentError, match="freshness"):
        Settings(freshness=1.0)


def test_recalling_changes_nothing_before_it_is_committed():
    memory = ObstacleMemory(Freshness(), DT, 3)
    report = ObstaclePrediction(np.zeros((N + 1, 2)), np.eye(2), 0.2, stamp=1.0, name="a")
    recall = memory.recall(1.0, [report])
    assert memory.recall(0.0, []).obstacles == ()
    memory.commit(recall)
    assert [o.name for o in memory.recall(1.2, []).obstacles] == ["a"]
    with pytest.raises(StaleDataError):
        memory.recall(0.0, [])
