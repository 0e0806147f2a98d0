"""Random worlds that keep their word, and a judge that knows the truth alone.

The judge shares no code with the package: distances to discs and convex polygons by hand, the
robot's way within an interval by Gauss-Legendre quadrature of its equations of motion.

Notation:
    K   control steps       T   instants in an interval     nv  corners
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray
from scp_mpc.models.bicycle import KinematicBicycle
from scp_mpc.models.double_integrator import DoubleIntegrator
from scp_mpc.models.model import Model
from scp_mpc.models.unicycle import Unicycle
from scp_mpc.obstacles.polytope import Polytope
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem

ROBOTS = ("double integrator", "unicycle", "bicycle")
SHARES = np.linspace(0.0, 1.0, 129)  # of an interval; at 3 m/s and 0.2 s they miss 0.01 mm
_WHEELBASE, _REAR, _STEERING = 0.5, 0.25, 0.6  # [m], [m], [rad]
_WALL = np.array([0.1, 3.0])  # half its thickness and length on one side of a door [m]
_MANY = 8  # obstacles at most
_STATE_WEIGHTS = ([1.0, 0.1, 1.0, 0.1], [1.0, 1.0, 0.01, 0.1], [1.0, 1.0, 0.01, 0.1, 0.01])
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2  # of [0, 1]


@dataclass(frozen=True, eq=False)
class Thing:
    """A convex polygon rounded by a radius, or a disc, which has one corner; it moves straight on.

    Attributes:
        at: (2,) position at time 0 [m].
        velocity: (2,) [m/s].
        corners: (nv, 2) anticlockwise, from the position [m].
        radius: [m].
        variances: (N+1,) of what is predicted, in any direction [m^2].
    """

    at: FloatArray
    velocity: FloatArray
    corners: FloatArray
    radius: float
    variances: FloatArray

    def gaps(self, points: FloatArray, times: ArrayLike) -> FloatArray:
        """Distances (...) of points (..., 2) at times (...) [s] from it [m], negative inside."""
        y = points - self.at - np.asarray(times)[..., None] * self.velocity
        away, side = y[..., None, :] - self.corners, np.roll(self.corners, -1, 0) - self.corners
        length = np.maximum((side * side).sum(axis=-1), 1e-300)  # squared
        share = np.clip((away * side).sum(axis=-1) / length, 0.0, 1.0)
        outline = np.linalg.norm(away - share[..., None] * side, axis=-1).min(axis=-1)
        left = side[:, 0] * away[..., 1] - side[:, 1] * away[..., 0] > 0
        return np.where(left.all(axis=-1), -outline, outline) - self.radius

    def prediction(self, time: float, dt: float) -> ObstaclePrediction:
        """What is told of it from a time on: the truth."""
        times = time + dt * np.arange(len(self.variances))[:, None]
        shape = Polytope(self.corners) if len(self.corners) > 1 else None
        Sigma = self.variances[:, None, None] * np.eye(2)
        return ObstaclePrediction(self.at + times * self.velocity, Sigma, self.radius, shape=shape)


class World:
    """A robot at the origin, its goal ahead, and what is in between.

    Args:
        seed: Of all that is drawn.
        moving: Whether most obstacles move, as predicted.
    """

    def __init__(self, seed: int, moving: bool = False) -> None:
        """Draw everything."""
        self._rng = rng = np.random.default_rng([seed, moving])
        self.robot = ROBOTS[rng.integers(len(ROBOTS))]
        self.dt, self.horizon = float(rng.choice([0.1, 0.2])), int(rng.integers(10, 31))
        self.radius = float(rng.uniform(0.15, 0.4))
        self.speed_max = float(rng.uniform(1.0, 2.0)) if rng.random() < 0.5 else None
        self.goal = np.array([rng.uniform(4.0, 8.0), 0.0])
        model = self._model()
        steered = self.robot == "bicycle"
        limit = np.where(np.arange(model.nx) == 4, _STEERING, np.inf)
        course, speed = rng.uniform(-1.0, 1.0), rng.uniform(0.0, 1.0)
        self.start = model.state(np.zeros(2), speed * np.array([np.cos(course), np.sin(course)]))
        self.x_ref = model.state(self.goal, np.zeros(2))
        growth = rng.uniform([0.0, 0.0], [0.05**2, 0.1**2 * self.dt]) * (rng.random() < 0.5)
        self._growing = growth[0] + growth[1] * np.arange(self.horizon + 1)
        self.things = self._door() if rng.random() < 0.25 else []
        while not self.things or (len(self.things) < _MANY and rng.random() < 0.8):
            thing = self._thing(moving and rng.random() < 0.7)
            if thing.gaps(np.zeros(2), 0.0) > self.radius + 0.3:
                self.things.append(thing)
        self.problem = Problem(
            model,
            horizon=self.horizon,
            Q=_STATE_WEIGHTS[ROBOTS.index(self.robot)],
            R=[0.05, 0.05],
            u_min=-2.0,
            u_max=2.0,
            robot_radius=self.radius,
            max_obstacles=len(self.things),
            inflation="exact" if rng.random() < 0.5 else "axes",
            speed_max=self.speed_max,
            x_min=-limit if steered else None,
            x_max=limit if steered else None,
        )

    def predictions(self, time: float) -> list[ObstaclePrediction]:
        """What is known of everything from a time on [s]."""
        return [thing.prediction(time, self.dt) for thing in self.things]

    def path(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Positions (K, T, 2) in intervals that begin at states (K, nx), with inputs (K, nu) held.

        Of a bicycle its middle, `rear` ahead of the point that goes where the heading points.
        """
        h = self.dt * SHARES
        if self.robot == "double integrator":
            p, v = states[:, None, ::2], states[:, None, 1::2]
            return p + h[:, None] * v + h[:, None] ** 2 / 2 * inputs[:, None]
        t, rear = h[:, None] * _NODES, _REAR if self.robot == "bicycle" else 0.0
        v = states[:, 3, None, None] + inputs[:, 0, None, None] * t
        way = h * (v * np.exp(1j * self._turned(states, inputs, t)) @ _WEIGHTS)
        way += rear * (np.exp(1j * self._turned(states, inputs, h)) - 1)
        z = (states[:, 0] + 1j * states[:, 1])[:, None] + np.exp(1j * states[:, 2, None]) * way
        return np.stack([z.real, z.imag], axis=-1)

    def _turned(self, states: FloatArray, inputs: FloatArray, time: FloatArray) -> FloatArray:
        """Angles (K, ...) turned after times (...) [s]."""
        t = time if self.robot == "unicycle" else time[..., None] * _NODES
        _, _, _, v, *steering = states.T.reshape(-1, len(states), *[1] * t.ndim)
        a, u = inputs.T.reshape(2, len(states), *[1] * t.ndim)
        if self.robot == "unicycle":
            return u * t
        rate = (v + a * t) * np.tan(steering[0] + u * t) / _WHEELBASE
        return time * (rate @ _WEIGHTS)

    def _model(self) -> Model:
        if self.robot == "bicycle":
            return KinematicBicycle(self.dt, _WHEELBASE, _REAR, substeps=4)
        return Unicycle(self.dt) if self.robot == "unicycle" else DoubleIntegrator(self.dt)

    def _thing(self, moves: bool) -> Thing:
        """A wall, a polygon or a disc, on the robot's way at some time."""
        rng = self._rng
        at, angle, kind = rng.uniform([1.0, -2.5], self.goal + [0.0, 2.5]), 0.0, rng.random()
        velocity = np.zeros(2)
        if moves:
            angle = rng.uniform(-np.pi, np.pi)
            velocity = rng.uniform(0.1, 1.0) * np.array([np.cos(angle), np.sin(angle)])
            at = at - rng.uniform(0.0, 6.0) * velocity
        radius = float(rng.choice([0.0, 0.05]))
        if kind < 0.4:
            corners, radius = np.zeros((1, 2)), float(rng.uniform(0.1, 0.8))
        elif kind < 0.7:
            corners = _box(rng.uniform(0.05, 1.2, 2), rng.uniform(0.0, np.pi))
        else:
            count = rng.integers(3, 7)
            turns = 2 * np.pi / count * (np.arange(count) + rng.uniform(0.0, 0.8, count))
            corners = rng.uniform(0.2, 1.0) * np.stack([np.cos(turns), np.sin(turns)], axis=1)
        return Thing(at, velocity, corners, radius, moves * self._growing)

    def _door(self) -> list[Thing]:
        """A wall across the way with a door in it, wide enough or not."""
        rng, turn = self._rng, self._rng.uniform(-0.3, 0.3)
        centre = rng.uniform([1.5, -1.0], [self.goal[0] - 1.0, 1.0])
        away = self.radius * rng.uniform(0.9, 2.5) + _WALL[1]
        along, still = np.array([-np.sin(turn), np.cos(turn)]), np.zeros(2)
        return [
            Thing(centre + side * away * along, still, _box(_WALL, turn), 0.0, 0 * self._growing)
            for side in (-1, 1)
        ]


def _box(half: ArrayLike, angle: float) -> FloatArray:
    """Corners (4, 2) of a box with half its sizes [m], turned by an angle [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    return corners @ np.array([[c, s], [-s, c]])
