"""How fast to follow a path: limits, and the schedule that keeps them.

    v^2 <= top^2,  v^2 curvature <= lateral,  |dv/dt| <= longitudinal

The fastest such profile is found in two sweeps over the path, one forwards for what can be reached
by speeding up, one backwards for what can be braked from in time. v^2 is linear in s between two
grid points, so the acceleration there is constant and everything is in closed form.

Notation:
    s, v, a     progress [m], speed [m/s], acceleration [m/s^2]
    T           (n,) time at which a grid point is reached [s]
"""

from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import FloatArray, frozen
from scp_mpc.control.path import Path
from scp_mpc.settings import require_flags, require_positive

_SHARES = np.linspace(0.0, 1.0, 5)  # of a grid interval, where its curvature is looked at


@dataclass(frozen=True)
class SpeedLimits:
    """Limits of the speed along a path.

    Attributes:
        top: Greatest speed [m/s].
        lateral: Greatest acceleration across the path [m/s^2], which a curve asks for; a corner is
            taken at the speed at which that much turns the velocity within one interval. None: any.
        longitudinal: Greatest acceleration along the path [m/s^2], in both senses. None: any.
        stop: Come to rest at the end of an open path; needs `longitudinal`.
    """

    top: float
    lateral: float | None = None
    longitudinal: float | None = None
    stop: bool = True

    def __post_init__(self) -> None:
        """Check every number."""
        for name in ("top", "lateral", "longitudinal"):
            value = getattr(self, name)
            if name == "top" or value is not None:
                require_positive(f"speed.{name}", value)
        require_flags(self, "stop")


class Schedule:
    """The fastest profile within the limits, and where it is after a while.

    Initialisation: sweeps over the path.

    Usage: `advance` from any progress; beyond the end of an open path it stays there, at rest.

    Args:
        path: What is followed.
        limits: What is kept.
        dt: Sampling interval [s], for corners.
    """

    def __init__(self, path: Path, limits: SpeedLimits, dt: float) -> None:
        """Lay the grid and sweep."""
        self._path = path
        self.s = frozen(_grid(path, limits))
        self.v = frozen(np.sqrt(_swept(path, limits, self.s, dt)))
        way = np.diff(self.s)
        self.a = frozen(np.diff(self.v**2) / (2 * way))
        self.T = frozen(np.concatenate([[0.0], np.cumsum(2 * way / (self.v[:-1] + self.v[1:]))]))

    @property
    def fastest(self) -> float:
        """Greatest speed of the profile [m/s]."""
        return float(self.v.max())

    def speeds(self, s: FloatArray) -> FloatArray:
        """Speeds (...) at progress s (...) [m/s]."""
        wrapped = s % self._path.length if self._path.closed else s
        k = np.minimum(np.maximum(self.s.searchsorted(wrapped, "right") - 1, 0), len(self.a) - 1)
        v2 = self.v[k] ** 2 + 2 * self.a[k] * (wrapped - self.s[k])
        return np.asarray(np.sqrt(np.maximum(v2, 0.0)))

    def advance(self, s: float, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Progress and speeds (n,) at times (n,) [s], not negative, after progress s [m]."""
        path, laps = self._path, 0.0
        if path.closed:
            laps, s = divmod(s, path.length)
        k = min(int(self.s.searchsorted(s, "right")) - 1, len(self.a) - 1)
        there, v = s - self.s[k], float(self.speeds(np.asarray(s)))
        began = self.T[k] + (2 * there / (self.v[k] + v) if there > 0 else 0.0)
        T, end = began + times, self.T[-1]
        if path.closed:
            turns, T = np.divmod(T, end)
            start = (laps + turns) * path.length
        else:
            over = end <= T
            T, start = np.minimum(T, end), 0.0
        at = np.minimum(self.T.searchsorted(T, "right") - 1, len(self.a) - 1)
        tau, a, v0 = T - self.T[at], self.a[at], self.v[at]
        v = np.maximum(v0 + a * tau, 0.0)
        s_at = start + self.s[at] + (v0 + 0.5 * a * tau) * tau
        if not path.closed:
            over |= s_at >= path.length  # by rounding
            s_at[over], v[over] = path.length, 0.0
        return s_at, v


def _grid(path: Path, limits: SpeedLimits) -> FloatArray:
    """Knots, and points between them: many where a profile can change."""
    spacing = path.length
    if limits.longitudinal is not None:
        spacing = min(spacing / 200, limits.top**2 / limits.longitudinal / 50)
    elif limits.lateral is not None:
        spacing /= 200
    spacing = max(spacing, path.length / 20_000)
    cuts = np.ceil(np.diff(path.knots) / spacing).astype(int)
    parts = [
        np.linspace(begin, end, count, endpoint=False)
        for begin, end, count in zip(path.knots[:-1], path.knots[1:], cuts, strict=True)
    ]
    return np.append(np.concatenate(parts), path.length)


def _swept(path: Path, limits: SpeedLimits, s: FloatArray, dt: float) -> FloatArray:
    """Squared speeds (n,) at the grid points."""
    v2 = np.full(len(s), limits.top**2)
    if limits.lateral is not None:
        within = s[:-1, None] + np.diff(s)[:, None] * _SHARES
        within[:, -1] = np.nextafter(within[:, -1], 0.0)  # this side of a knot
        bend = path.curvatures(within).max(axis=1)
        limit = limits.lateral / np.maximum(bend, 1e-12)
        v2[:-1] = np.minimum(v2[:-1], limit)
        v2[1:] = np.minimum(v2[1:], limit)
        corners = s.searchsorted(path.knots)
        jump = 2 * np.sin(path.corners() / 2) / dt
        v2[corners] = np.minimum(v2[corners], (limits.lateral / np.maximum(jump, 1e-9)) ** 2)
    if path.closed:
        v2[[0, -1]] = v2[[0, -1]].min()
    if limits.longitudinal is None:
        return v2
    if limits.stop and not path.closed:
        v2[-1] = 0.0
    rise = 2 * limits.longitudinal * s
    if path.closed:  # what a lap ends with, the next begins with: the middle one of three
        count, lap = len(s) - 1, 2 * limits.longitudinal * path.length
        rise = np.concatenate([rise[:-1] - lap, rise[:-1], rise + lap])
        v2 = np.concatenate([v2[:-1], v2[:-1], v2])
    v2 = np.minimum.accumulate(v2 - rise) + rise
    v2 = np.minimum.accumulate((v2 + rise)[::-1])[::-1] - rise
    return np.maximum(v2[count : 2 * count + 1] if path.closed else v2, 0.0)
