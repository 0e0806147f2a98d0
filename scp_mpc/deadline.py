"""Where the time of one control step goes, and whether what comes next still fits in."""

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from math import inf
from time import perf_counter

_FORGET = 0.02  # of the difference to a shorter time, each time it is measured
_LEAST = 1e-6  # [s] of any task
_EASE = 0.98  # of a time, each time that it stood in the way: or one hiccup would do so for ever


class Pace:
    """How long tasks took lately: their longest times, slowly forgotten.

    One serves all steps of a controller, so that the first iteration of a step is predicted from
    those of earlier steps.
    """

    def __init__(self) -> None:
        """Know nothing: everything is expected to take no time."""
        self._seconds: defaultdict[str, float] = defaultdict(float)

    def expected(self, task: str) -> float:
        """Predicted seconds."""
        return self._seconds[task]

    def learn(self, task: str, seconds: float) -> None:
        """Take note of a measured time."""
        known = self._seconds[task]
        self._seconds[task] = max(seconds, known - _FORGET * (known - seconds))

    def ease(self, task: str) -> None:
        """Expect a little less, after a task was not begun."""
        self._seconds[task] *= _EASE


class Clock:
    """The time of one control step, and its deadline.

    Args:
        deadline: Seconds after which the step is late; None for never.
        pace: Times of earlier steps.

    Attributes:
        spent: Seconds by what they were spent on: "linearise", "update" or "solve".
    """

    def __init__(self, deadline: float | None = None, pace: Pace | None = None) -> None:
        """Begin the step."""
        self._deadline = inf if deadline is None else deadline
        self._pace = Pace() if pace is None else pace
        self.spent: defaultdict[str, float] = defaultdict(float)
        self._began = self._lap = perf_counter()
        self._booked = 0.0  # [s] of tasks

    def elapsed(self) -> float:
        """Seconds since the step began."""
        return perf_counter() - self._began

    def charge(self, what: str) -> None:
        """Book the time since it was last booked."""
        now = perf_counter()
        self.spent[what] += now - self._lap
        self._lap = now

    def allows(self, task: str) -> bool:
        """Whether a task, and what ends the step, are predicted to end before the deadline."""
        if self._deadline == inf:
            return True
        needed = self._pace.expected(task) + self._pace.expected("ending")
        if needed <= self._deadline - self.elapsed():
            return True
        self._pace.ease(task)
        return False

    def room(self, task: str, most: int, then: str = "") -> int:
        """How often, up to `most` times, a task fits in before another one, as predicted."""
        if self._deadline == inf:
            return most
        after = self._pace.expected(then) + self._pace.expected("ending")
        spare = self._deadline - self.elapsed() - after
        times = min(most, int(max(spare, 0.0) / max(self._pace.expected(task), _LEAST)))
        if times < most:
            self._pace.ease(task)
        return times

    @contextmanager
    def task(self, name: str) -> Iterator[None]:
        """Measure what is done within it, less the tasks within."""
        began, booked = self.elapsed(), self._booked
        yield
        own = self.elapsed() - began - (self._booked - booked)
        self._booked += own
        self._pace.learn(name, own)

    def learn(self, task: str, since: float, times: int = 1) -> None:
        """Note that a task, done so many times, took from `since`, in seconds `elapsed`, on."""
        if times:
            seconds = self.elapsed() - since
            self._booked += seconds
            self._pace.learn(task, seconds / times)
