"""Nonlinear robots on their way past obstacles: instances for the tests of convergence."""

from dataclasses import dataclass

import numpy as np
from instances import rotated

from scp_mpc import Margin, ObstaclePrediction, Problem
from scp_mpc.models import (
    FunctionModel,
    KinematicBicycle,
    Model,
    PlanarQuadrotor,
    Quadrotor,
    Unicycle,
)

DT = 0.15
SIZE = 2.0
KINDS = ("ahead", "beside", "crossing", "elongated")
DRAG = 0.3


def dragged(x, u):
    """A point mass whose drag grows with the square of its speed."""
    speed = np.sqrt(0.01 + x[..., 2:3] ** 2 + x[..., 3:] ** 2)
    return np.concatenate([x[..., 2:], u - DRAG * speed * x[..., 2:]], axis=-1)


MODELS = {
    "unicycle": (Unicycle(DT), [1.0, 1.0, 0.1, 0.1], [0.1, 0.1], [2.0, 2.0]),
    "bicycle": (
        KinematicBicycle(DT, wheelbase=1.0, rear=0.5),
        [1.0, 1.0, 0.1, 0.1, 0.01],
        [0.1, 0.1],
        [2.0, 1.5],
    ),
    "planar quadrotor": (
        PlanarQuadrotor(DT),
        [1.0, 1.0, 0.05, 0.1, 0.1, 0.01],
        [0.01, 0.01],
        [6.0, 20.0],
    ),
    "quadrotor": (
        Quadrotor(DT),
        [1.0, 1.0, 1.0, 0.1, 0.1, 0.1, 0.05, 0.05, 0.05],
        [0.01, 0.05, 0.05, 0.05],
        [6.0, 3.0, 3.0, 2.0],
    ),
    "function": (
        FunctionModel(
            dragged, "complex", nx=4, nu=2, dt=DT, position=[0, 1], vectorised=True, substeps=4
        ),
        [1.0, 1.0, 0.1, 0.1],
        [0.1, 0.1],
        [3.0, 3.0],
    ),
}


@dataclass(frozen=True)
class Ride:
    """What one call of the solver is given."""

    name: str
    problem: Problem
    x0: np.ndarray
    x_ref: np.ndarray
    obstacles: list[ObstaclePrediction]


def machine_problem(name: str, horizon: int, **changes) -> Problem:
    """The problem of a robot; `changes` overrules any argument."""
    model, Q, R, room = MODELS[name]
    values = {
        "horizon": horizon,
        "Q": Q,
        "R": R,
        "u_min": model.equilibrium_input - room,
        "u_max": model.equilibrium_input + room,
        "robot_radius": 0.3,
        "margin": Margin.fixed(SIZE),
        "nodes_per_interval": 1,
    }
    if name == "bicycle":
        values |= {"x_min": [-np.inf] * 4 + [-0.8], "x_max": [np.inf] * 4 + [0.8]}
    return Problem(model, **(values | changes))


def straight(model: Model, horizon: int, speed: float = 1.5) -> np.ndarray:
    """A reference along the first axis."""
    positions = np.zeros((horizon + 1, model.dim))
    positions[:, 0] = speed * DT * np.arange(horizon + 1)
    velocities = np.zeros_like(positions)
    velocities[:, 0] = speed
    return model.state(positions, velocities)


def ride(name: str, kind: str, horizon: int, seed: int, **changes) -> Ride:
    """Draw an instance: the robot on its way along the first axis, and one obstacle in its way."""
    rng = np.random.default_rng([horizon, KINDS.index(kind), seed])
    problem = machine_problem(name, horizon, **changes)
    model, span = problem.model, 1.5 * DT * horizon
    i = np.arange(horizon + 1)[:, None]
    at, velocity = np.zeros(model.dim), np.zeros(model.dim)
    at[:2] = 0.6 * span + 0.5, rng.uniform(0.05, 0.3) * rng.choice([-1, 1])
    deviations = (0.1, 0.07)
    if kind == "beside":
        at[:2] = 0.5 * span, np.sign(at[1]) * rng.uniform(0.4, 0.7)
        velocity[0] = rng.uniform(0.0, 0.8)
    elif kind == "crossing":
        velocity[1] = rng.choice([-1, 1]) * rng.uniform(0.6, 1.2)
        at[1] = -velocity[1] * 0.6 * horizon * DT * rng.uniform(0.8, 1.2)
    elif kind == "elongated":
        deviations = (0.25, 0.05)
    Sigma = 0.01 * np.eye(model.dim)
    Sigma[:2, :2] = rotated(deviations, rng.uniform(0, np.pi))
    x_ref = straight(model, horizon)
    x0 = x_ref[0] + rng.normal(size=model.nx) * 0.05
    obstacle = ObstaclePrediction(at + DT * i * velocity, Sigma, 0.25)
    return Ride(f"{name}-{kind}-N{horizon}-{seed}", problem, x0, x_ref, [obstacle])
