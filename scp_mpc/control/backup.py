"""The backup of a plan: its inputs, or a head of them, then braking to rest.

A plan is checked up to its horizon only: it may end at speed, right in front of something. So the
way to rest from its end is checked, too, against the predictions carried on beyond their last row:

    mean        goes on at the velocity of the last interval
    covariance  goes on growing in the directions in which it grew last, and never shrinks

A plan whose own way to rest is not clear is followed as long as the robot can still brake after a
head of it, its first input at least. Where that is not clear either, and an earlier plan's backup
is, the robot follows that one: if its model is exact and the world does what was predicted, it
stays clear, stage by stage, so that a plan that is ok is followed by one that is (the safety filter
of Wabersich and Zeilinger, 2018, with braking for the terminal set). What comes near a robot at
rest is not its doing.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.scp.braking import AT_REST, braking
from scp_mpc.scp.fallback import Fallback
from scp_mpc.scp.nodes import Nodes
from scp_mpc.scp.step import Step
from scp_mpc.trajectory import rollout

_SECONDS = 4.0  # of braking that are looked at, at least
_SPEEDS = 2.0 ** np.arange(-3, 5)  # [m/s] from which braking is tried out
_FADED = 0.15  # [m/s] that is rest where braking fades out and does not end within that time
_RESERVE = 1.5  # of way and time of braking over those straight on


class Backup:
    """Looks for ways to rest.

    Args:
        problem: What they are judged by.
        tolerance: Violation that is none [m].

    Attributes:
        always: Whether bounds of states ask for one without any obstacle, too.
    """

    def __init__(self, problem: Problem, tolerance: float) -> None:
        """Lay out the nodes of the time after a plan."""
        self._planned = problem.horizon
        stages = max(problem.horizon, int(np.ceil(_SECONDS / problem.model.dt)))
        self._problem, self._tolerance = replace(problem, horizon=stages), tolerance
        # Limited rates carry states on beyond their bounds, and let braking swing.
        self._swings = problem.limits_rates and problem.limits_states
        self._nodes = Nodes.of(self._problem)
        self._fallback = Fallback(self._problem, tolerance)
        start, table = np.zeros(problem.model.dim), [(0.0, 0.0, 0.0)]
        for speed in _SPEEDS:
            x = problem.model.state(start, speed * np.eye(len(start))[0])
            stop, states = self.stopping(x)
            path = states[:, problem.model.position]
            if not (np.isfinite(path).all() and self._rests(path, len(stop))):
                break
            length = float(np.linalg.norm(path - path[0], axis=1).max())
            table.append((speed, length, len(stop) * problem.model.dt))
        self._speeds, *self._braking = np.array(table).T  # way [m] and time [s] over speeds [m/s]
        self._body = problem.robot_radius + float(np.abs(problem.discs).max())
        at = problem.model.position
        self._room = problem.x_min[at], problem.x_max[at]
        self.always = self._swings or bool(np.isfinite(self._room).any())

    def of(
        self, states: FloatArray, inputs: FloatArray, obstacles: Sequence[ObstaclePrediction]
    ) -> FloatArray | None:
        """Inputs (k, nu) from the next step on, after which the robot can brake; None for none.

        Args:
            states: (N+1, nx) of the plan.
            inputs: (N, nu) of the plan.
            obstacles: Predictions, row 0 now.
        """
        if self._is_far(states[-2:, self._problem.model.position], obstacles):
            return inputs[1:]
        whole = len(inputs)
        for stage in dict.fromkeys((whole, whole // 2 or 1, whole // 4 or 1, 1)):
            stop, path = self.stopping(states[stage], inputs[stage - 1])
            if self.is_clear(path, stop, obstacles, stage):
                return inputs[1:stage]
        return None

    def stopping(
        self, x: FloatArray, last: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Inputs (k, nu) to rest from x after the last input, and states (k+1, nx)."""
        return braking(self._problem, x, last)

    def continued(
        self,
        x: FloatArray,
        inputs: FloatArray,
        last: FloatArray | None,
        obstacles: Sequence[ObstaclePrediction],
    ) -> FloatArray | None:
        """Inputs (N, nu) of an earlier backup and its braking; None if that is not clear any more.

        Args:
            x: (nx,) state now.
            inputs: (k, nu) what is left of its plan.
            last: (nu,) input last applied, or None.
            obstacles: Predictions, row 0 now.
        """
        model, stage = self._problem.model, len(inputs)
        end = rollout(model.step, x, inputs).states[-1]
        stop, path = self.stopping(end, inputs[-1] if stage else last)
        if not self.is_clear(path, stop, obstacles, stage):
            return None
        rest = np.tile(model.equilibrium_input, (self._planned, 1))
        return np.concatenate([inputs, stop, rest])[: self._planned]

    def path(self, x: FloatArray, inputs: FloatArray | None, last: FloatArray | None) -> FloatArray:
        """States (N+1, nx) of an earlier backup, or of braking from now on, then of rest.

        Args:
            x: (nx,) state now.
            inputs: (k, nu) what is left of its plan; None for no backup.
            last: (nu,) input last applied, or None.
        """
        model, N = self._problem.model, self._planned
        if inputs is None:
            inputs = np.zeros((0, model.nu))
        states = rollout(model.step, x, inputs).states
        stop = self.stopping(states[-1], inputs[-1] if len(inputs) else last)[1]
        path = np.concatenate([states[:-1], stop])
        return path[np.minimum(np.arange(N + 1), len(path) - 1)]

    def _is_far(self, end: FloatArray, obstacles: Sequence[ObstaclePrediction]) -> bool:
        """Whether nothing can be met while braking, from the last two positions (2, d)."""
        dt = self._problem.model.dt
        speed = float(np.linalg.norm(end[1] - end[0])) / dt
        if speed > self._speeds[-1] or self._swings:
            return False
        way, time = (_RESERVE * np.interp(speed, self._speeds, part) for part in self._braking)
        if min((end[1] - self._room[0]).min(), (self._room[1] - end[1]).min()) < way:
            return False
        if not obstacles:
            return True
        N = obstacles[0].horizon
        last = np.array([o.means[N - 1 :] for o in obstacles])
        drift = np.linalg.norm(last[:, 1] - last[:, 0], axis=1) / dt
        variance = np.array([o.largest_std[N] ** 2 for o in obstacles])
        variance += time / dt * np.array([_growth(o) for o in obstacles])
        reach = np.array([self._body + o.radius + _size(o) for o in obstacles])
        size = self._problem.size_for(len(obstacles), self._nodes.count)
        gap = np.linalg.norm(end[1] - last[:, 1], axis=1) - size * np.sqrt(variance) - reach
        return bool((gap > way + drift * time).all())

    def is_clear(
        self,
        states: FloatArray,
        inputs: FloatArray,
        obstacles: Sequence[ObstaclePrediction],
        stage: int,
    ) -> bool:
        """Whether states (k+1, nx) of inputs (k, nu) from a stage on keep out of all obstacles.

        And within their bounds.
        """
        k, path = len(inputs), states[:, self._problem.model.position]
        if k == 0:
            return True
        outside = self._problem.row_excess(states)[:, ~self._problem.soft_rows]
        if not self._rests(path, k) or outside.max(initial=0.0) > self._tolerance:
            return False
        if not obstacles:
            return True
        near = self._near(path, obstacles, stage)
        if not len(near):
            return True
        rest = np.tile(self._problem.model.equilibrium_input, (self._problem.horizon - k, 1))
        later = [self._later(obstacles[j], stage) for j in near]
        step = Step.read(self._problem, states[0], states[0], later, nodes=self._nodes)
        depths = self._fallback.depths(step, np.concatenate([inputs, rest]))
        return bool(self._nodes.stages(depths)[:, :k].max(initial=0.0) <= self._tolerance)

    def _rests(self, path: FloatArray, count: int) -> bool:
        """Whether so many inputs come to rest within the time that is looked at."""
        if count < self._problem.horizon:
            return True
        rest = AT_REST if self._swings else _FADED
        return float(np.linalg.norm(path[-1] - path[-2])) <= rest * self._problem.model.dt

    def _near(
        self, path: FloatArray, obstacles: Sequence[ObstaclePrediction], stage: int
    ) -> list[int]:
        """Which obstacles may be touched on the way (k+1, d); all others are not, for certain."""
        N = obstacles[0].horizon
        row = stage + np.arange(len(path))
        inside, beyond = np.minimum(row, N), np.maximum(row - N, 0)
        last = np.array([o.means[N - 1 :] for o in obstacles])  # (J, 2, d)
        mu = np.array([o.means[inside] for o in obstacles])
        mu += beyond[:, None] * (last[:, 1:] - last[:, :1])
        growth = np.array([_growth(o) for o in obstacles])
        std = np.array([o.largest_std[inside] for o in obstacles])
        std = np.sqrt(std * std + beyond * growth[:, None])
        away = path - mu
        moved = np.sqrt((np.diff(away, axis=1) ** 2).sum(axis=2)).max(axis=1)
        reach = np.array([self._body + o.radius + _size(o) for o in obstacles]) + 2 * moved
        size = self._problem.size_for(len(obstacles), self._nodes.count)
        gap = np.sqrt((away * away).sum(axis=2)) - size * std - reach[:, None]
        near: list[int] = np.flatnonzero(gap.min(axis=1) < 0).tolist()
        return near

    def _later(self, obstacle: ObstaclePrediction, stage: int) -> ObstaclePrediction:
        """A prediction from a stage on, carried on beyond its last row."""
        rows = stage + np.arange(self._problem.horizon + 1)
        return obstacle.with_rows(*obstacle.interpolated(rows), None)


def _size(obstacle: ObstaclePrediction) -> float:
    """How far the corners of an obstacle are from its position [m]."""
    if obstacle.shape is None:
        return 0.0
    return float(np.linalg.norm(obstacle.shape.vertices, axis=1).max())


def _growth(obstacle: ObstaclePrediction) -> float:
    """What the largest variance grows by in one interval beyond the last row, at most [m^2]."""
    last = obstacle.covariances[-1] - obstacle.covariances[-2]
    return float(np.sqrt((last * last).sum()))
