"""Copies of controllers: they go on as the original would."""

import copy
import pickle

import numpy as np
import pytest

from scp_mpc import (
    MPC,
    SCP,
    DisturbanceEstimator,
    Disturbed,
    DoubleIntegrator,
    ObstaclePrediction,
    Problem,
    Settings,
    Unicycle,
    WindAwareMPC,
)


@pytest.mark.parametrize("twin", [copy.deepcopy, lambda mpc: pickle.loads(pickle.dumps(mpc))])
@pytest.mark.parametrize("model", [DoubleIntegrator(0.2), Unicycle(0.2)])
def test_a_copy_goes_on_from_the_same_plan(model, twin):
    problem = Problem(model, horizon=10, Q=[1, 1, 0.1, 0.1], R=[0.1, 0.1], u_min=-2.0, u_max=2.0)
    mpc, x = MPC(problem, Settings(deadline=None)), np.zeros(4)
    goal = model.state(np.array([3.0, 0.5]), np.zeros(2))
    ball = ObstaclePrediction.static(10, [1.5, 0.3], 0.3)
    for _ in range(4):
        x = model.step(x, mpc.step(x, goal, [ball]).u0)
    other = twin(mpc)
    for _ in range(3):
        plan, same = mpc.step(x, goal, [ball]), other.step(x, goal, [ball])
        np.testing.assert_allclose(same.U, plan.U, atol=1e-9)
        assert same.status is plan.status
        x = model.step(x, plan.u0)
    assert other.counts == mpc.counts


def test_a_copy_of_a_solver_solves_the_same():
    model = DoubleIntegrator(0.2)
    scp = SCP(Problem(model, horizon=8, Q=[1, 1, 1, 1], R=[1, 1], u_min=-1.0, u_max=1.0))
    given = np.zeros(4), np.array([1.0, 0.0, 2.0, 0.0])
    np.testing.assert_array_equal(
        pickle.loads(pickle.dumps(scp)).solve(*given).U, scp.solve(*given).U
    )


def test_a_copy_against_the_wind_goes_on_with_what_it_felt():
    model = DoubleIntegrator(0.2)
    problem = Problem(model, horizon=8, Q=[1, 1, 1, 1], R=[1, 1], u_min=-1.0, u_max=1.0)
    new = lambda: WindAwareMPC(problem, DisturbanceEstimator(Disturbed(model), std=0.1))  # noqa: E731
    mpc, x = new(), np.zeros(4)
    for _ in range(3):
        x = model.step(x, mpc.step(x, np.ones(4)).u0) + [0.0, 0.1, 0.0, 0.0]
    other = copy.deepcopy(mpc)
    np.testing.assert_allclose(other.step(x, np.ones(4)).U, mpc.step(x, np.ones(4)).U, atol=1e-12)
    assert not np.allclose(mpc.step(x, np.ones(4)).u0, new().step(x, np.ones(4)).u0)
