"""Shifting a plan by one stage."""

import numpy as np
import pytest
from instances import problem, straight_reference

from scp_mpc import MPC, SCP, DoubleIntegrator, Iterate, ShapeError, Trajectory
from scp_mpc.scp import Multipliers
from scp_mpc.trajectory import rollout

N, M = 5, 2


@pytest.fixture
def iterate():
    rng = np.random.default_rng(0)
    duals = Multipliers(*(rng.normal(size=s) for s in ((N, 4), (N, 2), (M,), (M, N), (M, N))))
    return Iterate(
        rng.normal(size=(N + 1, 4)),
        rng.normal(size=(N, 2)),
        rng.normal(size=M),
        rng.uniform(size=(M, N)),
        duals,
    )


def test_every_part_moves_one_stage_earlier(iterate):
    model = DoubleIntegrator(0.2)
    later = iterate.shifted(model)
    np.testing.assert_array_equal(later.states[:-1], iterate.states[1:])
    np.testing.assert_array_equal(
        later.states[-1], model.A @ iterate.states[-1] + model.B @ iterate.inputs[-1]
    )
    np.testing.assert_array_equal(later.inputs, iterate.inputs[[1, 2, 3, 4, 4]])
    np.testing.assert_array_equal(later.s, iterate.s)
    np.testing.assert_array_equal(later.slack, iterate.slack[:, [1, 2, 3, 4, 4]])
    old, new = iterate.multipliers, later.multipliers
    np.testing.assert_array_equal(new.dynamics, old.dynamics[[1, 2, 3, 4, 4]])
    np.testing.assert_array_equal(new.inputs, old.inputs[[1, 2, 3, 4, 4]])
    np.testing.assert_array_equal(new.margin, old.margin)
    np.testing.assert_array_equal(new.obstacles, old.obstacles[:, [1, 2, 3, 4, 4]])
    np.testing.assert_array_equal(new.slack, old.slack[:, [1, 2, 3, 4, 4]])


def test_the_shifted_rest_of_a_plan_obeys_the_dynamics():
    """The end state is new, everything before it was planned."""
    mpc = MPC(problem(N))
    assert mpc.nominal() is None
    ref = straight_reference(N)
    plan = mpc.step(ref[0], ref + [0, 0, 1, 0])
    nominal = mpc.nominal()
    model = mpc.problem.model
    for i in range(N):
        expected = model.step(nominal.states[i], nominal.inputs[i])
        np.testing.assert_allclose(nominal.states[i + 1], expected, atol=1e-9)
    np.testing.assert_array_equal(nominal.states[0], plan.X[1])


def test_a_plan_with_a_bounded_speed_is_a_guess():
    bounded = problem(N, speed_max=1.0)
    ref = straight_reference(N)
    first = SCP(bounded).solve(0 * ref[0], ref)
    again = SCP(bounded).solve(0 * ref[0], ref, guess=first.iterate)
    np.testing.assert_allclose(again.X, first.X, atol=1e-6)
    assert again.iterations <= first.iterations


def test_rollout_applies_the_inputs():
    path = rollout(DoubleIntegrator(0.5).step, np.zeros(4), [[1.0, 0.0], [-1.0, 2.0]])
    np.testing.assert_allclose(path.states[-1], [0.25, 0.0, 0.25, 1.0])


def test_a_trajectory_of_mismatched_lengths_is_refused():
    with pytest.raises(ShapeError, match="4 states do not belong to 4 inputs"):
        Trajectory(np.zeros((4, 4)), np.zeros((4, 2)))
