"""Where the time of one control step goes, and whether what comes next still fits in."""

from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from math import inf
from time import perf_counter

_FORGET = 0.02  # of the difference to a shorter time, each time it is measured
_EASE = 0.98  # of a time, each time that it stood in the way
_SPIKE = 3.0  # times what was known: perhaps a hiccup of the machine
_LEAST = 1e-6  # [s] of any task
_PATIENCE = 3  # times that a task is not begun before it is tried all the same; then twice as many
_MOST_PATIENCE = 48


class Pace:
    """How long tasks took lately: their longest times, slowly forgotten.

    One serves all steps of a controller, so that the first iteration of a step is predicted from
    those of earlier steps. A sudden long time is forgotten at once if the next one is as before. A
    task that seems too long is tried again after a while, for nothing is learnt about what is never
    begun; if it still is too long, after twice as long a while.
    """

    def __init__(self) -> None:
        """Know nothing: everything is expected to take no time."""
        self._seconds: defaultdict[str, float] = defaultdict(float)
        self._before: dict[str, float] = {}  # what was known before a sudden long time
        self._waited: defaultdict[str, int] = defaultdict(int)
        self._patience: defaultdict[str, int] = defaultdict(lambda: _PATIENCE)

    def expected(self, task: str) -> float:
        """Predicted seconds."""
        return self._seconds[task]

    def learn(self, task: str, seconds: float) -> None:
        """Take note of a measured time."""
        known, before = self._seconds[task], self._before.pop(task, None)
        tried = self._waited[task] > 0 or self._patience[task] > _PATIENCE
        self._waited[task] = 0
        if tried and seconds <= known / 2:  # it stood in the way for nothing
            self._seconds[task], self._patience[task] = seconds, _PATIENCE
        elif before is not None and _SPIKE * seconds < known:
            self._seconds[task] = max(before, seconds)
        else:
            if 0 < _SPIKE * known < seconds:
                self._before[task] = known
            self._seconds[task] = max(seconds, known - _FORGET * (known - seconds))

    def tries(self, task: str) -> bool:
        """Whether to begin a task that is expected to take too long, to see whether it does.

        Each time that it is not, a little less is expected: what is hardly too long is soon begun.
        """
        self._seconds[task] *= _EASE
        self._waited[task] += 1
        if self._waited[task] <= self._patience[task]:
            return False
        self._waited[task] = 0
        self._patience[task] = min(2 * self._patience[task], _MOST_PATIENCE)
        return True


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
        self._tried: set[str] = set()  # to be begun although they seem too long, and not begun yet

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
        needed, left = self._pace.expected(task), self._deadline - self.elapsed()
        if needed + self._pace.expected("ending") <= left:
            return True
        return left > 0 and self._tries(task)

    def room(self, task: str, most: int, then: str = "") -> int:
        """How often, up to `most` times, a task fits in before another one, as predicted."""
        if self._deadline == inf:
            return most
        after = self._pace.expected(then) + self._pace.expected("ending")
        spare = self._deadline - self.elapsed() - after
        times = min(most, int(max(spare, 0.0) / max(self._pace.expected(task), _LEAST)))
        return 1 if times == 0 and most > 0 and spare > 0 and self._tries(task) else times

    @contextmanager
    def task(self, name: str) -> Iterator[None]:
        """Measure what is done within it, less the tasks within."""
        began, booked = self.elapsed(), self._booked
        yield
        own = self.elapsed() - began - (self._booked - booked)
        self._booked += own
        self._tried.discard(name)
        self._pace.learn(name, own)

    def learn(self, task: str, since: float, times: int = 1) -> None:
        """Note that a task, done so many times, took from `since`, in seconds `elapsed`, on."""
        if times:
            seconds = self.elapsed() - since
            self._booked += seconds
            self._tried.discard(task)
            self._pace.learn(task, seconds / times)

    def _tries(self, task: str) -> bool:
        if task not in self._tried and self._pace.tries(task):
            self._tried.add(task)
        return task in self._tried
