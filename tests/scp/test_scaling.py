"""The answer depends on the problem, not on its origin, its units or the size of its weights."""

import numpy as np
import pytest
from instances import DT, obstacle, problem, straight_reference

from scp_mpc import MPC, ObstaclePrediction, Status

N = 20


def drive(case, x0, reference, obstacles, steps=8):
    mpc, x = MPC(case), np.array(x0)
    for _ in range(steps):
        plan = mpc.step(x, reference, obstacles)
        assert plan.status is Status.CONVERGED, plan.kkt
        x = case.model.step(x, plan.u0)
    return plan


@pytest.mark.parametrize("inflation", ["exact", "axes"])
@pytest.mark.parametrize("origin", [500.0, -1e3, 1e5])
def test_the_origin_does_not_matter(inflation, origin):
    case, ref = problem(N, inflation), straight_reference(N)
    shift = np.array([origin, 0.0, -origin, 0.0])
    here = drive(case, ref[0], ref, [obstacle(N, (3.0, 0.2))])
    there = drive(case, ref[0] + shift, ref + shift, [obstacle(N, (3.0 + origin, 0.2 - origin))])
    np.testing.assert_allclose(there.X - shift, here.X, atol=1e-5)
    assert there.cost == pytest.approx(here.cost, rel=1e-6)


@pytest.mark.parametrize("factor", [1e-3, 50.0, 1e4])
def test_the_size_of_the_weights_does_not_matter(factor):
    ref, Q, R = straight_reference(N), np.array([0.2, 0.05, 0.2, 0.05]), np.array([0.01, 0.01])
    plain = drive(problem(N, Q=Q, R=R), ref[0], ref, [obstacle(N, (3.0, 0.2))])
    scaled = drive(problem(N, Q=factor * Q, R=factor * R), ref[0], ref, [obstacle(N, (3.0, 0.2))])
    np.testing.assert_allclose(scaled.X, plain.X, atol=1e-2)
    assert scaled.cost == pytest.approx(factor * plain.cost, rel=1e-3)


def test_millimetres_do_as_well_as_metres():
    """Positions, radii and bounds in millimetres, weights per square millimetre."""
    ref = straight_reference(N)
    Q = np.array([0.2, 0.05, 0.2, 0.05])
    metres = drive(problem(N, Q=Q, R=[0.01, 0.01]), ref[0], ref, [obstacle(N, (3.0, 0.2))])
    case = problem(
        N,
        Q=Q * 1e-6,
        R=[0.01e-6, 0.01e-6],
        u_min=-3e3,
        u_max=3e3,
        robot_radius=150.0,
    )
    there = ObstaclePrediction(
        1e3 * np.tile([3.0, 0.2], (N + 1, 1)),
        1e6 * obstacle(N, (3.0, 0.2)).covariances,
        200.0,
    )
    millimetres = drive(case, 1e3 * ref[0], 1e3 * ref, [there])
    np.testing.assert_allclose(millimetres.X / 1e3, metres.X, atol=1e-2)


@pytest.mark.parametrize("distance", [30.0, 300.0])
def test_a_goal_far_away_is_driven_to_at_full_throttle(distance):
    case = problem(N, Q=[10.0, 1.0, 10.0, 1.0], R=[0.1, 0.1])
    plan = drive(case, np.zeros(4), np.array([distance, 0.0, 0.0, 0.0]), [])
    assert plan.u0[0] == pytest.approx(3.0)
    assert plan.X[0, 0] > 0.9 * 3.0 * (7 * DT) ** 2 / 2
