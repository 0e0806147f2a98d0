"""A tracker: measured positions, noisy and at any times, become predictions for the controller.

Every motion's Kalman filter runs for every track, in one stack; see `imm.py` and `prediction.py`.
Nothing changes before the last line of an update: one that raises leaves no trace.
"""

from collections.abc import Hashable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaincinv

from scp_mpc.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    as_array,
    as_count,
    as_number,
    require_positive_semidefinite,
)
from scp_mpc.errors import (
    BoundsError,
    CovarianceError,
    InvalidArgumentError,
    ShapeError,
    StaleDataError,
)
from scp_mpc.obstacles.prediction import ObstaclePrediction, unchecked_predictions
from scp_mpc.settings import require_positive
from scp_mpc.tracking.association import associate
from scp_mpc.tracking.imm import Beliefs, MotionBank
from scp_mpc.tracking.kalman import Gaussians
from scp_mpc.tracking.motion import Motion
from scp_mpc.tracking.prediction import HorizonPredictor

_TICK = 1e-9  # [s]
_LONGEST = 60.0  # [s] for which a silent sensor's tracks are moved on: then nothing is known

WALKING = (Motion(density=0.007), Motion(density=0.11, weight=0.2))
WALKING_AND_TURNING = (
    *WALKING,
    Motion(density=0.007, turn_rate=0.35, weight=0.03),
    Motion(density=0.007, turn_rate=-0.35, weight=0.03),
)


@dataclass(frozen=True)
class TrackerSettings:
    """How a tracker works.

    The default motions are for people who walk: straight on most of the time, and now and then
    restless. Densities, weights and dwell time have the largest likelihood of what a recorded
    street scene (148 people, 5.8 at a time) did 0.4 to 4.8 s ahead, seen each 0.4 s with errors of
    5 cm. Fitted to its first half, they lose 0.02 nats per sample on the second against those
    fitted to all of it. Against one constant velocity they gain 0.09; turns,
    `WALKING_AND_TURNING`, gain another 0.01 and are left out.

    People have heavier tails than any Gaussian: over that scene, ellipses for 50, 90 and 95 % hold
    54 to 67, 88 to 91 and 93 %, so that what is beyond 95 % is 7 % rather than 5.
    `std_inflation` widens them: at 1.2 those for 95 % hold 96 to 97 %, and those for
    50 % hold 66 to 76.

    Attributes:
        motions: The ways in which an obstacle may move; at least one. For turns at a rate that is
            not known, several rates: their probabilities are estimated.
        dwell_time: Mean time [s] after which the motion is drawn anew, by the motions' weights.
        speed: Standard deviation [m/s] of each component of the velocity of which nothing is
            known yet: a first sighting says nothing about it, and is predicted as wide as that.
        confirmations: Measurements after which a track is told of. Above 1, somebody seen for the
            first time is a free road: only for sensors with so many false alarms that a robot
            could not move among them.
        keep: Seconds without a measurement after which a track ends; longer than the sensor's usual
            outages, or all tracks begin anew after each, knowing nothing of velocities.
        keep_new: The same for a track that was measured only once, which may be a false alarm: with
            one of these per second within 5 m of a robot's way, 10 m take it 13 to 17 s, not 8;
            with 1.5 s here, 24 s or for ever.
        silence: Seconds without any update after which the sensor is taken to be silent: see
            `Tracker.healthy`. What it does not see from then on ends no track.
        gate: Probability that the right measurement is near enough to its track to be taken for
            it; where measurements have no names.
        std_inflation: Factor on the standard deviations of all predictions: for obstacles that are
            less predictable than the motions say, or for more of the tails.
        room: What everybody is given beyond their radius [m]. A plan leaves no more room than a
            prediction asks for; who starts to walk at 1.25 m/s^2 has gone 10 cm before two scans
            at 5 Hz can tell, and would be grazed at full speed.
    """

    motions: tuple[Motion, ...] = WALKING
    dwell_time: float = 1.3
    speed: float = 1.0
    confirmations: int = 1
    keep: float = 1.5
    keep_new: float = 0.5
    silence: float = 1.0
    gate: float = 0.999
    std_inflation: float = 1.0
    room: float = 0.1

    def __post_init__(self) -> None:
        """Check every setting."""
        if not isinstance(self.motions, tuple) or not self.motions:
            raise InvalidArgumentError("motions", f"{self.motions!r} is no tuple of Motions")
        for k, motion in enumerate(self.motions):
            if not isinstance(motion, Motion):
                raise InvalidArgumentError(f"motions[{k}]", f"{motion!r} is not a Motion")
        for name in ("dwell_time", "speed", "std_inflation", "silence"):
            require_positive(name, getattr(self, name))
        as_count("confirmations", self.confirmations)
        for name in ("keep", "keep_new", "room"):
            if as_number(name, getattr(self, name)) < 0:
                raise BoundsError(name, f"{getattr(self, name)} is negative")
        if not 0 < as_number("gate", self.gate) < 1:
            raise BoundsError("gate", f"{self.gate} is not between 0 and 1")

    def gate_at(self, dim: int) -> float:
        """Largest squared Mahalanobis distance within the gate: a chi-square quantile."""
        return float(2 * gammaincinv(dim / 2, self.gate))


