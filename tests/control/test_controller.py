"""The controller's own promises: no trace of bad calls, counts, threads, and a last look at u0."""

import logging
from dataclasses import replace
from threading import Event, Thread

import numpy as np
import pytest
from driving import N, drive, good, same
from instances import DT, obstacle, problem, straight_reference
from watching import NAN, controller, seen, state, step

from scp_mpc import (
    MPC,
    BoundsError,
    ConcurrentUseError,
    InvalidArgumentError,
    NotFiniteError,
    ObstaclePrediction,
    Settings,
    ShapeError,
    StaleDataError,
    StalenessPolicy,
    Status,
)
from scp_mpc.control.obstacle_memory import ObstacleMemory

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
    (
        {"obstacles": [seen(stamp=1.8e9)], "time": 10.2},
        StaleDataError,
        "ahead of this step's time 10.2 s",
    ),
    ({"obstacles": [seen(stamp=10.2)]}, StaleDataError, "time: missing, but a step before"),
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
    report = seen(stamp=10.0)
    for _ in range(2):
        step(mpc, report, time=10.0)
        assert mpc.obstacles == (report,)
    step(mpc, seen(stamp=10.25), time=10.0)
    np.testing.assert_allclose(mpc.obstacles[0].means[0], report.means[0] - [0.25 * 0.3, 0.0])


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
        ({"grow_after": -0.1}, "staleness.grow_after: -0.1"),
        ({"stop_after": NAN}, "staleness.stop_after"),
        ({"grow_after": 2.0}, "staleness.stop_after: 1.0 s is before"),
        ({"keep": -1}, "staleness.keep"),
        ({"growth": -0.1}, "staleness.growth"),
        ({"growth": "much"}, "staleness.growth"),
        ({"beyond": "pray"}, "'pray' is none of brake, refuse"),
        ({"beyond": []}, "staleness.beyond"),
        ({"stamps": None}, "None is none of optional, required"),
    ],
)
def test_bad_freshness_is_refused(values, message):
    with pytest.raises(InvalidArgumentError, match=message):
        StalenessPolicy(**values)
    with pytest.raises(InvalidArgumentError, match="staleness"):
        Settings(staleness=1.0)


def test_recalling_changes_nothing_before_it_is_committed():
    memory = ObstacleMemory(StalenessPolicy(), DT)
    report = ObstaclePrediction(np.zeros((N + 1, 2)), np.eye(2), 0.2, stamp=1.0, name="a")
    recall = memory.recall(1.0, [report])
    assert memory.recall(0.0, []).obstacles == ()
    memory.commit(recall)
    assert [o.name for o in memory.recall(1.2, []).obstacles] == ["a"]
    with pytest.raises(StaleDataError):
        memory.recall(0.0, [])
