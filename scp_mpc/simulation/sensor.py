"""Sensors: what the robot is told of its own state and of what is in its way."""

from typing import Protocol

import numpy as np

from scp_mpc.arrays import FloatArray, as_number
from scp_mpc.errors import BoundsError
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.settings import require_positive
from scp_mpc.simulation.scene import Scene
from scp_mpc.tracking.tracker import Tracker, TrackerSettings


class Sensor(Protocol):
    """What `simulate` asks at each control step."""

    def reset(self, scene: Scene, problem: Problem, rng: np.random.Generator) -> None:
        """Begin a new run."""
        ...

    def observe(
        self, time: float, x: FloatArray, positions: FloatArray
    ) -> tuple[FloatArray, list[ObstaclePrediction]]:
        """Return the measured state (nx,) and the predictions.

        Args:
            time: Now [s].
            x: (nx,) true state.
            positions: (M, d) of the bodies [m], NaN where absent.
        """
        ...


class PerfectSensor:
    """The true state, and what the scene itself tells."""

    def reset(self, scene: Scene, problem: Problem, rng: np.random.Generator) -> None:  # noqa: ARG002
        """Begin a new run."""
        self._scene, self._dt, self._horizon = scene, problem.model.dt, problem.horizon

    def observe(
        self,
        time: float,
        x: FloatArray,
        positions: FloatArray,  # noqa: ARG002
    ) -> tuple[FloatArray, list[ObstaclePrediction]]:
        """See `Sensor`."""
        return x, self._scene.predictions(time, self._dt, self._horizon)


class TrackedSensor:
    """Measures where the bodies are, with errors, misses and outages, and tracks them.

    Bodies with a shape are known from a map and do not move; they are told of first.

    Args:
        noise: Standard deviation of each measured coordinate, which the tracker knows [m].
        state_std: (nx,) standard deviations of the measured state; None for the true one.
        miss: Chance that somebody is missed in one scan.
        outage_rate: Outages of the whole sensor per second.
        outage_time: How long each of them lasts [s].
        tracking: Of the tracker.

    Raises:
        BoundsError: A number is negative, or a chance above one.
    """

    def __init__(
        self,
        *,
        noise: float = 0.05,
        state_std: FloatArray | None = None,
        miss: float = 0.0,
        outage_rate: float = 0.0,
        outage_time: float = 1.0,
        tracking: TrackerSettings | None = None,
    ) -> None:
        """Check the numbers."""
        require_positive("noise", noise)
        require_positive("outage_time", outage_time)
        if not 0 <= as_number("miss", miss) <= 1:
            raise BoundsError("miss", f"{miss} is not between 0 and 1")
        if as_number("outage_rate", outage_rate) < 0:
            raise BoundsError("outage_rate", f"{outage_rate} is negative")
        self._noise, self._state_std, self._miss = noise, state_std, miss
        self._outage_rate, self._outage_time = outage_rate, outage_time
        self._tracking = tracking

    def reset(self, scene: Scene, problem: Problem, rng: np.random.Generator) -> None:
        """Begin a new run."""
        self._problem, self._rng, self._blind_until = problem, rng, -np.inf
        dt, N = problem.model.dt, problem.horizon
        self._walls = [body.predicted(0.0, dt, N) for body in scene.bodies if body.shape]
        self._moving = np.array([body.shape is None for body in scene.bodies], dtype=np.bool_)
        radii = [body.radius for body in scene.bodies if body.shape is None]
        self._tracker = Tracker(
            dt,
            N,
            radius=max(radii, default=0.0),
            measurement_std=self._noise,
            settings=self._tracking,
        )

    def observe(
        self, time: float, x: FloatArray, positions: FloatArray
    ) -> tuple[FloatArray, list[ObstaclePrediction]]:
        """See `Sensor`."""
        rng, y = self._rng, x
        if self._state_std is not None:
            y = x + self._state_std * rng.standard_normal(len(x))
        if not self._moving.any():
            return y, self._walls
        who = np.flatnonzero(self._moving)
        where = positions[who]
        seen = ~np.isnan(where[:, 0]) & (rng.random(len(who)) >= self._miss)
        measured = where + self._noise * rng.standard_normal(where.shape)
        if time >= self._blind_until:
            if rng.random() < self._outage_rate * self._problem.model.dt:
                self._blind_until = time + self._outage_time
            else:
                self._tracker.update(time, measured[seen], who[seen].tolist())
        return y, [*self._walls, *self._tracker.predictions(time)]
