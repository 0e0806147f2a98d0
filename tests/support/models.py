"""The robots that the tests of models share, and ordinary states and inputs of each."""

import numpy as np

from scp_mpc.models import (
    DoubleIntegrator,
    FunctionModel,
    KinematicBicycle,
    Model,
    PlanarQuadrotor,
    Quadrotor,
    Unicycle,
)

DT = 0.2


def unicycle_rates(x, u):
    """The unicycle as a user would write it, over any leading axes."""
    theta, v = x[..., 2], x[..., 3]
    parts = (v * np.cos(theta), v * np.sin(theta), u[..., 1], u[..., 0])
    return np.stack(parts, axis=-1)


def unicycle_slopes(x, _):
    theta, v = x[2], x[3]
    by_x, by_u = np.zeros((4, 4)), np.zeros((4, 2))
    by_x[0, 2], by_x[0, 3] = -v * np.sin(theta), np.cos(theta)
    by_x[1, 2], by_x[1, 3] = v * np.cos(theta), np.sin(theta)
    by_u[3, 0] = by_u[2, 1] = 1.0
    return by_x, by_u


def discrete(x, u):
    """A Euler step of the same."""
    return x + DT * unicycle_rates(x, u)


PLANE = {"nx": 4, "nu": 2, "dt": DT, "position": [0, 1], "heading": 2}
OWN: dict[str, Model] = {
    "unicycle": Unicycle(DT),
    "bicycle": KinematicBicycle(DT, 2.5),
    "bicycle, middle": KinematicBicycle(DT, 2.5, rear=1.25, substeps=2),
    "planar quadrotor": PlanarQuadrotor(DT),
    "quadrotor": Quadrotor(DT, substeps=2),
}
MODELS: dict[str, Model] = {
    "double integrator": DoubleIntegrator(DT),
    **OWN,
    "function": FunctionModel(unicycle_rates, unicycle_slopes, **PLANE),
    "function, complex": FunctionModel(unicycle_rates, "complex", vectorised=True, **PLANE),
    "function, central": FunctionModel(unicycle_rates, "central", vectorised=True, **PLANE),
    "function, discrete": FunctionModel(
        discrete, "complex", vectorised=True, discrete=True, **PLANE
    ),
}


def draw(model: Model, rng: np.random.Generator, shape: tuple[int, ...] = ()):
    """States and inputs well inside what the robot may do."""
    return (
        rng.uniform(-1.2, 1.2, (*shape, model.nx)),
        model.equilibrium_input + rng.uniform(-1.0, 1.0, (*shape, model.nu)),
    )
