"""Coverage: how often people are where a tracker said that they would be.

At each annotated frame the tracker is given what is seen, with noise, and predicts who was measured
twice at least: from a first sighting nobody knows where people go. An ellipse that is to hold a
share q of the future positions is counted against where they went:

    e' Sigma^-1 e <= -2 log(1 - q)      (the chi-square quantile with two degrees of freedom)

Samples of one person overlap and err together, so a share's standard error is that of a ratio
of sums over people: with h_k of n_k samples inside for person k, c = sum h / sum n,

    se^2 = sum_k (h_k - c n_k)^2 / (sum_k n_k)^2.

Notation:
    e       (2,)        true less predicted position [m]
    Sigma   (2, 2)      predicted covariance [m^2]
    NEES    mean of e' Sigma^-1 e, which is 2 where the covariances are right
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from scp_mpc.arrays import FloatArray, IntArray, as_number
from scp_mpc.errors import BoundsError, InvalidArgumentError
from scp_mpc.settings import require_positive
from scp_mpc.simulation.recording import Recording, along
from scp_mpc.tracking.kalman import mahalanobis
from scp_mpc.tracking.tracker import Tracker, TrackerSettings

LEVELS = (0.5, 0.9, 0.95)
_LONGEST = 4.8  # [s]


@dataclass(frozen=True)
class LeadCoverage:
    """What happened so many seconds after a prediction.

    Attributes:
        lead: The seconds.
        samples: How often somebody was still there to compare with.
        people: How many they were.
        mean_error: Mean distance from the predicted position [m].
        rms_error: Its root mean square [m].
        rms_predicted: What the covariances say it is [m].
        nees: Mean of e' Sigma^-1 e; 2 is right.
        shares: Share of samples within the ellipse of each level.
        errors: Standard error of each share.
    """

    lead: float
    samples: int
    people: int
    mean_error: float
    rms_error: float
    rms_predicted: float
    nees: float
    shares: tuple[float, ...]
    errors: tuple[float, ...]


@dataclass(frozen=True)
class Coverage:
    """Coverage of a whole recording.

    Attributes:
        people: How many there are in the recording.
        frames: How many annotated frames.
        interval: Time between them [s].
        noise: Standard deviation of what was added to each coordinate [m].
        seed: Of that noise.
        levels: Shares that the ellipses are to hold.
        leads: One row for each lead time.
    """

    people: int
    frames: int
    interval: float
    noise: float
    seed: int
    levels: tuple[float, ...]
    leads: tuple[LeadCoverage, ...]


def measure_coverage(
    recording: Recording,
    *,
    noise: float = 0.05,
    seed: int = 0,
    longest: float = _LONGEST,
    levels: tuple[float, ...] = LEVELS,
    settings: TrackerSettings | None = None,
    advance: Callable[[], object] = lambda: None,
) -> Coverage:
    """Run a tracker through a recording and count.

    Args:
        recording: What is taken for the truth.
        noise: Standard deviation of the measurements' errors, which the tracker knows [m].
        seed: Of the errors.
        longest: Lead times go up to this, in steps of the recording's interval [s].
        levels: Shares that ellipses are to hold.
        settings: Of the tracker.
        advance: Called after each frame, for a progress bar.

    Raises:
        InvalidArgumentError: Or a subclass: a bad number, or nothing to compare with.
    """
    require_positive("noise", noise)
    if seed < 0:
        raise BoundsError("seed", f"{seed} is negative")
    for level in levels:
        if not 0 < as_number("levels", level) < 1:
            raise BoundsError("levels", f"{level} is not between 0 and 1")
    recording.require_plausible()
    dt, rng = recording.interval, np.random.default_rng(seed)
    horizon = int(as_number("longest", longest) / dt + 1e-6) if dt else 0
    if horizon < 1:
        raise InvalidArgumentError("recording", f"no two frames within {longest} s")
    settings = TrackerSettings() if settings is None else settings
    settings = replace(settings, confirmations=max(settings.confirmations, 2))
    tracker = Tracker(dt, horizon, radius=0.0, measurement_std=noise, settings=settings)
    ahead = dt * np.arange(1, horizon + 1)
    whose, errors, covariances = [], [], []
    for time, names, where in zip(
        recording.times, recording.names, recording.positions, strict=True
    ):
        measured = where + noise * rng.standard_normal(where.shape)
        tracker.update(time, measured, names.tolist())
        told = {prediction.name: prediction for prediction in tracker.predictions()}
        for name in (name for name in names.tolist() if name in told):
            truth = along(*recording.paths[name], time + ahead)
            whose.append(name)
            errors.append(truth - told[name].means[1:])
            covariances.append(told[name].covariances[1:])
        advance()
    e, Sigma = np.array(errors), np.array(covariances)
    if not e.size or np.isnan(e[:, 0]).all():
        raise InvalidArgumentError("recording", "nobody is seen long enough to be predicted")
    rows = [
        _lead(ahead[i], np.array(whose, np.intp), e[:, i], Sigma[:, i], levels)
        for i in range(horizon)
        if not np.isnan(e[:, i]).all()
    ]
    return Coverage(
        people=len(recording.paths),
        frames=len(recording.times),
        interval=dt,
        noise=float(noise),
        seed=seed,
        levels=levels,
        leads=tuple(rows),
    )


def _lead(
    lead: float, whose: IntArray, e: FloatArray, Sigma: FloatArray, levels: tuple[float, ...]
) -> LeadCoverage:
    there = ~np.isnan(e[:, 0])
    e, Sigma = e[there], Sigma[there]
    people, person = np.unique(whose[there], return_inverse=True)
    square, _ = mahalanobis(e, Sigma)
    n = np.bincount(person)
    shares, deviations = [], []
    for level in levels:
        inside = square <= -2 * np.log1p(-level)
        share = inside.mean()
        h = np.bincount(person, weights=inside)
        shares.append(float(share))
        deviations.append(float(np.linalg.norm(h - share * n) / n.sum()))
    distance = np.linalg.norm(e, axis=1)
    return LeadCoverage(
        lead=float(lead),
        samples=len(e),
        people=len(people),
        mean_error=float(distance.mean()),
        rms_error=float(np.sqrt(np.mean(distance**2))),
        rms_predicted=float(np.sqrt(np.trace(Sigma, axis1=1, axis2=2).mean())),
        nees=float(square.mean()),
        shares=tuple(shares),
        errors=tuple(deviations),
    )
