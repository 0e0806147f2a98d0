"""The sequential convex programming: optimal, feasible at every iterate, warm, and honest."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from instances import DT, KINDS, S_REF, instance, obstacle, problem, straight_reference
from judge import judge as judged

from scp_mpc import (
    SCP,
    DoubleIntegrator,
    ObstaclePrediction,
    Polytope,
    QPSettings,
    Settings,
    Status,
    Trajectory,
)
from scp_mpc.qp.osqp import OSQP
from scp_mpc.scp import KKTResiduals
from scp_mpc.scp.plan import Result, judge

KEEP_SIDE = Settings(multi_start=False, deadline=None)
SOLVERS = pytest.mark.parametrize("solver", ["osqp", "piqp"])


def test_no_obstacle_equals_the_riccati_solution():
    N, model = 20, DoubleIntegrator(DT)
    Q, R, Qf = np.diag([0.2, 0.05, 0.2, 0.05]), 0.01 * np.eye(2), np.diag([4.0, 1.0, 2.0, 1.0])
    free = problem(N, R=[0.01, 0.01], Qf=Qf, u_min=-1e3, u_max=1e3)
    x = np.array([1.0, -0.5, 0.3, 0.2])
    plan = SCP(free).solve(x, np.zeros(4))
    A, B, S = model.A, model.B, Qf
    gains = []
    for _ in range(N):
        K = np.linalg.solve(R + B.T @ S @ B, B.T @ S @ A)
        S = Q * (len(gains) < N - 1) + A.T @ S @ (A - B @ K)
        gains.append(K)
    cost = x @ S @ x
    for i, K in enumerate(reversed(gains)):
        np.testing.assert_allclose(plan.U[i], -K @ x, atol=1e-7)
        x = A @ x - B @ K @ x
        np.testing.assert_allclose(plan.X[i + 1], x, atol=1e-7)
    assert plan.cost == pytest.approx(cost, rel=1e-9)
    assert plan.status is Status.CONVERGED
    assert sum(plan.qps.values()) == 1


def test_a_step_without_active_obstacle_takes_one_program():
    case = problem(20)
    far = [obstacle(20, (0.0, 50.0))]
    solver = SCP(case)
    ref = straight_reference(20)
    first = solver.solve(ref[0], ref, far)
    assert first.qps == {"kkt": 1}
    assert first.iterations == 0
    assert first.status is Status.CONVERGED
    assert not first.multipliers.obstacles.any()
    moved = ref[0] + [0.0, 0.1, 0.0, 0.0]
    second = solver.solve(moved, ref, far, first.iterate)
    assert second.iterations == 0
    assert second.qps == {"kkt": 1}
    assert not second.multipliers.obstacles.any()


@SOLVERS
def test_input_bounds_alone_take_one_program(solver):
    case = problem(20)
    plan = SCP(case, Settings(solver=solver)).solve(
        np.zeros(4), np.array([30.0, 0.0, 0.0, 0.0]), [obstacle(20, (0.0, 50.0))]
    )
    assert sum(plan.qps.values()) == 1
    assert set(plan.qps) <= {solver, "repaired"}
    assert plan.status is Status.CONVERGED
    assert plan.U[0, 0] == 3.0


@pytest.mark.parametrize("kind", KINDS)
def test_exact_iterates_stay_feasible_and_costs_never_rise(kind):
    """The convex-concave argument: sound half-spaces, tight at the nominal point."""
    case = instance(kind, 20, "exact", 0.5, 0)
    for limit in (1, 2, 4):
        solver = SCP(
            case.problem, Settings(multi_start=False, max_iterations=limit, tolerance=1e-7)
        )
        guess = Trajectory(case.x_ref, np.zeros((20, 2)))
        costs = []
        for _ in range(6):
            plan = solver.solve(case.x0, case.x_ref, case.obstacles, guess)
            assert plan.ok, plan.status
            assert plan.kkt.feasibility < 1e-7
            costs.append(plan.cost)
            guess = plan.iterate
        assert all(b <= a + 1e-7 for a, b in pairwise(costs))


@pytest.mark.parametrize("inflation", ["exact", "axes"])
def test_plans_obey_the_dynamics_the_bounds_and_the_no_go_sets(inflation):
    case = instance("ahead", 30, inflation, S_REF, 1)
    plan = SCP(case.problem).solve(case.x0, case.x_ref, case.obstacles)
    model = case.problem.model
    for i in range(30):
        defect = plan.X[i + 1] - model.step(plan.X[i], plan.U[i])
        assert np.abs(defect).max() < 1e-7
    assert (np.abs(plan.U) <= 3.0).all()
    assert plan.s[0] >= S_REF
    prediction = case.obstacles[0]
    for i in range(1, 31):
        variances, R = np.linalg.eigh(prediction.covariances[i])
        y = R.T @ (plan.X[i, [0, 2]] - prediction.means[i])
        semi = S_REF * np.sqrt(variances) + 0.35
        assert np.linalg.norm(y / semi) >= 1 - 1e-6  # both sets contain the report's ellipse


@pytest.mark.parametrize("kind", ["ahead", "elongated"])
def test_warm_start_cuts_qp_iterations(kind, monkeypatch):
    """From the shifted plan with its multipliers, OSQP needs a fraction of the cold count.

    Counted in runs of two iterations: the default ones of ten are too coarse to tell.
    """
    counts, run = [], OSQP.run

    def counting(self, effort):
        counts.append(effort)
        return run(self, effort)

    monkeypatch.setattr(OSQP, "run", counting)
    case = instance(kind, 30, "exact", S_REF, 1)
    short = QPSettings(rho=(10.0,), iterations=(2,) * 100, repairs=(1,) * 100, rescue=False)
    solver = SCP(case.problem, Settings(multi_start=False, qp=short))
    plan = solver.solve(case.x0, case.x_ref, case.obstacles)
    cold = sum(counts)
    counts.clear()
    x, there = case.problem.model.step(case.x0, plan.u0), case.obstacles[0]
    moved = replace(there, means=there.means + there.means[1] - there.means[0])
    guess = plan.iterate.shifted(case.problem.model)
    again = solver.solve(x, case.x_ref + [0.4, 0, 0, 0], [moved], guess)
    warm = sum(counts)
    assert plan.status is again.status is Status.CONVERGED
    assert 0 < warm < cold / 2


def test_more_tolerance_takes_fewer_programs():
    case = instance("ahead", 30, "exact", S_REF, 0)
    counts = []
    for tolerance in (1e-3, 1e-6):
        solver = SCP(case.problem, Settings(multi_start=False, tolerance=tolerance))
        plan = solver.solve(case.x0, case.x_ref, case.obstacles)
        assert plan.kkt.worst <= tolerance
        counts.append(plan.iterations)
    assert counts[0] < counts[1]


def blocked():
    """A robot within an obstacle's no-go set, that leaves it."""
    case = problem(8)
    standing = [obstacle(8, (1.2, 0.05), covariance=np.eye(2), growth=0.0)]
    return case, np.zeros(4), straight_reference(8, -4.0), standing


