"""Where the time of one control step goes, and whether what comes next still fits in."""

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from math import inf
from time import perf_counter, thread_time

_FORGET = 0.02  # of the difference to a shorter time, each time it is measured
_EASE = 0.98  # of a time, each time that it stood in the way
_HICCUP = 3.0  # times its own processor time: then most of a task's time was somebody else's
_LEAST = 1e-6  # [s] of any task

Mark = tuple[float, float]  # seconds since the step began, and of its thread's processor time


class Pace:
    """How long tasks took lately: their longest times, slowly forgotten.

    One serves all steps of a controller, so that the first iteration of a step is predicted from
    those of earlier steps. A single time in which the machine did something else is no time of the
    task's; it counts if it happens twice in a row.
    """

    def __init__(self) -> None:
        """Know nothing: everything is expected to take no time."""
        self._seconds: defaultdict[str, float] = defaultdict(float)
        self._stalled: set[str] = set()

    def expected(self, task: str) -> float:
        """Predicted seconds."""
        return self._seconds[task]

    def learn(self, task: str, seconds: float, worked: float = inf) -> None:
        """Take note of a measured time, and of the processor time within it."""
        if seconds > _HICCUP * worked + _LEAST:
            again = task in self._stalled
            self._stalled.add(task)
            seconds = seconds if again else worked
        else:
            self._stalled.discard(task)
        known = self._seconds[task]
        self._seconds[task] = max(seconds, known - _FORGET * (known - seconds))

    def ease(self, task: str) -> None:
        """Expect a little less, after a task was not begun: or it would never be again."""
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
        self._booked = 0.0, 0.0  # seconds and processor time of tasks

    def elapsed(self) -> float:
        """Seconds since the step began."""
        return perf_counter() - self._began

    def mark(self) -> Mark:
        """Where time stands now, for `learn`."""
        return self.elapsed(), thread_time()

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
        began, booked = self.mark(), self._booked
        yield
        now = self.mark()
        own = [now[i] - began[i] - (self._booked[i] - booked[i]) for i in (0, 1)]
        self._booked = self._booked[0] + own[0], self._booked[1] + own[1]
        self._pace.learn(name, *own)

    def learn(self, task: str, since: Mark, times: int = 1) -> None:
        """Note that a task, done so many times, took from `since` on until now."""
        if times:
            now = self.mark()
            own = now[0] - since[0], now[1] - since[1]
            self._booked = self._booked[0] + own[0], self._booked[1] + own[1]
            self._pace.learn(task, own[0] / times, own[1] / times)
