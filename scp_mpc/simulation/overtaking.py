"""Overtaking: a car on a two-lane road, a slower one ahead, two that come the other way.

The road runs along the second axis; the car drives up on the right, x = 0. Cars keep their speed,
up to what the predictions' covariances say. The slow one is a box, the others are three discs.
"""

from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.control.path import Path
from scp_mpc.control.path_reference import PathReference
from scp_mpc.models.bicycle import KinematicBicycle
from scp_mpc.obstacles.polytope import Polytope
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.simulation.drive import Look

LANE = 3.6  # [m] wide; the left one is at x = -LANE
CAR = (4.4, 1.8)  # [m] long, wide
DISCS = (-1.5, 0.0, 1.5)  # [m] along a car
_RADIUS = 1.17  # [m] of each disc: it reaches the car's corners
_EDGE = (-LANE - 0.75, 0.75)  # [m] between which the middle of the car stays
_GROWTH = 0.35  # [m/s] standard deviation of an oncoming car's speed
_WANDER = 0.12  # [m] standard deviation across the road
_INF = np.inf


@dataclass(frozen=True)
class Overtaking:
    """The scene.

    Attributes:
        steps: K.
        horizon: N.
        dt: [s].
        speed: What the car would like to drive [m/s].
        ahead: Where the slow car is, and its speed [m], [m/s].
        oncoming: Where the others are, and their speeds.
    """

    steps: int = 50
    horizon: int = 25
    dt: float = 0.2
    speed: float = 14.0
    ahead: tuple[float, float] = (28.0, 7.0)
    oncoming: tuple[tuple[float, float], ...] = ((92.0, -10.0), (330.0, -11.0))

    @property
    def robot(self) -> KinematicBicycle:
        """The car, placed by its middle."""
        return KinematicBicycle(self.dt, wheelbase=2.7, rear=1.35)

    def problem(self) -> Problem:
        """Between the road's edges, at 0 to 16 m/s, -5 to 2.5 m/s^2 and 0.3 rad at most."""
        return Problem(
            self.robot,
            horizon=self.horizon,
            Q=[0.06, 0.04, 2.0, 0.05, 0.5],
            R=[0.05, 2.0],
            u_min=[-5.0, -0.5],
            u_max=[2.5, 0.5],
            du_min=[-1.5, -0.2],
            du_max=[1.5, 0.2],
            x_min=[_EDGE[0], -_INF, -_INF, 0.0, -0.3],
            x_max=[_EDGE[1], _INF, _INF, 16.0, 0.3],
            robot_radius=_RADIUS,
            discs=DISCS,
            max_obstacles=1 + len(DISCS) * len(self.oncoming),
        )

    def start(self) -> FloatArray:
        """On the right, at 13 m/s."""
        return np.array([0.0, 0.0, np.pi / 2, 13.0, 0.0])

    def begin(self, problem: Problem, seed: int) -> tuple[list[ObstaclePrediction], Look]:
        """Draw the true speeds; see `World`."""
        rng = np.random.default_rng(seed)
        box = Polytope.box(CAR[::-1])
        times = self.dt * np.arange(self.steps + 1)
        slow = np.stack([0 * times, self.ahead[0] + self.ahead[1] * times], axis=1)
        others = []
        for y, v in self.oncoming:
            pace = v + 0.5 * _GROWTH * rng.normal()
            sway = 0.1 * np.sin(0.6 * times + rng.uniform(0, 6))
            others.append(np.stack([sway - LANE, y + pace * times], axis=1))
        bodies = [ObstaclePrediction(slow, np.zeros((2, 2)), 0.0, shape=box)]
        for way in others:
            bodies += [ObstaclePrediction(way + [0.0, d], np.zeros((2, 2)), _RADIUS) for d in DISCS]
        stages = self.dt * np.arange(self.horizon + 1)[:, None]
        along = (0.1 + _GROWTH * stages[:, 0]) ** 2
        Sigma = np.zeros((len(stages), 2, 2))
        Sigma[:, 0, 0], Sigma[:, 1, 1] = _WANDER**2, along
        certain = (0.05 + 0.03 * stages)[:, :, None] ** 2 * np.eye(2)
        road = Path.polyline([[0.0, -20.0], [0.0, 600.0]])
        follow = PathReference(road, speed=self.speed, model=problem.model, horizon=self.horizon)

        def look(k: int, x: FloatArray) -> tuple[FloatArray, list[ObstaclePrediction]]:
            told = [
                ObstaclePrediction(
                    slow[k] + stages * [0.0, self.ahead[1]], certain, 0.0, name="slow", shape=box
                )
            ]
            for j, way in enumerate(others):
                v = (way[1] - way[0])[1] / self.dt
                told += [
                    ObstaclePrediction(
                        [-LANE, way[k, 1] + d] + stages * [0.0, v], Sigma, _RADIUS, name=(j, d)
                    )
                    for d in DISCS
                ]
            return follow.states(x), told

        return bodies, look
