"""Replay: a robot among recorded people, who walk as they did and do not react to it.

At each control step: measure (at the recording's frames, with noise), predict, solve, apply. The
robot crosses the scene, there and back again, for as long as the recording lasts.
"""

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from scp_mpc.arrays import FloatArray, as_count
from scp_mpc.control.mpc import MPC
from scp_mpc.errors import BoundsError, InvalidArgumentError
from scp_mpc.geometry.margin import Containment, MarginSpec
from scp_mpc.models.double_integrator import DoubleIntegrator
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.scp.plan import Status
from scp_mpc.settings import Settings, StalenessPolicy, require_positive
from scp_mpc.simulation.crossing import Crossing
from scp_mpc.simulation.recording import Recording, along
from scp_mpc.tracking.tracker import Tracker, TrackerSettings

DT = 0.2  # [s]
TRACKING = TrackerSettings(
    confirmations=1
)  # with names nothing is a false alarm: tell of it at once
REACHED = 0.3  # [m] from the goal
_TICK = 1e-6  # [s]


@dataclass(frozen=True)
class Pass:
    """One way from start to goal, control steps [first, last).

    Attributes:
        crossing: From where to where.
        first: Step at which it begins.
        last: Step at which the goal is reached, or the recording ends.
        reached: Whether the goal was reached.
    """

    crossing: Crossing
    first: int
    last: int
    reached: bool


@dataclass(frozen=True, eq=False)
class Replay:
    """A finished replay, K control steps long.

    Attributes:
        recording: Who walked where.
        problem: What was solved at each step.
        noise: Standard deviation of the measurements' errors [m].
        seed: Of these errors.
        radius: Of each person [m].
        times: (K+1,) [s], on the recording's clock.
        states: (K+1, nx) of the robot.
        inputs: (K, nu) applied.
        plans: (K, N+1, 2) planned positions [m].
        predictions: K lists: what the controller was told.
        slack: (K,) largest slack of each plan [m].
        statuses: K of them.
        seconds: (K,) wall time of each call of `MPC.step`.
        tracking: (K,) wall time of measuring and predicting before it.
        passes: In order; the last one may be unfinished.
        alone: Seconds that one pass takes with nobody there.
    """

    recording: Recording
    problem: Problem
    noise: float
    seed: int
    radius: float
    times: FloatArray
    states: FloatArray
    inputs: FloatArray
    plans: FloatArray
    predictions: list[list[ObstaclePrediction]]
    slack: FloatArray
    statuses: list[Status]
    seconds: FloatArray
    tracking: FloatArray
    passes: list[Pass]
    alone: float

    @property
    def steps(self) -> int:
        """Number of control steps K."""
        return len(self.inputs)

    @property
    def positions(self) -> FloatArray:
        """(K+1, 2) of the robot [m]."""
        return self.states[:, self.problem.model.position]

    @property
    def speeds(self) -> FloatArray:
        """(K+1,) of the robot [m/s]."""
        return np.linalg.norm(self.states[:, self.problem.model.position + 1], axis=1)

    def people(self) -> dict[int, FloatArray]:
        """Positions (K+1, 2) of everybody at the control steps [m], NaN where not present."""
        return {name: along(*path, self.times) for name, path in self.recording.paths.items()}