def test_what_cannot_be_avoided_is_softened_and_said_so():
    case, x0, ref, obstacles = blocked()
    plan = SCP(case).solve(x0, ref, obstacles)
    assert plan.status is Status.SOFTENED
    assert not plan.ok
    assert plan.slack.max() > 0.1
    # The slack is the true violation, stage by stage.
    distances = judged(case, x0, ref, obstacles, plan).distances
    np.testing.assert_allclose(np.maximum(0.0, -distances), plan.slack, atol=1e-6)
    assert plan.kkt.worst <= 1e-6
    assert (np.abs(plan.multipliers.obstacles) <= case.slack_weight * (1 + 1e-9)).all()


def test_slack_is_exactly_zero_where_a_plan_exists():
    case = instance("crossing", 20, "exact", S_REF, 1)
    plan = SCP(case.problem).solve(case.x0, case.x_ref, case.obstacles)
    assert plan.ok
    assert plan.slack.max() <= 1e-9


def test_running_out_of_iterations_is_said_so():
    case = instance("ahead", 30, "exact", S_REF, 0)
    hurried = SCP(case.problem, Settings(multi_start=False, max_iterations=1))
    plan = hurried.solve(case.x0, case.x_ref, case.obstacles)
    assert plan.status is Status.FEASIBLE
    assert plan.ok
    assert plan.kkt.worst > 1e-6


