"""Robots of all kinds on one circle, among obstacles that go round it both ways.

Notation:
    R, omega    radius [m] and angular velocity [rad/s] of the reference
    a           angle on the circle [rad]
    o           offsets (M, d) of the obstacles' tracks from the reference circle [m]
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.models.bicycle import KinematicBicycle
from scp_mpc.models.double_integrator import DoubleIntegrator
from scp_mpc.models.planar_quadrotor import PlanarQuadrotor
from scp_mpc.models.quadrotor import Quadrotor
from scp_mpc.models.unicycle import Unicycle
from scp_mpc.problem import Problem
from scp_mpc.simulation.scene import Body, Scene

_R, _OMEGA = 8.0, 0.52  # the report's reference
_BODY = 0.15  # [m] radius of the robot
_RADIUS = 0.2  # [m] of each obstacle
_WHEELBASE = 0.5  # [m]
_TRACKS = (0.0, -1.4, 1.4, -2.8, 2.8)  # [m] as those of `Crowd`
_DENSE = (0.0, -0.4, 0.4, -0.2, 0.2)  # [m] each of them in the way
_SPEEDS = (0.06, 0.10, 0.14, 0.18)  # [rad/s]
_TILT = 0.3  # [rad] of the plane of the circle in space: heights change too

_ROBOTS = {
    "double integrator 3-D": {
        "model": DoubleIntegrator(0.2, 3),
        "Q": [0.2, 0.05] * 3,
        "R": [0.001] * 3,
        "u_min": -3.0,
        "u_max": 3.0,
    },
    "unicycle": {
        "model": Unicycle(0.2),
        "Q": [0.2, 0.2, 0.05, 0.05],
        "R": [0.001, 0.01],
        "u_min": [-3.0, -2.0],
        "u_max": [3.0, 2.0],
    },
    "bicycle": {
        "model": KinematicBicycle(0.2, _WHEELBASE),
        "Q": [0.2, 0.2, 0.05, 0.05, 0.01],
        "R": [0.001, 0.01],
        "u_min": [-3.0, -1.5],
        "u_max": [3.0, 1.5],
        "x_min": [-np.inf] * 4 + [-0.6],
        "x_max": [np.inf] * 4 + [0.6],
    },
    "planar quadrotor": {
        "model": PlanarQuadrotor(0.1),
        "Q": [0.2, 0.2, 0.001, 0.05, 0.05, 0.001],
        "R": [0.001, 0.0001],
        "u_min": [2.0, -40.0],
        "u_max": [20.0, 40.0],
    },
    "quadrotor": {
        "model": Quadrotor(0.1),
        "Q": [0.2] * 3 + [0.05] * 3 + [0.001] * 3,
        "R": [0.001] * 4,
        "u_min": [2.0, -4.0, -4.0, -4.0],
        "u_max": [20.0, 4.0, 4.0, 4.0],
        "x_min": [-np.inf] * 6 + [-1.0, -1.0, -np.inf],
        "x_max": [np.inf] * 6 + [1.0, 1.0, np.inf],
    },
}
CIRCLING = tuple(_ROBOTS)


def _circle(angle: FloatArray | float, offset: FloatArray) -> FloatArray:
    """Points (..., d) at angles (...) off the circle by (d,) [m], first outwards, last up."""
    radius = _R + offset[0]
    p = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    if len(offset) == 2:
        return p
    height = np.sin(_TILT) * p[..., 1:] + offset[2]
    return np.concatenate([p[..., :1], np.cos(_TILT) * p[..., 1:], height], axis=-1)


@dataclass(frozen=True, eq=False)
class _Way:
    """Of one obstacle: offset (d,) of its track, angle at time 0 and angular velocity."""

    offset: FloatArray
    angle: float
    speed: float

    def at(self, time: float) -> FloatArray:
        """Position (d,) [m] at a time [s]."""
        return _circle(self.angle + self.speed * time, self.offset)


@dataclass(frozen=True)
class Circuit(Scene):
    """A robot that follows the report's circle among obstacles.

    In space the circle is tilted, the obstacles' tracks are drawn about it, and their covariances
    are ellipsoids of any direction.

    Attributes:
        robot: One of `CIRCLING`.
        horizon: N.
        count: Number of obstacles.
        dense: Whether all tracks are within 0.4 m of the circle.
        seed: Of tracks and covariances in space.
    """

    robot: str
    horizon: int
    count: int
    dense: bool = False
    seed: int = 0

    @cached_property
    def problem(self) -> Problem:
        """With the library's points between the samples."""
        return Problem(
            **_ROBOTS[self.robot],  # type: ignore[arg-type]
            horizon=self.horizon,
            robot_radius=_BODY,
            max_obstacles=self.count,
        )

    def start(self) -> FloatArray:
        """State (nx,) on the reference at time 0."""
        return self.x_ref(0.0)[0]

    def x_ref(self, time: float, x: FloatArray | None = None) -> FloatArray:  # noqa: ARG002
        """Reference (N+1, nx) from a time on; robots that fly are to keep upright."""
        model = self.problem.model
        t: FloatArray = time + model.dt * np.arange(self.horizon + 1, dtype=np.float64)
        p, speed = _circle(_OMEGA * t, np.zeros(model.dim)), _R * _OMEGA
        v = _OMEGA * _circle(_OMEGA * t + np.pi / 2, np.zeros(model.dim))
        if isinstance(model, DoubleIntegrator):
            return model.state(p, v)
        x_ref = np.zeros((self.horizon + 1, model.nx))
        x_ref[:, model.position] = p
        if model.heading is None:
            x_ref[:, 3 : 3 + model.dim] = v
        else:
            x_ref[:, 2], x_ref[:, 3] = _OMEGA * t + np.pi / 2, speed
        if self.robot == "bicycle":
            x_ref[:, 4] = np.arctan(_WHEELBASE / _R)
        return x_ref

    @cached_property
    def bodies(self) -> tuple[Body, ...]:
        """The obstacles, whose covariances grow along the horizon."""
        t = self.problem.model.dt * np.arange(self.horizon + 1)
        growth = (1.0 + 0.2 * t)[:, None, None]
        found = []
        for j, (offset, Sigma) in enumerate(zip(*self._drawn, strict=True)):
            speed = (-1.0) ** j * _SPEEDS[j % len(_SPEEDS)]
            way = _Way(offset, 2 * np.pi * (j + 0.5) / self.count, speed)
            found.append(Body(way.at, _RADIUS, covariances=growth * Sigma))
        return tuple(found)

    @cached_property
    def _drawn(self) -> tuple[FloatArray, FloatArray]:
        """Offsets (M, d) and covariances (M, d, d) now."""
        dim = self.problem.model.dim
        tracks = np.array(_DENSE if self.dense else _TRACKS)[np.arange(self.count) % 5]
        if dim == 2:
            return tracks[:, None] * [1.0, 0.0], np.tile(0.02 * np.eye(2), (self.count, 1, 1))
        rng = np.random.default_rng(self.seed)
        offsets = rng.normal(scale=0.5, size=(self.count, 3))
        V = np.linalg.qr(rng.normal(size=(self.count, 3, 3)))[0]
        variances = rng.uniform(0.005, 0.03, (self.count, 1, 3))
        return offsets, (V * variances) @ V.mT
