"""Extrapolating the linearisation point: exact on a line, safeguarded, and it gets there sooner."""

import numpy as np
import pytest
from instances import KINDS, S_REF, instance

from scp_mpc import SCP, Iterate, Settings, Status, Trajectory
from scp_mpc.solver.acceleration import Anderson

POSITION = np.array([0, 2])


def iterate(positions, s=2.0):
    """An iterate with the given positions (N, 2) from stage 1 on."""
    states = np.zeros((len(positions) + 1, 4))
    states[1:, POSITION] = positions
    return Iterate(states, np.zeros((len(positions), 2)), np.array([s]), np.zeros((1, 3)))


def test_one_extrapolation_finds_the_limit_of_a_geometric_sequence():
    limit, error = np.array([[1.0, -2.0], [0.5, 3.0]]), np.array([[0.3, 0.1], [-0.2, 0.4]])
    points = [iterate(limit + 0.8**k * error, s=2.0 + 0.8**k) for k in range(3)]
    acceleration = Anderson(points[0], POSITION)
    for image in points[1:]:
        assert acceleration.propose(image) is None
        acceleration.learn(image)
    proposal = acceleration.propose(points[2])
    np.testing.assert_allclose(proposal.states[1:, POSITION], limit, atol=1e-12)
    np.testing.assert_allclose(proposal.s, 2.0, atol=1e-12)
    assert not proposal.states[:, [1, 3]].any()
    np.testing.assert_array_equal(points[2].states[1:, POSITION], limit + 0.64 * error)


def test_a_growing_residual_is_not_extrapolated():
    points = [iterate(np.array([[float(2**k), 0.0]])) for k in range(3)]
    acceleration = Anderson(points[0], POSITION)
    for image in points[1:]:
        acceleration.learn(image)
    assert acceleration.propose(points[2]) is None


def test_a_rejected_proposal_is_forgotten():
    points = [iterate(np.array([[0.5**k, 0.0]])) for k in range(5)]
    acceleration = Anderson(points[0], POSITION)
    acceleration.learn(points[1])
    acceleration.learn(points[2])
    assert acceleration.propose(points[2]) is not None
    acceleration.reject()
    assert acceleration.propose(points[2]) is None
    acceleration.learn(points[3])  # from where the plain sequence stood
    assert acceleration.propose(points[3]) is None
    acceleration.learn(points[4])
    proposal = acceleration.propose(points[4])
    np.testing.assert_allclose(proposal.states[1, 0], 0.0, atol=1e-12)


@pytest.mark.parametrize("inflation", ["exact", "axes"])
def test_accelerated_and_plain_reach_the_same_optimum_the_former_sooner(inflation):
    counts = {True: 0, False: 0}
    for kind in KINDS:
        for seed in range(3):
            case = instance(kind, 20, inflation, S_REF, seed)
            guess = Trajectory(case.x_ref, np.zeros((20, 2)))
            plans = {}
            for bold in (True, False):
                settings = Settings(
                    multi_start=False, condense=False, max_iterations=300, acceleration=bold
                )
                solver = SCP(case.problem, settings)
                plans[bold] = solver.solve(case.x0, case.x_ref, case.obstacles, guess)
                assert plans[bold].status is Status.CONVERGED
                counts[bold] += sum(plans[bold].qps.values())
            assert plans[True].cost == pytest.approx(plans[False].cost, rel=1e-6)
            np.testing.assert_allclose(plans[True].X, plans[False].X, atol=1e-2)
    assert counts[True] < 0.75 * counts[False]
