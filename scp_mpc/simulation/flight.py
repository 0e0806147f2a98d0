"""Flight: a quadrotor goes round a path in space among balls that go round theirs."""

from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.control.path import Path
from scp_mpc.control.path_reference import PathReference
from scp_mpc.geometry.margin import Containment
from scp_mpc.models.quadrotor import Quadrotor
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.simulation.drive import Look

_LEAN = 0.7  # [rad] of roll and pitch at most
_INF = np.inf


@dataclass(frozen=True)
class Flight:
    """The scene.

    Attributes:
        steps: K.
        horizon: N.
        dt: [s].
        speed: Along the path [m/s].
        balls: How many.
        radius: Of each ball [m].
    """

    steps: int = 110
    horizon: int = 20
    dt: float = 0.1
    speed: float = 2.2
    balls: int = 10
    radius: float = 0.3

    @property
    def path(self) -> Path:
        """A closed curve that rises and falls twice."""
        t = np.linspace(0.0, 2 * np.pi, 12, endpoint=False)
        height = 2.0 + 0.7 * np.sin(2 * t)
        return Path.spline(np.stack([4 * np.cos(t), 3 * np.sin(t), height], axis=1), closed=True)

    def problem(self) -> Problem:
        """Between floor and ceiling, at 5 m/s along each axis, 0.7 rad and 20 m/s^2 at most."""
        fast, lean = 5.0, _LEAN
        return Problem(
            Quadrotor(self.dt),
            horizon=self.horizon,
            Q=[2.0, 2.0, 2.0, 0.2, 0.2, 0.2, 0.1, 0.1, 0.5],
            R=[0.02, 0.1, 0.1, 0.1],
            u_min=[2.0, -4.0, -4.0, -2.0],
            u_max=[20.0, 4.0, 4.0, 2.0],
            x_min=[-_INF, -_INF, 0.4, -fast, -fast, -fast, -lean, -lean, -_INF],
            x_max=[_INF, _INF, 4.0, fast, fast, fast, lean, lean, _INF],
            robot_radius=0.25,
            margin=Containment(0.95),
            max_obstacles=self.balls,
        )

    def start(self) -> FloatArray:
        """Hovering at the path's beginning."""
        return np.concatenate([self.path.positions(0.0), np.zeros(6)])

    def begin(self, problem: Problem, seed: int) -> tuple[list[ObstaclePrediction], Look]:
        """Draw the balls' ways: each swings through a point of the path; see `World`."""
        rng = np.random.default_rng(seed)
        path = self.path
        centres = path.positions(path.length * (np.arange(self.balls) + 0.7) / self.balls)
        swings = rng.normal(size=(self.balls, 3)) * [1.0, 1.0, 0.6]
        swings *= 1.3 / np.linalg.norm(swings, axis=1, keepdims=True)
        rates, phases = rng.uniform(0.4, 0.8, self.balls), rng.uniform(0, 2 * np.pi, self.balls)
        times = self.dt * np.arange(self.steps + 1)
        angle = rates * times[:, None] + phases
        ways = centres + swings * np.sin(angle)[..., None]  # (K+1, balls, 3)
        speeds = swings * (rates * np.cos(angle))[..., None]
        bodies = [
            ObstaclePrediction(ways[:, j], np.zeros((3, 3)), self.radius) for j in range(self.balls)
        ]
        stages = self.dt * np.arange(self.horizon + 1)[:, None]
        # the acceleration that a straight prediction does not know of
        sigma = 0.03 + 0.06 * stages
        Sigma = (sigma**2)[:, :, None] * np.diag([1.0, 1.0, 0.5])
        follow = PathReference(path, speed=self.speed, model=problem.model, horizon=self.horizon)

        def look(k: int, x: FloatArray) -> tuple[FloatArray, list[ObstaclePrediction]]:
            told = [
                ObstaclePrediction(ways[k, j] + stages * speeds[k, j], Sigma, self.radius, name=j)
                for j in range(self.balls)
            ]
            return follow.states(x), told

        return bodies, look
