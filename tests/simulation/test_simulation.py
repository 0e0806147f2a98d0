"""The closed loop: the report's scenarios, reproducible from a seed."""

import numpy as np
import pytest

from scp_mpc import MPC, CircularReference, Status
from scp_mpc.report import centre_distances, no_go_clearances
from scp_mpc.simulation import SCENARIOS, CorrelatedDisturbance


def test_the_four_scenarios_are_the_reports():
    assert [s.horizon for s in SCENARIOS.values()] == [30, 8, 8, 30]
    assert [s.disturbance is not None for s in SCENARIOS.values()] == [False, False, True, True]
    for scenario in SCENARIOS.values():
        np.testing.assert_allclose(scenario.start(), [8, 0, 0, 4.16])
        problem = scenario.problem()
        assert problem.inflation == "axes"
        assert problem.margin.lower == problem.margin.reference
        assert (problem.u_min == -3).all()
        assert (problem.u_max == 3).all()
        np.testing.assert_array_equal(problem.Q, np.diag([0.2, 0.05, 0.2, 0.05]))
        np.testing.assert_array_equal(problem.R, np.diag([0.001, 0.001]))
        margin = problem.margin
        assert (margin.reference**2, margin.upper, margin.weight) == pytest.approx(
            (5.991, 10, 0.005)
        )
        assert problem.robot_radius + scenario.obstacle.radius == pytest.approx(0.35)


def test_reference_velocity_is_the_derivative_of_its_position():
    states = CircularReference().states(1.0, 1000, 1e-4)
    for position, velocity in ((0, 1), (2, 3)):
        slope = np.gradient(states[:, position], 1e-4)
        np.testing.assert_allclose(states[1:-1, velocity], slope[1:-1], atol=1e-5)


def test_disturbance_has_the_reports_correlation():
    wind = CorrelatedDisturbance().samples(np.random.default_rng(0))
    w = np.array([next(wind) for _ in range(100_000)])
    assert not w[:, [0, 2]].any()
    stationary = 0.08 / np.sqrt(1 - 0.85**2)
    np.testing.assert_allclose(w[:, [1, 3]].std(axis=0), stationary, rtol=0.03)
    np.testing.assert_allclose(
        [np.corrcoef(w[1:, a], w[:-1, a])[0, 1] for a in (1, 3)], 0.85, atol=0.01
    )


def test_same_seed_same_bits_and_another_seed_another_wind():
    scenario = SCENARIOS["scenario-3"]
    runs = [scenario.run(steps=40, seed=seed) for seed in (1, 1, 2)]
    assert [run.seed for run in runs] == [1, 1, 2]
    np.testing.assert_array_equal(runs[0].states, runs[1].states)
    np.testing.assert_array_equal(runs[0].inputs, runs[1].inputs)
    assert np.abs(runs[0].states - runs[2].states).max() > 0.01


@pytest.mark.parametrize("inflation", ["axes", "exact"])
def test_the_robot_passes_the_obstacle(inflation):
    """Scenario 2 over the first encounter: certified at every step, clear of the no-go set."""
    scenario = SCENARIOS["scenario-2"]
    ticks = []
    mpc = MPC(scenario.problem(inflation))
    run = scenario.run(mpc, steps=60, advance=lambda: ticks.append(1))
    assert len(ticks) == run.steps == 60
    assert {plan.status for plan in run.plans} == {Status.CONVERGED}
    assert run.scene is scenario
    assert no_go_clearances(run).min() > 0
    assert centre_distances(run).min() > 0.35
    assert run.clearances.min() > 0
    assert run.tracking_errors.max() > 0.2  # it did have to give way
    assert run.tracking_errors[5] < 0.1
    assert run.states.shape == (61, 4)
    np.testing.assert_allclose(run.times[-1], 12.0)
    for k in (0, 17, 59):
        np.testing.assert_array_equal(run.predictions[k][0].means[0], run.bodies[k, 0])
        np.testing.assert_array_equal(run.plans[k].X[0], run.states[k])
        np.testing.assert_allclose(run.bodies[k, 0], scenario.obstacle.position(0.2 * k))


def test_long_horizon_passes_rather_than_trails():
    """Keeping to one side trails behind the obstacle for seconds; passing does not."""
    run = SCENARIOS["scenario-1"].run(steps=60)
    assert {plan.status for plan in run.plans} == {Status.CONVERGED}
    assert run.tracking_errors.max() < 5.0
    assert run.tracking_errors[-1] < 0.5


def test_a_gust_that_closes_one_way_does_not_cost_safety_while_another_is_open():
    """Around step 245 the controller's own way is closed; a longer one is not."""
    run = SCENARIOS["scenario-4"].run(steps=255)
    assert all(plan.ok for plan in run.plans[100:])
    assert any(plan.switched for plan in run.plans[240:250])