class _Tracks(NamedTuple):
    """All tracks at one time: names, beliefs, number of measurements, time of the last [s]."""

    names: tuple[Hashable, ...]
    beliefs: Beliefs
    hits: IntArray
    seen: FloatArray

    def at(self, index: IntArray) -> "_Tracks":
        if len(index) == len(self.names):  # ascending: these are all
            return self
        names = tuple(self.names[i] for i in index)
        return _Tracks(names, self.beliefs.at(index), self.hits[index], self.seen[index])

    def joined(self, others: "_Tracks") -> "_Tracks":
        if not others.names:
            return self
        return _Tracks(
            self.names + others.names,
            self.beliefs.joined(others.beliefs),
            np.concatenate([self.hits, others.hits]),
            np.concatenate([self.seen, others.seen]),
        )


class Tracker:
    """Follows any number of obstacles and predicts each as a Gaussian along the horizon.

    Measurements may come at any times, as long as these increase, and any of them may be missing.
    With names, identities are known; without, measurements are paired with tracks (see
    `association`), and what is left begins new ones, which are called 0, 1, 2, ...

    A track that is not measured goes on by itself for `settings.keep` seconds. So the controller
    need not keep vanished obstacles as well: `Settings(staleness=StalenessPolicy(keep=0))`.
    A sensor that sees nobody says so by an update with no positions; one that says nothing is
    silent: tracks go on growing then, for as long as it takes, and `healthy` is false.

    Args:
        dt: Interval of the predictions [s], the robot's.
        horizon: N, number of their intervals.
        radius: Of each obstacle [m]; that of predictions is larger by `settings.room`.
        measurement_std: Standard deviation of each coordinate of a measurement [m].
        dim: Dimension of the workspace, 2 or 3.
        settings: How obstacles move, and when tracks begin and end.

    Raises:
        InvalidArgumentError: Or one of its subclasses, with the argument and the number.
    """

    def __init__(
        self,
        dt: float,
        horizon: int,
        *,
        radius: float,
        measurement_std: float,
        dim: int = 2,
        settings: TrackerSettings | None = None,
    ) -> None:
        """Set up the matrices; there is no track yet."""
        require_positive("dt", dt)
        require_positive("measurement_std", measurement_std)
        if as_number("radius", radius) < 0:
            raise BoundsError("radius", f"{radius} m is negative")
        if isinstance(dim, float) or dim not in (2, 3):
            raise InvalidArgumentError("dim", f"{dim!r} is neither 2 nor 3")
        self.settings = TrackerSettings() if settings is None else settings
        if not isinstance(self.settings, TrackerSettings):
            raise InvalidArgumentError("settings", f"{settings!r} is not a TrackerSettings")
        self._noise = float(measurement_std) ** 2 * np.eye(dim)
        self._dt, self._dim = float(dt), dim
        self._radius = float(radius) + self.settings.room
        self._gate = self.settings.gate_at(dim)
        self._bank = MotionBank(self.settings.motions, self.settings.dwell_time, dim)
        self._prediction = HorizonPredictor(self._bank, as_count("horizon", horizon), self._dt)
        self.reset()

    def reset(self) -> None:
        """Forget all tracks and the time."""
        d = self._dim
        self._tracks = self._begun((), np.zeros((0, d)), np.zeros((0, d, d)), 0.0)
        self._time: float | None = None
        self._named: bool | None = None
        self._born = 0

    @property
    def time(self) -> float | None:
        """Time of the last update [s]; None before the first."""
        return self._time

    @property
    def names(self) -> tuple[Hashable, ...]:
        """Names of all tracks as of the last update, the unconfirmed ones among them."""
        return self._tracks.names

    def healthy(self, time: float) -> bool:
        """Whether the last update is at most `settings.silence` seconds old at a time [s].

        False before the first one, too. Predictions of a silent sensor know of nobody new and grow
        without end: a robot should brake, see `SCP.brake`, rather than plan with them.
        """
        now = as_number("time", time)
        return self._time is not None and now - self._time <= self.settings.silence + _TICK

    def estimates(self) -> Gaussians:
        """States [p, v] as of the last update, in the order of `names`: (n, 2 d), (n, 2 d, 2 d)."""
        return self._tracks.beliefs.moments()

    def update(
        self,
        time: float,
        positions: ArrayLike,
        names: Iterable[Hashable] | None = None,
        covariances: ArrayLike | None = None,
    ) -> tuple[Hashable, ...]:
        """Take in all that was measured at one time; return the name of each one's track.

        Args:
            time: Of the measurements [s], after that of the last update.
            positions: (n, d) [m]; none is possible, too: `[]`.
            names: Who they are, n different ones; None where that is not known.
            covariances: (n, d, d) or (d, d) of their errors [m^2], positive definite;
                `measurement_std` squared if None.

        Raises:
            StaleDataError: `time` is not after the last update's.
            NotFiniteError: NaN or infinity. A missing measurement is left out, not NaN.
            InvalidArgumentError: A name is given twice, or names are given now and not before.
        """
        now = self._later(time)
        z = as_array("positions", positions, (-1, self._dim), (0,)).reshape(-1, self._dim)
        R = self._errors(covariances, len(z))
        given = None if names is None else _distinct(names, len(z))
        if self._named is not None and self._named != (given is not None):
            before, after = ("with", "without") if self._named else ("without", "with")
            raise InvalidArgumentError("names", f"measurements came {before} names, now {after}")
        tracks = self._moved(now)
        old, new = self._pairs(tracks, z, R, given)
        taken = np.zeros(len(z), np.bool_)
        taken[new] = True
        fresh = np.flatnonzero(~taken)
        if given is None:
            called: tuple[Hashable, ...] = tuple(range(self._born, self._born + len(fresh)))
        else:
            called = tuple(given[k] for k in fresh)
        later = self._corrected(tracks, old, z[new], R[new], now)
        later = later.joined(self._begun(called, z[fresh], R[fresh], now))
        later = later.at(np.flatnonzero(self._lasting(later, now)))
        self._time, self._named, self._tracks = now, given is not None, later
        self._born += len(fresh)
        whose = dict(zip(new, (tracks.names[i] for i in old), strict=True))
        whose |= dict(zip(fresh, called, strict=True))
        return tuple(whose[k] for k in range(len(z)))

    def predictions(self, time: float | None = None) -> list[ObstaclePrediction]:
        """Return what is predicted of each confirmed track, stamped and named.

        Row 0 is at `time`, with all that is known by then: tracks that were not measured of late
        are moved on, and less certain for it, until they end. An empty list before the first
        update says nothing: see `healthy`.

        Args:
            time: Of row 0 [s]; that of the last update if None.

        Raises:
            StaleDataError: `time` is before the last update's.
        """
        now = self._time if time is None else as_number("time", time)
        if self._time is None or now is None:
            return []
        if now < self._time - _TICK:
            raise StaleDataError("time", f"{now} s is before the last update's {self._time} s")
        tracks = self._moved(max(now, self._time))
        tracks = tracks.at(np.flatnonzero(tracks.hits >= self.settings.confirmations))
        means, Sigma = self._prediction.positions(tracks.beliefs)
        Sigma *= self.settings.std_inflation**2
        return unchecked_predictions(means, Sigma, self._radius, now, tracks.names, self._dt)

    def _later(self, time: float) -> float:
        now = as_number("time", time)
        if self._time is not None and now <= self._time + _TICK:
            raise StaleDataError("time", f"{now} s is not after the last update's {self._time} s")
        return now

    def _errors(self, covariances: ArrayLike | None, count: int) -> FloatArray:
        """Covariances (n, d, d) of the measurements' errors."""
        if covariances is None:
            return np.broadcast_to(self._noise, (count, *self._noise.shape))
        d = self._dim
        R = as_array("covariances", covariances, (count, d, d), (d, d))
        variances = require_positive_semidefinite("covariances", R.reshape(-1, d, d))
        if variances.size and variances.min() <= 0:
            raise CovarianceError("covariances", "a measurement without error: singular")
        return np.broadcast_to(R, (count, d, d))

    def _moved(self, now: float) -> _Tracks:
        """The tracks that have not ended by then, moved on without measurements.

        Whoever the last update saw was not missed since, and nobody is by a silent sensor.
        """
        last, tracks = self._time, self._tracks
        if last is None or now == last or not tracks.names:
            return tracks
        lasting = self._lasting(tracks, min(now, last + self.settings.silence))
        tracks = tracks.at(np.flatnonzero(lasting | (tracks.seen == last)))
        age = min(now - last, _LONGEST)
        return tracks._replace(beliefs=self._bank.predict(tracks.beliefs, age))

    def _lasting(self, tracks: _Tracks, now: float) -> BoolArray:
        """Which tracks were measured lately enough."""
        keep = np.where(tracks.hits > 1, self.settings.keep, self.settings.keep_new)
        return np.asarray(now - tracks.seen <= keep + _TICK)

    def _pairs(
        self, tracks: _Tracks, z: FloatArray, R: FloatArray, given: tuple[Hashable, ...] | None
    ) -> tuple[IntArray, IntArray]:
        """Indices of tracks and of the measurements that belong to them."""
        if given is None:
            return associate(tracks.beliefs.moments(), z, R, self._gate)
        places = {name: i for i, name in enumerate(tracks.names)}
        new = np.array([k for k, name in enumerate(given) if name in places], np.intp)
        return np.array([places[given[k]] for k in new], np.intp), new

    def _corrected(
        self, tracks: _Tracks, old: IntArray, z: FloatArray, R: FloatArray, now: float
    ) -> _Tracks:
        """The tracks after measurements (n, d) of those that `old` tells."""
        if not len(old):
            return tracks
        beliefs = tracks.beliefs.replaced(old, self._bank.correct(tracks.beliefs.at(old), z, R))
        hits, seen = tracks.hits.copy(), tracks.seen.copy()
        hits[old] += 1
        seen[old] = now
        return _Tracks(tracks.names, beliefs, hits, seen)

    def _begun(
        self, names: tuple[Hashable, ...], z: FloatArray, R: FloatArray, now: float
    ) -> _Tracks:
        """New tracks from one measurement each."""
        beliefs = self._bank.begin(z, R, self.settings.speed)
        return _Tracks(names, beliefs, np.ones(len(z), np.intp), np.full(len(z), now))


def _distinct(names: Iterable[Hashable], count: int) -> tuple[Hashable, ...]:
    """The names as a tuple, of which each is hashable and given once."""
    if isinstance(names, str | bytes) or not isinstance(names, Iterable):
        raise InvalidArgumentError("names", f"{names!r} is not a list of names")
    given = tuple(names)
    if len(given) != count:
        raise ShapeError("names", f"{len(given)} for {count} measurements")
    seen: set[Hashable] = set()
    for k, name in enumerate(given):
        if name is None or not isinstance(name, Hashable):
            raise InvalidArgumentError(f"names[{k}]", f"{name!r} cannot be a name")
        if name in seen:
            raise InvalidArgumentError(f"names[{k}]", f"{name!r} is given twice")
        seen.add(name)
    return given