def replay_problem(
    horizon: int = 15, margin: MarginSpec | None = None, max_obstacles: int = 20
) -> Problem:
    """A robot of 0.3 m at a walking pace, 95 % containment at each sample.

    The default horizon is 3 s: over a recorded street, plans of 2 s touched more people and took
    longer to the goal, those of 6 s took several times as long to compute and were no quicker. No
    horizon froze the robot: predictions grow to a standard deviation of 0.6 m at 3 s and 1.1 m at
    4.8 s, but what closes the way that late is seen to be open long before the robot is there.
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
    tracker_settings: TrackerSettings | None = None,
    settings: Settings | None = None,
    advance: Callable[[], object] = lambda: None,
) -> Replay:
    """Drive the robot through a recorded crowd.

    Args:
        recording: Who walks where.
        crossing: What the robot is to cross; along the main flow if None.
        problem: What to solve; that of `replay_problem` if None. A planar `DoubleIntegrator`.
        noise: Standard deviation of the measurements' errors, which the tracker knows [m].
        seed: Of the errors; the same one gives the same states.
        radius: Of each person [m].
        steps: Number of control steps K; as many as the recording has time for if None.
        tracker_settings: How people are tracked; by default, told of from the first measurement.
        settings: How to solve the problem; without memory of obstacles, which the tracker has, if
            None.
        advance: Called after each step, for a progress bar.

    Raises:
        InvalidArgumentError: Or one of its subclasses.
    """
    crossing = Crossing.through(recording, "along") if crossing is None else crossing
    problem = replay_problem() if problem is None else problem
    model = problem.model
    if not isinstance(model, DoubleIntegrator) or model.dim != 2:
        raise InvalidArgumentError("problem", "not of a planar DoubleIntegrator")
    require_positive("noise", noise)
    if seed < 0:
        raise BoundsError("seed", f"{seed} is negative")
    K, dt = control_steps(recording, steps, model.dt), model.dt
    mpc = MPC(
        problem, Settings(staleness=StalenessPolicy(keep=0)) if settings is None else settings
    )
    tracker = Tracker(
        dt,
        problem.horizon,
        radius=radius,
        measurement_std=noise,
        settings=TRACKING if tracker_settings is None else tracker_settings,
    )
    course = _Course(crossing, model, problem.horizon)
    alone = _alone(crossing, MPC(problem, mpc.settings))
    rng = np.random.default_rng(seed)
    times = recording.times[0] + dt * np.arange(K + 1)
    states, frame = [model.state(crossing.start, np.zeros(2))], 0
    inputs, plans, told, slack, statuses, seconds, tracking = [], [], [], [], [], [], []
    for k in range(K):
        began = perf_counter()
        while frame < len(recording.times) and recording.times[frame] <= times[k] + _TICK:
            where = recording.positions[frame]
            measured = where + noise * rng.standard_normal(where.shape)
            tracker.update(recording.times[frame], measured, recording.names[frame].tolist())
            frame += 1
        near = _nearest(tracker.predictions(times[k]), states[-1][model.position], problem)
        known = perf_counter()
        plan = mpc.step(states[-1], course.reference(states[-1]), near, time=times[k])
        seconds.append(perf_counter() - known)
        tracking.append(known - began)
        states.append(model.step(states[-1], plan.u0))
        inputs.append(plan.u0)
        plans.append(plan.X[:, model.position])
        told.append(near)
        slack.append(plan.slack.max(initial=0.0))
        statuses.append(plan.status)
        course.advance(states[-1], k + 1)
        advance()
    return Replay(
        recording=recording,
        problem=problem,
        noise=float(noise),
        seed=seed,
        radius=float(radius),
        times=times,
        states=np.array(states),
        inputs=np.array(inputs),
        plans=np.array(plans),
        predictions=told,
        slack=np.array(slack),
        statuses=statuses,
        seconds=np.array(seconds),
        tracking=np.array(tracking),
        passes=course.finish(K),
        alone=alone,
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


class _Course:
    """The passes, there and back again."""

    def __init__(self, crossing: Crossing, model: DoubleIntegrator, horizon: int) -> None:
        self._now, self._model, self._horizon = crossing, model, horizon
        self._first = 0
        self._passes: list[Pass] = []

    def reference(self, x: FloatArray) -> FloatArray:
        """States (N+1, nx) to track from x on."""
        at = x[self._model.position]
        return self._model.state(*self._now.reference(at, self._horizon, self._model.dt))

    def advance(self, x: FloatArray, step: int) -> bool:
        """Turn round if the goal is reached."""
        there = np.linalg.norm(x[self._model.position] - self._now.goal) <= REACHED
        if there:
            self._passes.append(Pass(self._now, self._first, step, reached=True))
            self._now, self._first = self._now.reversed(), step
        return bool(there)

    def finish(self, steps: int) -> list[Pass]:
        """All passes; the last one may be unfinished."""
        if self._first < steps:
            self._passes.append(Pass(self._now, self._first, steps, reached=False))
        return self._passes


def _nearest(
    predictions: list[ObstaclePrediction], position: FloatArray, problem: Problem
) -> list[ObstaclePrediction]:
    """As many as there are slots for, the nearest ones now."""
    distances = [float(np.linalg.norm(o.means[0] - position)) for o in predictions]
    return [predictions[j] for j in np.argsort(distances)[: problem.max_obstacles]]


def _alone(crossing: Crossing, mpc: MPC) -> float:
    """Seconds that one pass takes with nobody there."""
    model = mpc.problem.model
    assert isinstance(model, DoubleIntegrator)
    course = _Course(crossing, model, mpc.problem.horizon)
    x, most = model.state(crossing.start, np.zeros(2)), 100 + int(10 * crossing.length / model.dt)
    for k in range(most):
        x = model.step(x, mpc.step(x, course.reference(x)).u0)
        if course.advance(x, k + 1):
            return (k + 1) * model.dt
    raise InvalidArgumentError("problem", "its robot does not reach the goal with nobody there")
