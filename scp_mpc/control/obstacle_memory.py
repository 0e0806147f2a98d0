"""What is known of the obstacles at a step: reports that are late, and obstacles not reported.

Nothing here changes before `commit`: a step that fails in between leaves no trace.
"""

import logging
from collections.abc import Hashable, Iterable, Mapping
from types import MappingProxyType
from typing import NamedTuple

from scp_mpc.arrays import as_number
from scp_mpc.errors import InvalidArgumentError, StaleDataError
from scp_mpc.obstacles.prediction import ObstaclePrediction, as_predictions
from scp_mpc.obstacles.propagation import propagated
from scp_mpc.settings import StalenessPolicy

_log = logging.getLogger(__name__)

_TICK = 1e-6  # [s]; sums of intervals and differences of large times are no more exact than that


class Report(NamedTuple):
    """The last that was heard of a named obstacle.

    Attributes:
        prediction: As it was reported.
        since: Time of its row 0 [s].
        heard: Time of the step that reported it [s].
    """

    prediction: ObstaclePrediction
    since: float
    heard: float


class Recall(NamedTuple):
    """What to plan with at one step.

    Attributes:
        time: Of this step [s].
        obstacles: The predictions as of now: those given, in their order, then those kept. Just
            those given, as they are, where one of them is too old.
        stale: Which one is too old to plan with; None if none is.
        reports: What to remember.
    """

    time: float
    obstacles: tuple[ObstaclePrediction, ...]
    stale: StaleDataError | None
    reports: Mapping[Hashable, Report]


_NOTHING: Mapping[Hashable, Report] = MappingProxyType({})


class ObstacleMemory:
    """Brings late predictions up to the present, and keeps named obstacles that vanish.

    An obstacle without a name cannot be told from another one, so it is not kept.

    Args:
        staleness: How old is too old, and how fast uncertainty grows.
        dt: Interval of the predictions and of steps without a given time [s].
        slots: Most obstacles that a step can be planned with.
    """

    def __init__(self, staleness: StalenessPolicy, dt: float, slots: int) -> None:
        """Start with nothing known, at no time."""
        self._staleness = staleness
        self._dt = dt
        self._slots = slots
        self.reset()

    def reset(self) -> None:
        """Forget every obstacle and the time."""
        self._time: float | None = None
        self._reports: Mapping[Hashable, Report] = _NOTHING

    def commit(self, recall: Recall) -> None:
        """Take over what a step has made of the reports, once it has succeeded."""
        self._time, self._reports = recall.time, recall.reports

    def recall(self, time: float | None, obstacles: Iterable[ObstaclePrediction]) -> Recall:
        """Return what to plan with at this step; `commit` it afterwards.

        Args:
            time: Of this step [s]; None for one interval after the last step, or 0.
            obstacles: This step's predictions.

        Raises:
            InvalidArgumentError: These are no predictions, or two have the same name.
            StaleDataError: `time` runs backwards, a stamp is in the future, or one that is
                required is missing.
        """
        given = as_predictions(obstacles)
        required = self._staleness.stamps == "required"
        now = self._now(time, required)
        plain = all(o.stamp is None and o.name is None for o in given)
        if plain and not self._reports and not (required and given):
            return Recall(now, given, None, _NOTHING)
        since = [self._since(j, o, now, required) for j, o in enumerate(given)]
        reports = {
            o.name: Report(o, s, now)
            for o, s in zip(given, since, strict=True)
            if o.name is not None
        }
        _require_distinct(given, len(reports))
        kept = self._kept(now, reports)
        known = kept | reports
        stale = self._stale(given, since, now)
        if stale is not None:
            return Recall(now, given, stale, known)
        late = self._staleness.grow_after
        present = [self._as_of(now, o, s, late) for o, s in zip(given, since, strict=True)]
        absent = [
            self._as_of(now, report.prediction, report.since)
            for report in self._latest(kept, room=self._slots - len(given))
        ]
        return Recall(now, (*present, *absent), None, known)

    def _now(self, time: float | None, required: bool) -> float:
        last = self._time
        if time is None:
            if required:
                raise StaleDataError("time", "missing, but staleness.stamps is 'required'")
            return 0.0 if last is None else last + self._dt
        now = as_number("time", time)
        if last is not None and now < last - _TICK:
            raise StaleDataError("time", f"{now} s is before the last step's {last} s")
        return now

    def _since(self, j: int, obstacle: ObstaclePrediction, now: float, required: bool) -> float:
        """Time of row 0."""
        stamp = obstacle.stamp
        if stamp is None:
            if required:
                raise StaleDataError(
                    f"obstacles[{j}].stamp", "missing, but staleness.stamps is 'required'"
                )
            return now
        if stamp - now > self._staleness.grow_after + self._dt + _TICK:
            raise StaleDataError(
                f"obstacles[{j}].stamp",
                f"{stamp} s is {stamp - now:g} s ahead of this step's time {now} s",
            )
        return stamp

    def _kept(self, now: float, reports: Mapping[Hashable, Report]) -> dict[Hashable, Report]:
        """Named obstacles that were not reported now, but not long ago."""
        oldest = now - self._staleness.keep - _TICK
        return {
            name: report
            for name, report in self._reports.items()
            if name not in reports and report.heard >= oldest
        }

    def _latest(self, kept: Mapping[Hashable, Report], room: int) -> list[Report]:
        """As many as there is room for: those heard of last."""
        if len(kept) <= room:
            return list(kept.values())
        room = max(room, 0)
        _log.warning(
            "%d vanished obstacles are to be kept, but max_obstacles = %d leaves room for %d: "
            "the oldest are left out",
            *(len(kept), self._slots, room),
        )
        return sorted(kept.values(), key=lambda r: (r.heard, r.since), reverse=True)[:room]

    def _as_of(
        self, now: float, prediction: ObstaclePrediction, since: float, late: float = 0.0
    ) -> ObstaclePrediction:
        """The prediction moved on to the present, unless it is younger than `late` seconds."""
        if now - since <= late + _TICK:
            return prediction
        return propagated(prediction, now - since, self._dt, self._staleness.growth)

    def _stale(
        self, given: tuple[ObstaclePrediction, ...], since: list[float], now: float
    ) -> StaleDataError | None:
        limit = self._staleness.stop_after
        j = min(range(len(given)), key=since.__getitem__, default=None)
        if j is None or now - since[j] <= limit + _TICK:
            return None
        return StaleDataError(
            f"obstacles[{j}].stamp",
            f"{since[j]} s is {now - since[j]:g} s old, beyond stop_after = {limit:g} s",
        )


def _require_distinct(given: tuple[ObstaclePrediction, ...], names: int) -> None:
    """Raise for the first name that is given twice."""
    named = [(j, o.name) for j, o in enumerate(given) if o.name is not None]
    if len(named) == names:
        return
    seen: set[Hashable] = set()
    for j, name in named:
        if name in seen:
            raise InvalidArgumentError(f"obstacles[{j}].name", f"{name!r} is given twice")
        seen.add(name)
