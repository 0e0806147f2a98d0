"""Seeded scenes in which obstacles shape the plan, for the measurement of risk.

Some are everyday encounters; the others are where a promise is hardest to keep:

    escort      small errors against large radii, side by side at equal, low speed: the robot
                rests at its half-space, whose bound is then nearly reached
    wandering   the same with errors that grow quickly: contact at one sample and at the next are
                different events
    round       as `escort`, but going round an obstacle at rest
    turned      a long ellipse, met where lengthened axes are short by most: there the normal's
                share along the long axis is 1 / sqrt(1 + k), with k the ratio of the axes
    diagonal    a long ellipse at 45 degrees, passed along x
    needle      thin and fast: between two samples it crosses the robot's path
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.models.double_integrator import DoubleIntegrator
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.obstacles.predictors import ConstantVelocityPredictor, ReportPredictor

HORIZON = 15
DT = 0.2  # [s]
_JITTER = 0.02  # [m], [m/s] on the robot's start
_TIMES = DT * np.arange(HORIZON + 1)


@dataclass(frozen=True, eq=False)
class Scene:
    """One control step: where the robot is, what it wants, and what it is told.

    Attributes:
        name: What tables call it.
        model: The robot.
        x0: (nx,) state now.
        x_ref: (N+1, nx) reference.
        obstacles: Predictions.
        robot_radius: [m].
    """

    name: str
    model: DoubleIntegrator
    x0: FloatArray
    x_ref: FloatArray
    obstacles: list[ObstaclePrediction]
    robot_radius: float


def all_scenes(seed: int) -> list[Scene]:
    """Every scene; the seed moves the robot's start a little.

    Args:
        seed: Of the starts.
    """
    k = 10.0
    turned = rotated((0.15, 0.15 / k), np.arcsin(1 / np.sqrt(1 + k)))
    diagonal = rotated((0.2, 0.02), np.pi / 4)
    even = rotated((0.15, 0.15), 0.0)
    small = rotated((0.05, 0.05), 0.0)
    escort = rotated((0.08, 0.08), 0.0)
    loose = rotated((0.1, 0.1), 0.0)
    report = ReportPredictor().predict(
        np.array([3.5, 0.4]), np.array([-0.96, 0.0]), 0.2, HORIZON, DT
    )
    drifting = ConstantVelocityPredictor(
        position_covariance=rotated((0.08, 0.08), 0.0),
        velocity_covariance=rotated((0.2, 0.05), np.pi / 4),
    ).predict(np.array([2.5, 0.8]), np.array([-0.3, -0.3]), 0.2, HORIZON, DT)
    given = [
        ("crossing", 2.0, 0.0, 0.15, [_moving((3.4, 1.6), (0.0, -1.0), even, 0.2, 0.04)]),
        (
            "ahead",
            2.0,
            0.0,
            0.15,
            [_moving((2.5, 0.1), (0.3, 0.0), rotated((0.2, 0.15), 0.4), 0.2, 0.02)],
        ),
        ("beside", 1.5, 0.0, 0.15, [_moving((1.0, 0.9), (1.3, -0.25), even, 0.2, 0.02)]),
        ("escort", 0.1, 0.65, 0.3, [_moving((0.0, -0.3), (0.1, 0.0), escort, 0.3)]),
        ("wandering", 0.1, 0.65, 2.5, [_moving((0.0, -4.8), (0.1, 0.0), loose, 2.5, 1.0)]),
        ("round", 0.5, 0.0, 0.5, [_moving((1.2, -0.2), (0.0, 0.0), small, 0.5)]),
        ("turned", 0.1, 0.65, 0.5, [_moving((-0.2, -0.6), (0.1, 0.0), turned, 0.5)]),
        ("diagonal", 0.5, 0.0, 0.4, [_moving((1.25, 0.95), (0.0, 0.0), diagonal, 0.4)]),
        ("needle", 2.0, 0.0, 0.1, [_moving((3.0, 7.5), (0.0, -5.0), small, 0.05)]),
        (
            "gate",
            1.5,
            0.0,
            0.2,
            [
                _moving((2.4, 0.9), (0.0, -0.1), small, 0.2, 0.05),
                _moving((2.6, -0.75), (0.0, 0.1), even, 0.2),
            ],
        ),
        (
            "two in turn",
            1.5,
            0.0,
            0.15,
            [
                _moving((1.8, 0.15), (0.3, 0.0), small, 0.2),
                _moving((3.2, -1.3), (0.0, 0.5), even, 0.2, 0.03),
            ],
        ),
        ("unknown velocity", 1.5, 0.0, 0.2, [drifting]),
        ("report", 2.0, 0.0, 0.15, [report]),
    ]
    rng = np.random.default_rng([seed, len(given)])
    flat = [_scene(*one, rng) for one in given]
    return [*flat, _in_space(rng)]


def rotated(deviations: tuple[float, float], angle: float) -> FloatArray:
    """Covariance (2, 2) with these standard deviations [m], the first along `angle` [rad]."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s], [s, c]])
    return R @ np.diag(np.square(deviations)) @ R.T


def _moving(
    position: Sequence[float],
    velocity: Sequence[float],
    covariance: FloatArray,
    radius: float,
    growth: float = 0.0,
) -> ObstaclePrediction:
    """Constant velocity; the covariance grows by a share of itself per stage."""
    shares = 1 + growth * np.arange(HORIZON + 1)
    return ObstaclePrediction(
        np.array(position) + _TIMES[:, None] * np.array(velocity),
        shares[:, None, None] * covariance,
        radius,
    )


def _scene(
    name: str,
    speed: float,
    aside: float,
    robot_radius: float,
    obstacles: list[ObstaclePrediction],
    rng: np.random.Generator,
) -> Scene:
    """The reference is the x-axis at constant speed; the robot starts beside it."""
    dim = obstacles[0].dim
    model = DoubleIntegrator(DT, dim)
    ahead: FloatArray = np.eye(dim)[0]
    path = speed * _TIMES[:, None] * ahead
    x_ref = model.state(path, np.broadcast_to(speed * ahead, path.shape))
    start = x_ref[0] + _JITTER * rng.uniform(-1, 1, model.nx)
    start[2] += aside
    return Scene(name, model, start, x_ref, obstacles, robot_radius)


def _in_space(rng: np.random.Generator) -> Scene:
    covariance = np.diag(np.square([0.25, 0.04, 0.04]))
    turn = np.linalg.qr(np.array([[1.0, 0.4, 0.2], [0.5, -1.0, 0.1], [0.5, 0.2, 1.0]])).Q
    obstacle = _moving((2.4, 0.1, 0.1), (0.3, 0.0, 0.0), turn @ covariance @ turn.T, 0.3)
    return _scene("in space", 1.5, 0.0, 0.3, [obstacle], rng)
