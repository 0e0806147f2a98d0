"""Where the time of one control step goes."""

from math import inf
from time import perf_counter
from types import TracebackType


class Lap:
    """Adds up the seconds spent inside `with` blocks."""

    __slots__ = ("_began", "seconds")

    def __init__(self) -> None:
        """Start at zero."""
        self.seconds = self._began = 0.0

    def __enter__(self) -> None:
        """Begin a lap."""
        self._began = perf_counter()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End it."""
        self.seconds += perf_counter() - self._began


class Stopwatch:
    """Laps of one control step, and its deadline.

    Args:
        deadline: Seconds after which the step is overdue; None for never.

    Attributes:
        linearising: Geometry of the obstacles.
        solving: Quadratic programs, their values included.
        inside: The part of `solving` spent in the QP solvers themselves.
    """

    def __init__(self, deadline: float | None = None) -> None:
        """Begin the step."""
        self._deadline = inf if deadline is None else deadline
        self.linearising, self.solving, self.inside = Lap(), Lap(), Lap()
        self._began = perf_counter()

    @property
    def elapsed(self) -> float:
        """Seconds since the step began."""
        return perf_counter() - self._began

    def overdue(self, share: float = 1.0) -> bool:
        """Whether that share of the time is gone."""
        return self.elapsed > share * self._deadline
