"""Doorway: a unicycle goes through a door that people come out of.

Walls and a table are polygons. The people are seen with noise, tracked and predicted.
"""

from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.control.path import Path
from scp_mpc.control.path_reference import PathReference
from scp_mpc.control.speed import SpeedLimits
from scp_mpc.geometry.margin import StageRisk
from scp_mpc.models.unicycle import Unicycle
from scp_mpc.obstacles.polytope import Polytope
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.settings import require_positive
from scp_mpc.simulation.drive import Look
from scp_mpc.tracking.tracker import Tracker, TrackerSettings

ROOM = ((0.0, 12.0), (0.0, 7.0))  # [m] from where to where it reaches along both axes
_WALL = (6.0, 6.3)  # [m] along x
_DOOR = (2.7, 4.5)  # [m] along y
_ROOM_TO_SPARE = 0.05  # [m] by which walls are rounded for the plans
_PERSON = 0.25  # [m] radius
_ROUTES: tuple[tuple[float, tuple[tuple[float, float], ...]], ...] = (
    (1.0, ((9.4, 3.0), (7.2, 3.6), (6.1, 3.6), (4.8, 3.5), (0.8, 5.8))),
    (1.1, ((11.5, 2.2), (7.5, 3.5), (6.1, 3.6), (4.6, 3.9), (1.0, 1.2))),
    (0.8, ((9.6, 0.4), (9.9, 6.6))),
    (0.7, ((2.5, 6.6), (2.3, 0.4))),
    (0.6, ((10.6, 6.4), (10.2, 1.0))),
)


@dataclass(frozen=True)
class Doorway:
    """The scene.

    Attributes:
        steps: K.
        horizon: N.
        dt: [s].
        speed: What the robot would like to drive [m/s].
        noise: Standard deviation of the people's measured positions [m].
    """

    steps: int = 100
    horizon: int = 20
    dt: float = 0.15
    speed: float = 1.1
    noise: float = 0.05

    def __post_init__(self) -> None:
        """Check the noise."""
        require_positive("noise", self.noise)

    @property
    def walls(self) -> list[Polytope]:
        """The wall on both sides of the door, a table and a column."""
        (begin, end), (low, high) = _WALL, _DOOR
        return [
            Polytope([[begin, -0.2], [end, -0.2], [end, low], [begin, low]]),
            Polytope([[begin, high], [end, high], [end, 7.2], [begin, 7.2]]),
            Polytope([[3.3, 1.3], [4.1, 0.9], [4.8, 1.5], [4.4, 2.6], [3.6, 2.4]]),
            Polytope.box([0.7, 0.7], angle=0.6, centre=[8.6, 4.3]),
        ]

    @property
    def path(self) -> Path:
        """From the lower left through the door to the upper right."""
        return Path.spline([[0.8, 1.4], [2.8, 2.6], [6.15, 3.6], [8.8, 4.2], [11.2, 5.6]])

    def problem(self) -> Problem:
        """Forwards at 1.5 m/s at most, within the room."""
        return Problem(
            Unicycle(self.dt),
            horizon=self.horizon,
            Q=[1.0, 1.0, 0.3, 0.2],
            R=[0.05, 0.05],
            u_min=[-1.5, -1.5],
            u_max=[1.0, 1.5],
            du_min=[-0.6, -0.8],
            du_max=[0.6, 0.8],
            x_min=[ROOM[0][0] + 0.3, ROOM[1][0] + 0.3, -np.inf, -0.3],
            x_max=[ROOM[0][1] - 0.3, ROOM[1][1] - 0.3, np.inf, 1.5],
            robot_radius=0.28,
            margin=StageRisk(0.05),
            max_obstacles=len(self.walls) + len(_ROUTES),
        )

    def start(self) -> FloatArray:
        """At rest at the path's beginning, facing along it."""
        t = self.path.tangents(0.0)
        return np.array([*self.path.positions(0.0), np.arctan2(t[1], t[0]), 0.0])

    def begin(self, problem: Problem, seed: int) -> tuple[list[ObstaclePrediction], Look]:
        """Let the people walk, and see them with noise; see `World`."""
        rng = np.random.default_rng(seed)
        times = self.dt * np.arange(self.steps + 1)
        ways = [Path.spline(p) if len(p) > 2 else Path.polyline(p) for _, p in _ROUTES]
        people = np.stack(
            [way.positions(v * times) for way, (v, _) in zip(ways, _ROUTES, strict=True)]
        )
        bodies = [wall.static(self.steps) for wall in self.walls]
        bodies += [ObstaclePrediction(way, np.zeros((2, 2)), _PERSON) for way in people]
        fixed = [
            wall.static(self.horizon, radius=_ROOM_TO_SPARE, name=f"wall {j}")
            for j, wall in enumerate(self.walls)
        ]
        tracker = Tracker(
            self.dt,
            self.horizon,
            radius=_PERSON,
            measurement_std=self.noise,
            settings=TrackerSettings(confirmations=1),
        )
        limits = SpeedLimits(self.speed, lateral=0.6, longitudinal=0.6)
        follow = PathReference(self.path, speed=limits, model=problem.model, horizon=self.horizon)
        before = range(-8, 0)  # seen before the robot sets off, standing where they start
        for k in before:
            back = people[:, 0] + k * (people[:, 1] - people[:, 0])
            seen = back + self.noise * rng.normal(size=back.shape)
            tracker.update(k * self.dt, seen, range(len(people)))

        def look(k: int, x: FloatArray) -> tuple[FloatArray, list[ObstaclePrediction]]:
            seen = people[:, k] + self.noise * rng.normal(size=people[:, k].shape)
            tracker.update(k * self.dt, seen, range(len(people)))
            return follow.states(x), fixed + tracker.predictions()

        return bodies, look