DEAD = Settings(deadline=None, qp=QPSettings(iterations=(1,), repairs=(0,), rescue=False))


def test_without_any_solution_the_robot_brakes_within_limits():
    """Too fast to stop in time: that is said, with the true violation."""
    case = instance("ahead", 8, "exact", S_REF, 0)
    x0 = case.x0 + [0.0, 3.0, 0.0, 0.0]
    guess = Trajectory(case.x_ref, np.tile([7.0, 0.0], (8, 1)))
    plan = SCP(case.problem, DEAD).solve(x0, case.x_ref, case.obstacles, guess)
    assert plan.status is Status.FALLBACK
    assert not plan.ok
    # Straight ahead, at the limit of the first axis; the second one's share keeps the direction.
    np.testing.assert_allclose(plan.u0, -3.0 * x0[[1, 3]] / x0[1])
    np.testing.assert_array_equal(plan.X[0], x0)
    assert plan.kkt.stationarity == np.inf
    assert plan.kkt.feasibility == plan.slack.max()
    distances = judged(case.problem, x0, case.x_ref, case.obstacles, plan).distances
    assert distances.min() < -0.01
    np.testing.assert_allclose(plan.slack, np.maximum(0.0, -distances), atol=1e-12)
    assert plan.multipliers is None


def test_without_any_solution_a_guess_that_is_clear_is_kept_else_braking():
    case = instance("ahead", 8, "exact", S_REF, 0)
    solver = SCP(case.problem, DEAD)
    aside = Trajectory(case.x_ref, np.tile([-2.0, 1.0], (8, 1)))
    kept = solver.solve(case.x0, case.x_ref, case.obstacles, aside)
    assert kept.status is Status.PREVIOUS
    assert kept.ok
    np.testing.assert_array_equal(kept.U, aside.inputs)
    onto = Trajectory(case.x_ref, np.tile([3.0, 0.0], (8, 1)))
    braking = solver.solve(case.x0, case.x_ref, case.obstacles, onto)
    assert braking.status is Status.BRAKING
    assert braking.ok
    speed = np.linalg.norm(braking.X[:, [1, 3]], axis=1)
    assert (np.diff(speed) <= 1e-12).all()
    assert speed[-1] == pytest.approx(0.0, abs=1e-12)


def far_side():
    """A guess that passes an obstacle on the longer way round."""
    case, ref = problem(30, "exact"), straight_reference(30, 2.0)
    beside = [obstacle(30, (3.0, 0.3), (0.3, 0.0), 0.1 * np.eye(2))]
    path = ref.copy()
    path[1:, 2] = 2.0
    return case, ref, beside, Trajectory(path, np.zeros((30, 2)))


def test_other_sides_are_tried_and_never_cost_more():
    """From a guess on the far side of the obstacle, the near side is better."""
    case, ref, slow, guess = far_side()
    kept = SCP(case, KEEP_SIDE).solve(ref[0], ref, slow, guess)
    best = SCP(case).solve(ref[0], ref, slow, guess)
    assert kept.candidates == ()
    assert best.switched
    past = [c for c in best.candidates if c.side[1] != 0]
    ways = {(c.obstacle, tuple(np.sign(c.side[1:])), c.time) for c in past}
    assert len(ways) == len(past) == 8
    assert len(best.candidates) == 9  # one stays in front
    assert best.status is Status.CONVERGED
    assert best.cost < 0.8 * kept.cost


def test_cost_reported_is_the_cost_of_the_plan():
    case = instance("elongated", 20, "axes", 0.5, 1)
    plan = SCP(case.problem).solve(case.x0, case.x_ref, case.obstacles)
    Q, R, margin = case.problem.Q, case.problem.R, case.problem.margin
    cost = margin.weight * (plan.s[0] - margin.reference) ** 2
    for i in range(20):
        error = plan.X[i + 1] - case.x_ref[i + 1]
        cost += error @ Q @ error + plan.U[i] @ R @ plan.U[i]
    assert plan.cost == pytest.approx(cost, rel=1e-12)


