"""Several obstacles on and beside the reference circle: named problems for benchmarks and tests."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.control.reference import CircularReference
from scp_mpc.geometry.margin import MarginSpec
from scp_mpc.obstacles.circular import CircularObstacle
from scp_mpc.problem import Problem
from scp_mpc.simulation.scenarios import DT, Scenario
from scp_mpc.simulation.scene import Body, Scene

_TRACKS = (8.0, 6.6, 9.4, 5.2, 10.8)  # [m] on the reference circle, inside it, outside it
_SPEEDS = (0.06, 0.10, 0.14, 0.18)  # [rad/s], every other obstacle clockwise
_VARIANCE = 0.02  # [m^2] of a position now
_GROWTH = 0.004  # [m^2/s] along the horizon


@dataclass(frozen=True)
class Crowd(Scene):
    """The report's robot and reference among obstacles that go round both ways.

    Attributes:
        horizon: N.
        count: Number of obstacles, each with its own size s_j.
    """

    horizon: int
    count: int
    reference: CircularReference = field(default_factory=CircularReference)

    @property
    def name(self) -> str:
        """What files and tables call it."""
        return f"crowd-{self.count}-N{self.horizon}"

    @property
    def obstacles(self) -> list[CircularObstacle]:
        """True motions, evenly spread over the circle at the start."""
        return [
            CircularObstacle(
                track_radius=_TRACKS[j % len(_TRACKS)],
                angular_velocity=(-1) ** j * _SPEEDS[j % len(_SPEEDS)],
                start_angle=2 * np.pi * (j + 0.5) / self.count,
            )
            for j in range(self.count)
        ]

    def problem(
        self,
        inflation: Literal["exact", "axes"] = "exact",
        margin: MarginSpec | None = None,
        nodes_per_interval: int = 1,
    ) -> Problem:
        """The report's problem with room for all obstacles."""
        single = Scenario(self.name, self.name, self.horizon).problem(
            inflation, margin, nodes_per_interval
        )
        return replace(single, max_obstacles=self.count)

    def start(self) -> FloatArray:
        """State (4,) on the reference at time 0."""
        return self.x_ref(0.0)[0]

    @cached_property
    def bodies(self) -> tuple[Body, ...]:
        """The obstacles, whose variance grows along the horizon."""
        times = DT * np.arange(self.horizon + 1)
        covariances = (_VARIANCE + _GROWTH * times)[:, None, None] * np.eye(2)
        return tuple(Body(o.position, o.radius, covariances=covariances) for o in self.obstacles)

    def x_ref(self, time: float, x: FloatArray | None = None) -> FloatArray:  # noqa: ARG002
        """Reference (N+1, 4) from a time on, wherever the robot is."""
        return self.reference.states(time, self.horizon, DT)
