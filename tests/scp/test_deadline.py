"""Predicted times, and what is booked to whom; the clock is read through a fake."""

import numpy as np
import pytest

from scp_mpc import deadline
from scp_mpc.deadline import Clock, Pace


@pytest.fixture
def time(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(deadline, "perf_counter", lambda: now[0])
    return now


def test_tasks_within_a_task_are_not_counted_twice(time):
    pace = Pace()
    clock = Clock(1.0, pace)
    with clock.task("outer"):
        time[0] += 0.1
        with clock.task("inner"):
            time[0] += 0.2
        began = clock.elapsed()
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


def test_a_single_hiccup_is_believed_until_it_has_passed():
    pace = Pace()
    for seconds in (0.2, 0.3, 5.0):
        pace.learn("task", seconds)
    assert pace.expected("task") == 5.0
    pace.learn("task", 0.25)
    assert pace.expected("task") == 0.3
    pace.learn("task", 5.0)
    pace.learn("task", 4.0)  # it was none
    assert pace.expected("task") > 4.9


@pytest.mark.usefixtures("time")
@pytest.mark.parametrize("hiccups", [1, 2, 5])
def test_hiccups_stand_in_the_way_of_a_few_steps_only(hiccups):
    pace = Pace()
    for _ in range(hiccups):
        pace.learn("task", 5.0)
    tries = 1
    while not Clock(1.0, pace).allows("task"):
        tries += 1
    assert tries <= 5
    pace.learn("task", 0.5)
    assert pace.expected("task") == 0.5
    assert Clock(1.0, pace).allows("task")


@pytest.mark.usefixtures("time")
def test_what_is_always_too_long_is_tried_ever_more_seldom():
    pace, begun = Pace(), []
    pace.learn("task", 5.0)
    for k in range(1000):
        if Clock(1.0, pace).allows("task"):
            begun.append(k)
            pace.learn("task", 5.0)
    assert np.diff(begun).max() < 60
    assert len(begun) < 30
