"""Users' models in the solver: far from the origin, and with derivatives that are wrong."""

import logging

import casadi as ca
import numpy as np
import pytest

from scp_mpc import (
    MPC,
    SCP,
    CasadiModel,
    DoubleIntegrator,
    FunctionModel,
    KinematicBicycle,
    ObstaclePrediction,
    PlanarQuadrotor,
    Problem,
    Quadrotor,
    Settings,
    Status,
    Unicycle,
)
from scp_mpc.scp.condensing import Condenser

DT, N = 0.1, 15
PLANE = {"dt": DT, "position": [0, 1], "heading": 2}


def rates(x, u):
    return np.array([x[3] * np.cos(x[2]), x[3] * np.sin(x[2]), u[1], u[0]])


def slopes(x, _):
    by_x, by_u = np.zeros((4, 4)), np.zeros((4, 2))
    by_x[0, 2:] = -x[3] * np.sin(x[2]), np.cos(x[2])
    by_x[1, 2:] = x[3] * np.cos(x[2]), np.sin(x[2])
    by_u[3, 0] = by_u[2, 1] = 1.0
    return by_x, by_u


def discrete(x, u):
    return x + DT * rates(x, u)


def symbolic(discrete):
    x, u = ca.SX.sym("x", 4), ca.SX.sym("u", 2)
    g = ca.vertcat(x[3] * ca.cos(x[2]), x[3] * ca.sin(x[2]), u[1], u[0])
    return CasadiModel(x + DT * g if discrete else g, x, u, discrete=discrete, **PLANE)


def plain(function, jacobians, **more):
    return FunctionModel(function, jacobians, nx=4, nu=2, **PLANE, **more)


ROBOTS = {
    "double integrator": lambda: DoubleIntegrator(DT),
    "unicycle": lambda: Unicycle(DT),
    "bicycle": lambda: KinematicBicycle(DT, 2.5),
    "planar quadrotor": lambda: PlanarQuadrotor(DT),
    "quadrotor": lambda: Quadrotor(DT),
    "own Jacobians": lambda: plain(rates, slopes),
    "central": lambda: plain(rates, "central"),
    "complex": lambda: plain(rates, "complex"),
    "central, discrete": lambda: plain(discrete, "central", discrete=True),
    "complex, discrete": lambda: plain(discrete, "complex", discrete=True),
    "CasADi": lambda: symbolic(False),
    "CasADi, discrete": lambda: symbolic(True),
}


def problem(model, radius=0.3):
    weights, idle = np.full(model.nx, 0.02), model.equilibrium_input
    weights[model.position] = 1.0
    reach = np.where(idle > 0, 0.4 * idle, 2.0)
    most = np.full(model.nx, np.inf)
    most[4:] = 0.6 if model.nx == 5 else np.inf  # the bicycle's wheel
    return Problem(
        model, horizon=N, Q=weights, R=np.full(model.nu, 0.05), robot_radius=radius,
        u_min=idle - reach, u_max=idle + reach, x_min=-most, x_max=most,
    )  # fmt: skip


@pytest.mark.parametrize("origin", [(1e6, -1e6, 1e3), (388096.0, 3948996.0, 100.0)])
@pytest.mark.parametrize("name", ROBOTS)
def test_far_from_the_origin_plans_are_the_same(name, origin):
    model = ROBOTS[name]()
    d, scp = model.dim, SCP(problem(model), Settings(deadline=None))

    def plan(o):
        x, goal = np.zeros(model.nx), np.zeros(model.nx)
        x[model.position], goal[model.position] = o, o + np.array([3.0, 0.5, 0.25])[:d]
        x[2 if d == 2 else 6] += 0.125
        ball = ObstaclePrediction.static(N, o + np.array([1.5, 0.125, 0.0])[:d], 0.25)
        return scp.solve(x, goal, [ball])

    here, there = plan(np.zeros(d)), plan(np.array(origin)[:d])
    assert here.status is there.status is Status.CONVERGED
    assert here.iterate.touches
    np.testing.assert_allclose(there.U, here.U, atol=1e-6)
    away = there.X.copy()
    away[:, model.position] -= origin[:d]
    np.testing.assert_allclose(away, here.X, atol=1e-6)


def test_differences_far_from_the_origin_take_no_more_iterations():
    """At the coordinates of a map, a discrete unicycle whose rounded states are differenced."""
    scp = SCP(problem(plain(discrete, "central", discrete=True)), Settings(deadline=None))
    plans = []
    for o in (np.zeros(4), np.array([388096.0, 3948996.0, 0.0, 0.0])):
        ball = ObstaclePrediction.static(N, o[:2] + [1.2, 0.1], 0.3)
        plans.append(scp.solve(o, o + [3.0, 0.4, 0.0, 0.0], [ball]))
    assert [plan.status for plan in plans] == [Status.CONVERGED] * 2
    assert plans[1].iterations <= plans[0].iterations + 1


@pytest.mark.parametrize("push", [0.0, 1.0])
@pytest.mark.parametrize("origin", [(0.0, 0.0), (388096.0, 3948996.0)])
def test_a_push_is_a_push_wherever_the_origin_is(push, origin, monkeypatch):
    """A metre is 1e-6 of a map's coordinates, and yet the robot is not where its plan has it."""
    tracked, tracking = [], Condenser.tracking
    monkeypatch.setattr(Condenser, "tracking", lambda *given: tracked.append(1) or tracking(*given))
    model, o = Unicycle(DT), np.array([*origin, 0.0, 0.0])
    mpc, goal = MPC(problem(model), Settings(deadline=None)), o + [3.0, 0.5, 0.0, 0.0]
    x = model.step(o, mpc.step(o, goal).u0)
    mpc.step(x + [0.0, push, 0.0, 0.0], goal)
    assert bool(tracked) == bool(push)


@pytest.mark.parametrize(("sign", "warned"), [(-1.0, 1), (1.0, 0)])
def test_a_wrong_jacobian_is_suspected_once(sign, warned, caplog):
    def given(x, u):
        by_x, by_u = slopes(x, u)
        by_x[1, 2] *= sign
        return by_x, by_u

    model = plain(rates, given)
    mpc, x = MPC(problem(model), Settings(deadline=None)), np.array([0.0, 0.0, 0.1, 0.0])
    with caplog.at_level(logging.WARNING, logger="scp_mpc"):
        for _ in range(4):
            x = model.step(x, mpc.step(x, [3.0, 1.0, 0.0, 0.0]).u0)
    assert len([r for r in caplog.records if "Jacobians" in r.getMessage()]) == warned
