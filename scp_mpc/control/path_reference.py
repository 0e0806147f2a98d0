"""References from a path: where the robot is to be along it, from where it is now.

Notation:
    s       progress along the path [m]
    N       horizon; i = 0 .. N
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import SampledArray, as_array, as_count, as_number
from scp_mpc.control.path import Path
from scp_mpc.control.speed import Schedule, SpeedLimits
from scp_mpc.errors import BoundsError, InvalidArgumentError, ShapeError
from scp_mpc.settings import require_positive

_INTERVALS = 4.0  # at top speed, in which progress may be made from one call to the next
_CREEP = 1e-9  # [m/s] speed at which a robot with a nose still knows where to point it


class PathReference:
    """Follows a path: no time table, the reference starts where the robot is.

    The robot's position is projected onto the path, near its last progress, so that a path may
    cross itself or run back beside itself; from there the reference advances at the scheduled
    speed. A robot that is held up finds its reference waiting.

    Args:
        path: What to follow.
        speed: Speed [m/s], or `SpeedLimits`.
        model: The robot; its `state` makes states of positions and velocities, its `dt` is the
            interval. Where it names the index of a `heading`, the reference's angles are those
            nearest to the robot's.
        horizon: N.
        reach: How far progress may be made from one call to the next [m]; four intervals at top
            speed if None. Less than the length of the smallest loop.
        retreat: How far progress may go back from one call to the next [m].
        tolerance: Distance from the end at which an open path is finished [m].

    Raises:
        InvalidArgumentError: Or a subclass: the path's dimension is not the robot's, a number is
            not positive.
    """

    def __init__(
        self,
        path: Path,
        *,
        speed: float | SpeedLimits,
        model: Any,
        horizon: int,
        reach: float | None = None,
        retreat: float = 0.0,
        tolerance: float = 0.1,
    ) -> None:
        """Check everything and lay out the schedule."""
        if not isinstance(path, Path):
            raise InvalidArgumentError("path", f"{path!r} is not a Path")
        if not callable(getattr(model, "state", None)):
            raise InvalidArgumentError("model", f"{model!r} has no state(position, velocity)")
        if path.dim != model.dim:
            raise ShapeError("path", f"is in {path.dim}-D, the robot in {model.dim}-D")
        if not isinstance(speed, SpeedLimits):
            require_positive("speed", speed)
            speed = SpeedLimits(top=float(speed))
        if as_number("retreat", retreat) < 0:
            raise BoundsError("retreat", f"{retreat} m is negative")
        require_positive("tolerance", tolerance)
        self.path, self._model = path, model
        self._times = model.dt * np.arange(as_count("horizon", horizon) + 1)
        self.schedule = Schedule(path, speed, model.dt)
        if reach is None:
            reach = _INTERVALS * model.dt * self.schedule.fastest
        require_positive("reach", reach)
        self._reach, self._retreat, self._tolerance = float(reach), float(retreat), float(tolerance)
        self.reset()

    @property
    def progress(self) -> float:
        """Arc length from the beginning [m]; counts on over laps; 0 before the first call."""
        return 0.0 if self._progress is None else self._progress

    @property
    def finished(self) -> bool:
        """Whether an open path is done; a closed one never is."""
        left = self.path.length - self.progress
        return not self.path.closed and self._progress is not None and left <= self._tolerance

    def reset(self) -> None:
        """Forget the progress: the next call looks at all of the path."""
        self._progress: float | None = None

    def states(self, x0: ArrayLike) -> SampledArray:
        """Reference states (N+1, nx) for a robot in state x0 (nx,), which know their interval.

        Raises:
            InvalidArgumentError: Or a subclass: not a state. Progress is then as before.
        """
        model, last = self._model, self._progress
        x = as_array("x0", x0, (model.nx,))
        window = None if last is None else (last - self._retreat, last + self._reach)
        s = self.path.project(x[model.position], window)
        ahead, v = self.schedule.advance(s, self._times)
        position, tangent = self.path.derivatives(ahead, 2)
        heading = getattr(model, "heading", None)
        if heading is not None:
            v = np.maximum(v, _CREEP)
        x_ref = model.state(position, v[:, None] * tangent)
        if heading is not None:
            turns = np.round((x[heading] - x_ref[0, heading]) / (2 * np.pi))
            x_ref[:, heading] += 2 * np.pi * turns
        self._progress = s
        return SampledArray.of(x_ref, model.dt)
