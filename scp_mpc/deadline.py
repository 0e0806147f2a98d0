"""Where the time of one control step goes, and whether what comes next still fits in."""

from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from math import inf
from time import perf_counter, thread_time

_FORGET = 0.02  # of the difference to a shorter time, each time it is measured
_EASE = 0.98  # of a time, each time that it stood in the way
_HICCUP = 3.0  # times what is known of a task, or its processor time: something else took it
_LEAST = 1e-6  # [s] of any task
_PATIENCE = 3  # times that a task is not begun before it is tried again, whatever is known
_MOST_PATIENCE = 200
_RESERVE = 0.1  # of the deadline, for what takes longer than ever before
_COUNTED = ("iteration", "candidate")  # tasks that solve a program

Timer = Callable[[], float]
Mark = tuple[float, float]  # seconds since the step began, and of its thread's processor time


class Pace:
    """How long tasks took lately: their longest times, slowly forgotten.

    One serves all steps of a controller, so that the first iteration of a step is predicted from
    those of earlier steps. A single time that is far longer than all before it, or than what the
    task worked in it, counts in full if it happens twice in a row. And what is known is tried
    again: a task that was not begun a few times for its length is begun, and if it is that long
    still, it is left alone for twice as many times.
    """

    def __init__(self) -> None:
        """Know nothing: everything is expected to take no time."""
        self._tasks: defaultdict[str, _Task] = defaultdict(_Task)

    def expected(self, task: str) -> float:
        """Predicted seconds."""
        known = self._tasks[task]
        return 0.0 if known.on_trial else known.seconds

    def learn(self, task: str, seconds: float, worked: float = inf) -> None:
        """Take note of a measured time, and of the processor time within it."""
        one = self._tasks[task]
        one.measured += 1
        if one.on_trial:
            one.on_trial = False
            if seconds > one.seconds / 2:
                one.patience = min(2 * one.patience, _MOST_PATIENCE)
            else:
                one.patience, one.seconds = _PATIENCE, 0.0
        usual = _HICCUP * one.seconds if one.seconds else inf
        twice, one.stalled = one.stalled, seconds > min(usual, _HICCUP * worked) + _LEAST
        if one.stalled and not twice:
            seconds = min(seconds, worked, usual)
        share = max(_FORGET, 1 / one.measured)
        one.seconds = max(seconds, one.seconds - share * (one.seconds - seconds))

    def refused(self, task: str, never: bool) -> None:
        """Note that a task was not begun; `never`, if by what is known no step has room for it."""
        one = self._tasks[task]
        one.seconds *= _EASE
        one.refused += never
        if one.refused >= one.patience:
            one.refused, one.on_trial = 0, True


@dataclass
class _Task:
    """What is known of a task.

    Attributes:
        seconds: Its longest time lately.
        measured: How often it was measured.
        stalled: Whether the last time was far longer than all before.
        refused: How often it was not begun, since it was tried last, for being too long.
        patience: How often it may be.
        on_trial: Whether it is to be begun, whatever is known.
    """

    seconds: float = 0.0
    measured: int = 0
    stalled: bool = False
    refused: int = 0
    patience: int = _PATIENCE
    on_trial: bool = False


class Clock:
    """The time of one control step, its deadline and its budget of programs.

    Args:
        deadline: Seconds after which the step is late, a tenth of which is kept free; None for
            never.
        pace: Times of earlier steps.
        programs: How many programs the step may solve or rank.
        timer: Tells the time [s]; None for the machine's clock.

    Attributes:
        spent: Seconds by what they were spent on: "linearise", "update" or "solve".
    """

    def __init__(
        self,
        deadline: float | None = None,
        pace: Pace | None = None,
        programs: float = inf,
        timer: Timer | None = None,
    ) -> None:
        """Begin the step."""
        self._deadline = inf if deadline is None else (1 - _RESERVE) * deadline
        self._pace, self._programs = Pace() if pace is None else pace, programs
        self._now, self._worked = (perf_counter, thread_time) if timer is None else (timer, timer)
        self.spent: defaultdict[str, float] = defaultdict(float)
        self._began = self._lap = self._now()
        self._booked = 0.0, 0.0  # seconds and processor time of tasks

    def elapsed(self) -> float:
        """Seconds since the step began."""
        return self._now() - self._began

    def mark(self) -> Mark:
        """Where time stands now, for `learn`."""
        return self.elapsed(), self._worked()

    def charge(self, what: str) -> None:
        """Book the time since it was last booked."""
        now = self._now()
        self.spent[what] += now - self._lap
        self._lap = now

    def allows(self, task: str) -> bool:
        """Whether a task, and what ends the step, are predicted to end before the deadline.

        And whether the budget has room for it, if it solves a program.
        """
        if task in _COUNTED and self._programs < 1:
            return False
        if self._deadline < inf:
            needed = self._pace.expected(task) + self._pace.expected("ending")
            if needed > self._deadline - self.elapsed():
                self._pace.refused(task, needed > self._deadline)
                return False
        self._programs -= task in _COUNTED
        return True

    def room(self, task: str, most: int, then: str = "", spare: int = 0) -> int:
        """How often, up to `most` times, a task fits in before another one, as predicted.

        Of the budget of programs, so many are to be spared.
        """
        if task in _COUNTED:
            most = int(max(min(self._programs - spare, most), 0))
        if self._deadline == inf:
            return most
        after = self._pace.expected(then) + self._pace.expected("ending")
        left = self._deadline - self.elapsed() - after
        times = min(most, int(max(left, 0.0) / max(self._pace.expected(task), _LEAST)))
        if times < most:
            self._pace.refused(task, after + self._pace.expected(task) > self._deadline)
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