def test_several_obstacles_have_a_size_each():
    case = problem(20, "exact", 0.5, max_obstacles=3)
    ref = straight_reference(20)
    two = [obstacle(20, (2.5, 0.1)), obstacle(20, (5.0, -0.3), (-0.2, 0.0))]
    plan = SCP(case).solve(ref[0], ref, two)
    assert plan.status is Status.CONVERGED
    assert plan.s.shape == (2,)
    assert plan.slack.shape == (2, 20)
    swapped = SCP(case).solve(ref[0], ref, two[::-1], plan.iterate)
    assert swapped.cost == pytest.approx(plan.cost, rel=1e-4)


def test_three_dimensions():
    model = DoubleIntegrator(0.1, dim=3)
    case = problem(15, model=model, Q=[1.0, 0.1] * 3, R=[0.01] * 3)
    ref = np.zeros((16, 6))
    ref[:, 0], ref[:, 1] = 0.2 * np.arange(16), 2.0
    ball = ObstaclePrediction(np.tile([1.5, 0.02, 0.05], (16, 1)), 0.01 * np.eye(3), 0.2)
    plan = SCP(case).solve(ref[0], ref, [ball])
    assert plan.ok
    distance = np.linalg.norm(plan.X[1:, [0, 2, 4]] - ball.means[1:], axis=1)
    assert distance.min() == pytest.approx(S_REF * 0.1 + 0.35, abs=1e-6)


def test_a_rival_that_breaks_down_does_not_lose_the_plan(monkeypatch):
    """The incumbent stands if following the rival fails."""
    case, ref, slow, guess = far_side()
    kept = SCP(case, KEEP_SIDE).solve(ref[0], ref, slow, guess)
    broken = SCP(case)
    run, calls = broken._loop.run, []

    def breaking(nominal, goal=None, *about, **hard):
        calls.append(goal)
        return run(nominal, goal, *about, **hard) if goal is None else None

    monkeypatch.setattr(broken._loop, "run", breaking)
    plan = broken.solve(ref[0], ref, slow, guess)
    assert len(calls) == 2
    assert not plan.switched
    assert plan.ok
    assert plan.cost == kept.cost


def test_a_rival_must_lead_and_safety_comes_first():
    def end(merit, status=Status.CONVERGED):
        return Result(None, merit, merit, KKTResiduals(0.0, 0.0, 0.0), status, 1)

    assert end(0.8).beats(end(1.0), lead=0.1)
    assert not end(0.95).beats(end(1.0), lead=0.1)
    assert end(9.0, Status.FEASIBLE).beats(end(1.0, Status.SOFTENED), lead=5.0)
    assert not end(0.1, Status.SOFTENED).beats(end(9.0), lead=0.0)


@pytest.mark.parametrize("which", range(4))
def test_what_is_not_a_number_is_never_judged_safe(which):
    values = [0.0] * 4
    values[which] = np.nan
    verdict = judge(KKTResiduals(*values[:3]), values[3], 1e-6)
    assert verdict is not Status.CONVERGED
    assert not verdict.certified
    if which in (1, 3):  # of feasibility and slack
        assert verdict is Status.VIOLATING


@pytest.mark.parametrize("shape", [None, Polytope.box([1.0, 1.0])], ids=["disc", "box"])
def test_a_contact_now_is_told_and_is_not_ok(shape):
    """5 cm inside now, and out at the first sample: stage 0 is not constrained."""
    case = problem(10, max_obstacles=2)
    reach = case.robot_radius + (0.5 if shape is None else 0.5 + 0.1)
    far = ObstaclePrediction.static(10, [9.0, 9.0], 0.2)
    for inside, expected in ((0.05, (1,)), (-0.05, ())):
        means, radius = [reach - inside, 0.0], 0.5 if shape is None else 0.1
        near = ObstaclePrediction.static(10, means, radius, shape=shape)
        away = np.tile([-3.0, 0.0, 0.0, 0.0], (11, 1))
        plan = SCP(case).solve(np.array([0.0, -2.0, 0.0, 0.0]), away, [far, near])
        assert plan.status.ok
        assert plan.contact == expected
        assert plan.ok is not bool(expected)
