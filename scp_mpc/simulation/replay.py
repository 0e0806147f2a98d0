"""Replay: a robot among recorded people, who walk as they did and do not react to it.

It sees them at the recording's frames, with noise, and crosses the scene, there and back again, for
as long as the recording lasts. Time 0 of the run is the first frame.
"""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from scp_mpc.arrays import FloatArray, as_count
from scp_mpc.control.mpc import MPC
from scp_mpc.errors import BoundsError, InvalidArgumentError
from scp_mpc.geometry.margin import Containment, MarginSpec
from scp_mpc.models.double_integrator import DoubleIntegrator
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.settings import Settings, StalenessPolicy, require_positive
from scp_mpc.simulation.crossing import Crossing
from scp_mpc.simulation.recording import Recording, along
from scp_mpc.simulation.run import Run
from scp_mpc.simulation.scene import Body, Scene
from scp_mpc.simulation.simulate import simulate
from scp_mpc.simulation.there_and_back import ThereAndBack
from scp_mpc.tracking.tracker import Tracker, TrackerSettings

DT = 0.2  # [s]
_TICK = 1e-6  # [s]
_ABSENT = np.full(2, np.nan)


def recorded_people(recording: Recording, radius: float = 0.3) -> list[Body]:
    """Return everybody as a body of that radius [m], by name, absent where not recorded."""
    begin = recording.times[0]
    return [
        Body(partial(_place, times - begin, positions), radius, name=name)
        for name, (times, positions) in recording.paths.items()
    ]


def _place(times: FloatArray, positions: FloatArray, time: float) -> FloatArray:
    if not times[0] - 1 < time < times[-1] + 1:  # most people, most of the time: quickly
        return _ABSENT
    return along(times, positions, time)


class RecordedSensor:
    """Measures people at the recording's own frames, with noise, and tracks them.

    In frames that were left out nobody was seen: the tracker is told of nobody, not of nothing.
    The robot is told of all of them, and of its true state.

    Args:
        recording: Who walks where.
        noise: Standard deviation of each measured coordinate, which the tracker knows [m].
        tracking: Of the tracker.
    """

    def __init__(
        self, recording: Recording, noise: float = 0.05, tracking: TrackerSettings | None = None
    ) -> None:
        """Check the noise."""
        require_positive("noise", noise)
        self._noise, self._tracking = noise, tracking
        self._frames = list(_frames(recording))

    def reset(self, scene: Scene, problem: Problem, rng: np.random.Generator) -> None:
        """Begin a new run."""
        self._rng, self._frame = rng, 0
        self._tracker = Tracker(
            problem.model.dt,
            problem.horizon,
            radius=max(body.radius for body in scene.bodies),
            measurement_std=self._noise,
            settings=self._tracking,
        )

    def observe(
        self,
        time: float,
        x: FloatArray,
        positions: FloatArray,  # noqa: ARG002
    ) -> tuple[FloatArray, list[ObstaclePrediction]]:
        """See `Sensor`."""
        while self._frame < len(self._frames) and self._frames[self._frame][0] <= time + _TICK:
            when, names, where = self._frames[self._frame]
            measured = where + self._noise * self._rng.standard_normal(where.shape)
            self._tracker.update(when, measured, names)
            self._frame += 1
        return x, self._tracker.predictions(time)


def _frames(recording: Recording) -> Iterator[tuple[float, list[int], FloatArray]]:
    """Times from the first frame on [s], names and positions, with those where nobody was."""
    times = recording.times - recording.times[0]
    for k, (names, where) in enumerate(zip(recording.names, recording.positions, strict=True)):
        yield float(times[k]), names.tolist(), where
        gap = times[k + 1] - times[k] if k + 1 < len(times) else 0.0
        for n in range(1, round(gap / recording.interval) if recording.interval else 0):
            yield float(times[k] + n * recording.interval), [], np.zeros((0, 2))


def replay_problem(
    horizon: int = 15, margin: MarginSpec | None = None, max_obstacles: int = 20
) -> Problem:
    """A robot of 0.3 m at a walking pace, 95 % containment at each sample.

    The default horizon is 3 s, at which predictions of people have grown to a standard deviation of
    some 0.6 m.
    """
    return Problem(
        DoubleIntegrator(DT),
        horizon=horizon,
        Q=[0.2, 0.05, 0.2, 0.05],
        R=[0.02, 0.02],
        u_min=-3.0,
        u_max=3.0,
        robot_radius=0.3,
        margin=Containment(0.95) if margin is None else margin,
        max_obstacles=max_obstacles,
        nodes_per_interval=1,
    )


def replay(
    recording: Recording,
    crossing: Crossing | None = None,
    problem: Problem | None = None,
    *,
    noise: float = 0.05,
    seed: int = 0,
    radius: float = 0.3,
    steps: int | None = None,
    tracking: TrackerSettings | None = None,
    settings: Settings | None = None,
    advance: Callable[[], object] = lambda: None,
) -> Run:
    """Drive the robot through a recorded crowd.

    Args:
        recording: Who walks where.
        crossing: What the robot is to cross; along the main flow if None.
        problem: What to solve, for any planar robot; that of `replay_problem` if None.
        noise: Standard deviation of the measurements' errors, which the tracker knows [m].
        seed: Of the errors; the same one gives the same states.
        radius: Of each person [m].
        steps: Number of control steps K; as many as the recording has time for if None.
        tracking: How people are tracked.
        settings: How to solve the problem; without memory of obstacles, which the tracker has, if
            None.
        advance: Called after each step, for a progress bar.

    Raises:
        InvalidArgumentError: Or one of its subclasses.
    """
    recording.require_plausible()
    crossing = Crossing.through(recording, "along") if crossing is None else crossing
    problem = replay_problem() if problem is None else problem
    if settings is None:
        settings = Settings(staleness=StalenessPolicy(keep=0), deadline=None)
    if seed < 0:
        raise BoundsError("seed", f"{seed} is negative")
    people = recorded_people(recording, radius)
    return simulate(
        MPC(problem, settings),
        ThereAndBack(crossing, problem.model, problem.horizon, people),
        sensor=RecordedSensor(recording, noise, tracking),
        steps=control_steps(recording, steps, problem.model.dt),
        seed=seed,
        advance=advance,
    )


def control_steps(recording: Recording, steps: int | None = None, dt: float = DT) -> int:
    """How many control steps a replay has: those asked for, at most what the recording lasts.

    Raises:
        InvalidArgumentError: The recording is too short for one.
    """
    most = int((recording.times[-1] - recording.times[0]) / dt + _TICK)
    if most < 1:
        raise InvalidArgumentError("recording", f"lasts less than {dt} s")
    return most if steps is None else min(as_count("steps", steps), most)
