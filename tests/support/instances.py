"""Seeded problem instances that the tests share."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from scp_mpc import DoubleIntegrator, Margin, ObstaclePrediction, Problem

DT = 0.2
S_REF = 5.991**0.5
KINDS = ("ahead", "beside", "crossing", "elongated")


@dataclass(frozen=True)
class Instance:
    """One control step, ready to be solved."""

    name: str
    problem: Problem
    x0: np.ndarray
    x_ref: np.ndarray
    obstacles: list[ObstaclePrediction]


def problem(
    horizon: int = 8,
    inflation: Literal["exact", "axes"] = "exact",
    s_min: float = S_REF,
    max_obstacles: int = 1,
    **changes: object,
) -> Problem:
    """Return the report's problem, constrained at the samples only, with the given changes."""
    values: dict = {
        "model": DoubleIntegrator(DT),
        "horizon": horizon,
        "Q": [0.2, 0.05, 0.2, 0.05],
        "R": [0.001, 0.001],
        "u_min": -3.0,
        "u_max": 3.0,
        "robot_radius": 0.15,
        "margin": Margin(lower=s_min),
        "inflation": inflation,
        "max_obstacles": max_obstacles,
        "nodes_per_interval": 1,
    }
    return Problem(**{**values, **changes})


def straight_reference(horizon: int, speed: float = 2.0) -> np.ndarray:
    """States along the x-axis at constant speed."""
    x = speed * DT * np.arange(horizon + 1)
    zero = np.zeros(horizon + 1)
    return np.stack([x, np.full(horizon + 1, speed), zero, zero], axis=1)


def obstacle(
    horizon: int,
    position: tuple[float, float],
    velocity: tuple[float, float] = (0.0, 0.0),
    covariance: np.ndarray | None = None,
    growth: float = 0.02,
    radius: float = 0.2,
) -> ObstaclePrediction:
    """Return an obstacle at constant velocity whose covariance grows by a share per step."""
    i = np.arange(horizon + 1)[:, None]
    Sigma = 0.04 * np.eye(2) if covariance is None else covariance
    return ObstaclePrediction(
        np.array(position) + DT * i * np.array(velocity),
        (1 + growth * i)[..., None] * Sigma,
        radius,
    )


def rotated(deviations: tuple[float, float], angle: float) -> np.ndarray:
    """Return the covariance with the given standard deviations, its long axis turned by `angle`."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, -s], [s, c]])
    return R @ np.diag(np.square(deviations)) @ R.T


def instance(
    kind: str, horizon: int, inflation: Literal["exact", "axes"], s_min: float, seed: int
) -> Instance:
    """Draw an instance: a robot at 2 m/s along the x-axis and one obstacle in its way."""
    rng = np.random.default_rng([horizon, KINDS.index(kind), seed])
    span = 2.0 * DT * horizon
    offset = rng.uniform(0.05, 0.35) * rng.choice([-1, 1])
    at, velocity, Sigma = (0.6 * span + 0.8, offset), (0.0, 0.0), rotated((0.2, 0.15), 0.4)
    if kind == "beside":
        at = (0.5 * span, float(np.sign(offset) * rng.uniform(0.5, 0.9)))
        velocity = (rng.uniform(0.0, 1.0), 0.0)
    elif kind == "crossing":
        side, speed = float(rng.choice([-1, 1])), rng.uniform(0.6, 1.2)
        meet = 0.6 * horizon * DT * rng.uniform(0.8, 1.2)
        at, velocity = (1.2 * span / 2 + 0.5, side * speed * meet), (0.0, -side * speed)
    elif kind == "elongated":
        Sigma = rotated((0.4, 0.08), rng.uniform(0.0, np.pi))
    x0 = np.array([0.0, rng.uniform(1.6, 2.2), rng.uniform(-0.1, 0.1), rng.uniform(-0.2, 0.2)])
    return Instance(
        f"{kind}-N{horizon}-{inflation}-s{s_min:.1f}-{seed}",
        problem(horizon, inflation, s_min),
        x0,
        straight_reference(horizon),
        [obstacle(horizon, at, velocity, Sigma)],
    )
