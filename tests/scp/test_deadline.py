"""Predicted times, and what is booked to whom; the clock is read through a fake."""

import pytest

from scp_mpc import deadline
from scp_mpc.deadline import Clock, Pace


@pytest.fixture
def time(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(deadline, "perf_counter", lambda: now[0])
    monkeypatch.setattr(deadline, "thread_time", lambda: now[0])
    return now


def test_tasks_within_a_task_are_not_counted_twice(time):
    pace = Pace()
    clock = Clock(1.0, pace)
    with clock.task("outer"):
        time[0] += 0.1
        with clock.task("inner"):
            time[0] += 0.2
        began = clock.mark()
        time[0] += 0.3
        clock.learn("bit", began, 3)
    assert pace.expected("outer") == pytest.approx(0.1)
    assert pace.expected("inner") == pytest.approx(0.2)
    assert pace.expected("bit") == pytest.approx(0.1)


def test_nothing_begins_that_would_end_late(time):
    pace = Pace()
    pace.learn("task", 0.4)
    pace.learn("ending", 0.1)
    clock = Clock(1.0, pace)
    assert clock.allows("task")
    assert clock.room("task", 9) == 2
    time[0] = 0.7
    assert not clock.allows("task")
    assert clock.room("task", 9) == 0
    assert Clock(None, pace).room("task", 9) == 9


def test_a_tenth_of_the_deadline_is_kept_free(time):
    pace = Pace()
    pace.learn("task", 0.05)
    clock = Clock(1.0, pace)
    time[0] = 0.84
    assert clock.allows("task")
    time[0] = 0.86
    assert not clock.allows("task")


def test_a_single_hiccup_is_not_the_tasks():
    """Seconds in which its thread did not work count from the second time in a row on."""
    pace = Pace()
    pace.learn("task", 0.3, 0.29)
    pace.learn("task", 5.0, 0.3)
    assert pace.expected("task") == pytest.approx(0.3)
    pace.learn("task", 0.25, 0.25)
    pace.learn("task", 5.0, 0.3)
    assert pace.expected("task") == pytest.approx(0.3)
    pace.learn("task", 4.0, 0.3)
    assert pace.expected("task") == 4.0


def test_work_far_longer_than_ever_is_believed_the_second_time():
    pace = Pace()
    pace.learn("task", 0.3, 0.3)
    pace.learn("task", 5.0, 4.9)
    assert pace.expected("task") == pytest.approx(0.9)
    pace.learn("task", 5.0, 4.9)
    assert pace.expected("task") == 5.0


def test_what_is_too_long_for_any_step_is_tried_again_and_believed():
    """A few refusals after one pause; a task that is short again is short from then on."""
    pace = Pace()
    pace.learn("task", 0.06)
    clock = Clock(0.01, pace)
    tries = 0
    while not clock.allows("task"):
        tries += 1
    assert tries <= 4
    pace.learn("task", 0.002)
    assert pace.expected("task") == pytest.approx(0.002)


def test_a_budget_of_programs_ends_the_search_without_a_deadline():
    clock = Clock(None, Pace(), programs=3)
    assert clock.room("candidate", 9) == 3
    assert [clock.room("candidate", 9, spare=spare) for spare in (1, 3, 5)] == [2, 0, 0]
    assert [clock.allows(task) for task in ("iteration", "backup", "candidate", "iteration")]
    assert not clock.allows("iteration")
    assert not clock.allows("candidate")
    assert clock.allows("backup")
    assert clock.room("candidate", 9) == 0


def test_a_timer_that_is_handed_in_is_the_clock(time):
    now = [7.0]
    clock = Clock(1.0, Pace(), timer=lambda: now[0])
    time[0] = 100.0
    assert clock.elapsed() == 0.0
    now[0] += 0.5
    assert clock.elapsed() == 0.5


@pytest.mark.usefixtures("time")
def test_what_took_too_long_is_begun_again_some_day():
    pace = Pace()
    pace.learn("task", 5.0)
    tries = 0
    while not Clock(1.0, pace).allows("task"):
        tries += 1
    assert 0 < tries < 100
