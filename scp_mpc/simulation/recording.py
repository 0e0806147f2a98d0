"""A recorded crowd: who was where, and when."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scp_mpc.arrays import FloatArray, IntArray, frozen
from scp_mpc.errors import InvalidArgumentError

_TICK = 1e-6  # [s]; sums of intervals are no more exact than that
_FASTEST, _SLOWEST = 22.0, 0.01  # [m/s] that the upper quartile, and nearly all speeds, are within


@dataclass(frozen=True, eq=False)
class Recording:
    """Positions of people in the plane at F annotated times.

    Attributes:
        times: (F,) ascending [s]; frames in which nobody is seen are left out.
        names: F arrays (n_f,) of whole numbers: who is seen in each frame.
        positions: F arrays (n_f, 2): where, in the same order [m].
    """

    times: FloatArray
    names: tuple[IntArray, ...]
    positions: tuple[FloatArray, ...]

    @classmethod
    def from_rows(cls, times: FloatArray, names: IntArray, positions: FloatArray) -> "Recording":
        """Gather rows (n,), (n,), (n, 2) of any order into frames.

        Raises:
            InvalidArgumentError: There is none, or somebody is in two places at once.
        """
        if not len(times):
            raise InvalidArgumentError("times", "an empty recording")
        order = np.lexsort((names, times))
        t, who, p = times[order], names[order], positions[order]
        twice = np.flatnonzero((np.diff(t) == 0) & (np.diff(who) == 0))
        if len(twice):
            at = twice[0]
            raise InvalidArgumentError("names", f"{who[at]} is given twice at {t[at]:g} s")
        frames, first = np.unique(t, return_index=True)
        who.setflags(write=False)
        frozen(p)
        return cls(frozen(frames), tuple(np.split(who, first[1:])), tuple(np.split(p, first[1:])))

    @cached_property
    def interval(self) -> float:
        """Usual time from one annotated frame to the next [s]; 0 if there is but one."""
        steps, counts = np.unique(np.round(np.diff(self.times), 9), return_counts=True)
        return float(steps[counts.argmax()]) if len(steps) else 0.0

    @cached_property
    def paths(self) -> dict[int, tuple[FloatArray, FloatArray]]:
        """Times (n,) [s] and positions (n, 2) [m] of each person, by name."""
        counts = [len(who) for who in self.names]
        t, who = np.repeat(self.times, counts), np.concatenate(self.names)
        p = np.concatenate(self.positions)
        order = np.argsort(who, kind="stable")
        people, first = np.unique(who[order], return_index=True)
        t, p = frozen(t[order]), frozen(p[order])
        pieces = zip(np.split(t, first[1:]), np.split(p, first[1:]), strict=True)
        return {int(name): piece for name, piece in zip(people, pieces, strict=True)}

    def require_plausible(self) -> None:
        """Check that people move as fast as people, or vehicles among them, at most.

        Raises:
            InvalidArgumentError: A quarter of all speeds from one annotation to the next is beyond
                22 m/s, or nearly all are below 0.01 m/s and not zero: other units than metres, or
                another rate. It names the speed.
        """
        ways = [
            (np.diff(t), np.linalg.norm(np.diff(p, axis=0), axis=1)) for t, p in self.paths.values()
        ]
        speeds = np.concatenate([way / time for time, way in ways])
        if not speeds.size:
            return
        high, most = np.quantile(speeds, [0.75, 0.95])
        if high > _FASTEST:
            raise InvalidArgumentError(
                "recording",
                f"a quarter of the speeds is beyond {high:.3g} m/s: positions in metres? rate?",
            )
        if 0 < most < _SLOWEST:
            raise InvalidArgumentError(
                "recording", f"nobody is faster than {most:.2g} m/s: positions in metres? rate?"
            )


def along(times: FloatArray, positions: FloatArray, wanted: FloatArray | float) -> FloatArray:
    """Return positions (..., d) of one person at the wanted times (...), NaN where not present.

    Everybody is present from the first to the last annotation, and walks straight from one to the
    next at constant speed.
    """
    gone = (wanted < times[0] - _TICK) | (wanted > times[-1] + _TICK)
    where = np.stack([np.interp(wanted, times, axis) for axis in positions.T], axis=-1)
    where[gone] = np.nan
    return where
