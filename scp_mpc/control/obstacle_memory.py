"""What is known of the obstacles at a step: reports that are late, and obstacles not reported.

Nothing here changes before `commit`: a step that fails in between leaves no trace.
"""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from scp_mpc.arrays import as_number
from scp_mpc.errors import InvalidArgumentError, StaleDataError
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.obstacles.predictions import ObstaclePredictions, as_predictions
from scp_mpc.obstacles.propagation import propagated
from scp_mpc.settings import StalenessPolicy

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
            those given, as they are, where one of them is too old, or nothing is to be done.
        stale: Which one is too old to plan with; None if none is.
        reports: What to remember.
        timed: Whether this step or one before was given its time.
        newest: Latest stamp of this step, or of the last one that had any; None for none yet.
    """

    time: float
    obstacles: Sequence[ObstaclePrediction]
    stale: StaleDataError | None
    reports: Mapping[Hashable, Report]
    timed: bool
    newest: float | None


_NOTHING: Mapping[Hashable, Report] = {}


class ObstacleMemory:
    """Brings late predictions up to the present, and keeps named obstacles that vanish.

    An obstacle without a name cannot be told from another one, so it is not kept.

    Args:
        staleness: How old is too old, and how fast uncertainty grows.
        dt: Interval of the predictions and of steps without a given time [s].
    """

    def __init__(self, staleness: StalenessPolicy, dt: float) -> None:
        """Start with nothing known, at no time."""
        self._staleness = staleness
        self._dt = dt
        self.reset()

    def reset(self) -> None:
        """Forget every obstacle and the time."""
        self._time: float | None = None
        self._reports: Mapping[Hashable, Report] = _NOTHING
        self._timed = False
        self._newest: float | None = None

    def commit(self, recall: Recall) -> None:
        """Take over what a step has made of the reports, once it has succeeded."""
        self._time, self._reports = recall.time, recall.reports
        self._timed, self._newest = recall.timed, recall.newest

    def recall(self, time: float | None, obstacles: Iterable[ObstaclePrediction]) -> Recall:
        """Return what to plan with at this step; `commit` it afterwards.

        Args:
            time: Of this step [s]; None for one interval after the last step, or 0. Stamps then
                have to be of such a clock, and no step before may have been given its time.
            obstacles: This step's predictions.

        Raises:
            InvalidArgumentError: These are no predictions, or two have the same name.
            StaleDataError: `time` runs backwards, a stamp is in the future, one that is
                required is missing, or stamps are of another clock.
        """
        given = as_predictions(obstacles)
        required = self._staleness.stamps == "required"
        now = self._now(time, required)
        if isinstance(given, ObstaclePredictions):
            stamps = [] if given.stamp is None else [given.stamp]
            plain = given.stamp is None and given.names is None
        else:
            stamps = [o.stamp for o in given if o.stamp is not None]
            plain = all(o.stamp is None and o.name is None for o in given)
        newest = max(stamps, default=self._newest)
        if time is None and stamps:
            self._require_own_clock(now, max(stamps))
        clock = self._timed or time is not None, newest
        if plain and not self._reports and not (required and given):
            return Recall(now, given, None, _NOTHING, *clock)
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
            return Recall(now, given, stale, known, *clock)
        late = self._staleness.grow_after
        present = [self._as_of(now, o, s, late) for o, s in zip(given, since, strict=True)]
        absent = [self._as_of(now, report.prediction, report.since) for report in kept.values()]
        return Recall(now, (*present, *absent), None, known, *clock)

    def _now(self, time: float | None, required: bool) -> float:
        last = self._time
        if time is None:
            if required:
                raise StaleDataError("time", "missing, but staleness.stamps is 'required'")
            return 0.0 if last is None else last + self._dt
        now = as_number("time", time)
        if last is not None and now < last - _TICK:
            raise StaleDataError(
                "time", f"{now} s is before the last step's {last} s; reset() forgets that"
            )
        return now

    def _require_own_clock(self, now: float, newest: float) -> None:
        """Raise where stamps are given without a time, and are not of the clock that counts steps.

        The first ones may be old, and the same ones may be handed over again; new ones are of now.
        """
        if self._timed:
            raise StaleDataError(
                "time", f"missing, but a step before had one, and a stamp is {newest} s"
            )
        off, most = newest - now, self._staleness.grow_after + _TICK
        if newest != self._newest and (off > most or (off < -most and self._newest is not None)):
            raise StaleDataError(
                "time",
                f"missing, and a stamp of {newest} s is {off:+g} s off the clock that counts steps "
                f"of {self._dt:g} s, {now:g} s: tell each step its time",
            )

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

    def _as_of(
        self, now: float, prediction: ObstaclePrediction, since: float, late: float = 0.0
    ) -> ObstaclePrediction:
        """The prediction at the present: moved on if it is older than `late` seconds, or back."""
        age = now - since
        if age < -_TICK:
            rows = np.arange(prediction.horizon + 1) + age / self._dt
            return prediction.with_rows(*prediction.interpolated(rows), now)
        if age <= late + _TICK:
            return prediction
        return propagated(prediction, age, self._dt, self._staleness.growth)

    def _stale(
        self, given: Sequence[ObstaclePrediction], since: list[float], now: float
    ) -> StaleDataError | None:
        limit = self._staleness.stop_after
        j = min(range(len(given)), key=since.__getitem__, default=None)
        if j is None or now - since[j] <= limit + _TICK:
            return None
        return StaleDataError(
            f"obstacles[{j}].stamp",
            f"{since[j]} s is {now - since[j]:g} s old, beyond stop_after = {limit:g} s",
        )


def _require_distinct(given: Sequence[ObstaclePrediction], names: int) -> None:
    """Raise for the first name that is given twice."""
    named = [(j, o.name) for j, o in enumerate(given) if o.name is not None]
    if len(named) == names:
        return
    seen: set[Hashable] = set()
    for j, name in named:
        if name in seen:
            raise InvalidArgumentError(f"obstacles[{j}].name", f"{name!r} is given twice")
        seen.add(name)
