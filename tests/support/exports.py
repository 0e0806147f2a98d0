"""Problems of all kinds of robots to export."""

import numpy as np
import pytest

from scp_mpc import (
    CasadiModel,
    DoubleIntegrator,
    JointRisk,
    KinematicBicycle,
    PlanarQuadrotor,
    Problem,
    Settings,
    Unicycle,
)

SETTINGS = Settings(tolerance=1e-7, deadline=0.05)


def drag(**how):
    casadi = pytest.importorskip("casadi")
    x, u = casadi.SX.sym("x", 4), casadi.SX.sym("u", 2)
    speed = casadi.sqrt(x[2] ** 2 + x[3] ** 2 + 0.01)
    rates = casadi.vertcat(x[2:], u - 0.3 * speed * x[2:])
    given = {"dt": 0.2, "position": [0, 1], "velocity": [2, 3], "substeps": 2}
    return CasadiModel(rates, x, u, **given | how)


def discrete():
    casadi = pytest.importorskip("casadi")
    x, u = casadi.SX.sym("x", 5), casadi.SX.sym("u", 2)
    nose = casadi.vertcat(casadi.cos(x[2]), casadi.sin(x[2]))
    after = casadi.vertcat(x[:2] + 0.2 * x[3] * nose, x[2] + 0.2 * x[4], x[3:] + 0.2 * u)
    return CasadiModel(after, x, u, dt=0.2, position=[0, 1], heading=2, discrete=True)


def problem(model, **how):
    given = {"horizon": 6, "Q": np.full(model.nx, 0.1), "R": np.full(model.nu, 0.01)}
    half = 3.0 + 0.0 * model.equilibrium_input
    given |= {"u_min": model.equilibrium_input - half, "u_max": model.equilibrium_input + half}
    return Problem(model, **given | {"robot_radius": 0.15, "max_obstacles": 3} | how)


PROBLEMS = {
    "double": lambda: problem(DoubleIntegrator(0.2), du_max=1.0, x_max=[9, 1.5, 9, 1.5]),
    "twelve": lambda: problem(DoubleIntegrator(0.2), max_obstacles=12, nodes_per_interval=1),
    "space": lambda: problem(DoubleIntegrator(0.2, dim=3), margin=JointRisk(0.05)),
    "alone": lambda: problem(DoubleIntegrator(0.2), max_obstacles=0, nodes_per_interval=1),
    "unicycle": lambda: problem(Unicycle(0.1), discs=[-0.2, 0.2], speed_max=1.0),
    "bicycle": lambda: problem(KinematicBicycle(0.1, 1.0), inflation="axes"),
    "planar": lambda: problem(PlanarQuadrotor(0.1)),
    "drag": lambda: problem(drag()),
}
OWN = {"planar", "drag"}
