"""The fallback hierarchy: deadlines, the last plan, braking, and what is said about each."""

import time

import numpy as np
import pytest
from driving import N
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import DT, obstacle, problem, straight_reference

from scp_mpc import (
    MPC,
    SCP,
    DoubleIntegrator,
    LinearModel,
    ObstaclePrediction,
    Polytope,
    Problem,
    Settings,
    Status,
    Trajectory,
    Unicycle,
)
from scp_mpc.deadline import Clock, Pace
from scp_mpc.models import FunctionModel
from scp_mpc.qp.backend import ProgramSolver


def test_each_status_has_a_sentence_and_knows_whether_it_is_safe():
    safe = {Status.CONVERGED, Status.FEASIBLE, Status.PREVIOUS, Status.BRAKING}
    assert {status for status in Status if status.ok} == safe
    assert all(status.value.endswith(".") and len(status.value) > 30 for status in Status)


@settings(deadline=None, max_examples=100)
@given(
    x=st.tuples(*[st.floats(-5, 5)] * 4),
    bounds=st.tuples(*[st.floats(0.5, 4)] * 4),
)
def test_braking_is_straight_within_bounds_and_comes_to_rest(x, bounds):
    least, most = -np.array(bounds[:2]), np.array(bounds[2:])
    case = problem(60, u_min=least, u_max=most)
    plan = SCP(case).brake(np.array(x), np.zeros(4))
    assert plan.status is Status.BRAKING
    assert (least <= plan.U).all()
    assert (most >= plan.U).all()
    v = plan.X[:, [1, 3]]
    speed = np.linalg.norm(v, axis=1)
    assert (np.diff(speed) <= 1e-9).all()
    assert speed[-1] < 1e-6
    across = v[:, 0] * x[3] - v[:, 1] * x[1]
    np.testing.assert_allclose(across, 0, atol=1e-6)
    if speed[1] > 1e-6:  # the first input brakes as hard as its direction allows
        assert np.isclose(plan.u0, least).any() or np.isclose(plan.u0, most).any()


def test_braking_where_no_input_is_not_allowed():
    """Bounds that exclude zero: as near to rest as they permit."""
    case = problem(10, u_min=[0.5, -3.0], u_max=[3.0, 3.0])
    plan = SCP(case).brake(np.array([0.0, 2.0, 0.0, 1.0]), np.zeros(4))
    assert (plan.U[:, 0] == 0.5).all()
    assert plan.X[-1, 3] == pytest.approx(0.0, abs=1e-9)


def test_a_robot_that_is_moved_by_velocities_brakes_by_standing_still():
    walker = LinearModel(np.eye(2), DT * np.eye(2), DT, [0, 1])
    case = problem(5, model=walker, Q=[1.0, 1.0], R=[0.1, 0.1])
    plan = SCP(case).brake(np.array([1.0, 2.0]), np.zeros(2))
    assert not plan.U.any()


def closing(speed):
    """A robot at some speed, and an obstacle that appears in its way."""
    ref = straight_reference(N, speed)
    return ref[0], ref, [obstacle(N, (2.6, 0.05), growth=0.0)]


def test_out_of_time_the_last_plan_is_kept_if_it_is_still_clear():
    mpc = MPC(problem(N))
    x0, ref, ahead = closing(2.0)
    first = mpc.step(x0, ref, ahead)
    assert first.ok
    # A second controller has no time at all; it takes over the first one's plan.
    x1 = problem(N).model.step(x0, first.u0)
    hurried = SCP(problem(N), Settings(deadline=1e-9))
    kept = hurried.solve(x1, ref, shifted(ahead), guess=mpc.nominal())
    assert kept.status is Status.PREVIOUS
    assert kept.ok
    np.testing.assert_allclose(kept.U[:-1], first.U[1:], atol=1e-12)
    assert kept.slack.max() == 0
    # The obstacle has turned out to be elsewhere: the last plan is not clear any more.
    onto = [obstacle(N, (1.9, float(first.X[5, 2])), growth=0.0)]
    braking = hurried.solve(x1, ref, onto, guess=mpc.nominal())
    assert braking.status in (Status.BRAKING, Status.FALLBACK)
    assert braking.ok == (braking.slack.max() <= 1e-6)
    np.testing.assert_allclose(braking.u0, hurried.brake(x1, ref).u0)


def shifted(obstacles):
    return [
        ObstaclePrediction(np.vstack([o.means[1:], o.means[-1:]]), o.covariances, o.radius)
        for o in obstacles
    ]


def test_too_fast_to_brake_is_no_safe_plan():
    x0, ref, ahead = closing(4.0)
    plan = SCP(problem(N), Settings(deadline=1e-9)).solve(x0, ref, ahead)
    assert plan.status in (Status.STOPPING, Status.FALLBACK)
    assert not plan.ok
    assert plan.slack.max() > 0.1
    np.testing.assert_allclose(plan.u0, [-3.0, 0.0])


def test_a_safe_plan_that_is_known_beats_slack():
    """If the search ends with slack though braking is clear, the search begins from braking."""
    case = problem(20)
    ref = straight_reference(20, 2.0)
    wall = [obstacle(20, (4.0, 0.0), covariance=np.diag([0.01, 4.0]), growth=0.0)]
    lazy = SCP(case, Settings(multi_start=False, max_iterations=1))
    onto = Trajectory(ref, np.zeros((20, 2)))
    plan = lazy.solve(ref[0], ref, wall, onto)
    assert plan.ok, plan.status


def test_predictions_of_time_are_long_times_slowly_forgotten():
    pace = Pace()
    assert pace.expected("program") == 0
    for _ in range(50):
        pace.learn("program", 2.0)
    pace.learn("program", 1.0)
    assert 1.9 < pace.expected("program") < 2.0
    clock = Clock(1.0, pace)
    tries = []
    for _ in range(4):
        tries.append(1)
        while not clock.allows("program"):  # what was never begun must not be shut out for ever
            tries[-1] += 1
        pace.learn("program", 2.0)  # nothing has changed: less and less often
    assert tries == [4, 7, 13, 25]
    assert Clock(None, pace).allows("program")


def test_so_many_ways_as_fit_in():
    pace = Pace()
    pace.learn("way", 0.1)
    pace.learn("program", 0.2)
    assert Clock(1.0, pace).room("way", 16, then="program") in (6, 7)
    assert Clock(None, pace).room("way", 16, then="program") == 16
    assert Clock(0.15, pace).room("way", 16, then="program") == 0


def slowed(monkeypatch, seconds):
    """Make every program take so long; returns the list of those begun."""
    solve, begun = ProgramSolver.solve, []

    def slow(self, *given):
        begun.append(self)
        end = time.perf_counter() + seconds
        while time.perf_counter() < end:  # it works, and does not wait
            pass
        return solve(self, *given)

    monkeypatch.setattr(ProgramSolver, "solve", slow)
    return begun


def test_a_slow_solver_stops_the_search_and_is_counted(monkeypatch):
    """Programs five times as long as the deadline: one descent is begun, then none."""
    mpc, step = MPC(problem(N), Settings(deadline=0.1)), closing(2.0)
    for _ in range(3):
        mpc.step(*step)
    quick = mpc.overruns
    begun = slowed(monkeypatch, 0.5)
    late = mpc.step(*step)
    assert 1 <= len(begun) <= 2
    assert mpc.overruns == quick + 1
    assert late.candidates == ()
    mpc.step(*step)  # once may be an accident
    begun.clear()
    known = mpc.step(*step)  # now it is known that programs take too long
    assert not begun
    assert known.status in (Status.PREVIOUS, Status.BRAKING)
    assert mpc.counts[known.status] == 1
    monkeypatch.undo()
    for _ in range(400):
        if mpc.step(*step).status is Status.CONVERGED:  # and forgotten in time
            break
    else:
        pytest.fail("it is never forgotten")
    for _ in range(40):
        again = mpc.step(*step)
    assert again.status is Status.CONVERGED  # for good


def test_a_computation_that_breaks_down_ends_in_a_fallback(monkeypatch, caplog):
    mpc, step = MPC(problem(N)), closing(2.0)
    first = mpc.step(*step)

    def broken(*_):
        raise np.linalg.LinAlgError("not positive definite")

    monkeypatch.setattr(ProgramSolver, "solve", broken)
    plan = mpc.step(*step)
    assert plan.status in (Status.PREVIOUS, Status.BRAKING)
    assert "broke down" in caplog.text
    monkeypatch.undo()
    mpc.reset()
    np.testing.assert_array_equal(mpc.step(*step).U, first.U)


@pytest.mark.parametrize("inflation", ["exact", "axes"])
@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.1, 0.2), (-0.4, -0.05)])
def test_from_within_the_set_the_robot_leaves_on_the_nearest_side_and_stays_out(inflation, offset):
    """Semi-axes of 1.33 m and 0.6 m: the way out is along the second axis."""
    case, goal = problem(15, inflation), np.zeros(4)
    on_top = ObstaclePrediction(np.zeros((16, 2)), np.diag([0.16, 0.01]), 0.2)
    mpc, x, tracks, slack = MPC(case), np.array([offset[0], 0.0, offset[1], 0.0]), [], []
    for _ in range(25):
        plan = mpc.step(x, goal, [on_top])
        assert np.isfinite(plan.U).all()
        slack.append(plan.slack.max())
        x = case.model.step(x, plan.u0)
        tracks.append(x[2])
    outside = np.flatnonzero(np.array(slack) <= 1e-6)[0]
    assert outside <= 3
    assert max(slack[outside:]) <= 1e-6
    assert (np.diff(slack[: outside + 1]) < 0).all()
    assert len(set(np.sign(tracks))) == 1  # one side, without flicker
    if offset[1]:
        assert np.sign(tracks[0]) == np.sign(offset[1])


def test_the_slack_is_the_least_there_is():
    """From rest at the centre the robot is as far out at each stage as full throttle takes it."""
    case, goal = problem(6), np.zeros(4)
    on_top = ObstaclePrediction(np.zeros((7, 2)), 0.04 * np.eye(2), 0.2)
    plan = SCP(case).solve(np.zeros(4), goal, [on_top])
    assert plan.status is Status.SOFTENED
    reach = 0.35 + case.size.reference * 0.2
    t = DT * np.arange(1, 7)
    best = np.sqrt(2) * 3.0 * t**2 / 2  # both inputs at their bounds
    np.testing.assert_allclose(plan.slack[0, :2], (reach - best)[:2], atol=1e-6)


def test_two_obstacles_that_close_the_way_stop_the_robot():
    ref = straight_reference(20, 2.0)
    walls = [
        obstacle(20, (4.0, side * 1.0), covariance=np.diag([0.01, 0.09]), growth=0.0)
        for side in (1, -1)
    ]
    mpc, x = MPC(problem(20, max_obstacles=2)), ref[0]
    for _ in range(25):
        plan = mpc.step(x, ref, walls)
        assert plan.ok, plan.status
        x = problem(20).model.step(x, plan.u0)


def test_three_dimensions_brake_too():
    space = {"model": DoubleIntegrator(DT, 3), "Q": [1.0, 0.1] * 3, "R": [0.1] * 3}
    plan = SCP(problem(10, **space)).brake(np.array([0, 1.0, 0, -2.0, 0, 0.5]), np.zeros(6))
    assert np.abs(plan.X[-1, 1::2]).max() < 1e-9


def walker(gap, speed, N, dt=0.2):
    """Somebody ahead who comes closer, known for certain."""
    means = np.stack([gap - speed * dt * np.arange(N + 1), np.zeros(N + 1)], axis=1)
    return ObstaclePrediction(means, np.zeros((2, 2)), 0.2)


@pytest.mark.parametrize("nodes", [1, 4])
def test_plans_that_are_not_ok_are_passively_safe(nodes):
    """Nowhere faster than braking where they violate anything, whatever comes from where."""
    assert sum(passive(seed, nodes) for seed in range(8)) >= 8


def passive(seed, nodes):
    """How many of five steps are not ok."""
    rng = np.random.default_rng(seed)
    point = seed % 2 == 0
    this = Problem(
        DoubleIntegrator(0.2) if point else Unicycle(0.2), horizon=12, max_obstacles=3,
        Q=[1, 0.1, 1, 0.1] if point else [1, 1, 0.05, 0.1], R=[0.05, 0.05], u_min=-2.0, u_max=2.0,
        robot_radius=0.3, nodes_per_interval=nodes,
    )  # fmt: skip
    mpc, x, bad = MPC(this), this.model.state(np.zeros(2), rng.uniform(-1.5, 1.5, 2)), 0
    for _ in range(5):
        people = []
        for _ in range(3):
            at, way = rng.uniform(-2.5, 2.5, 2), rng.uniform(-2, 2, 2)
            means = at + 0.2 * np.arange(13)[:, None] * (way + np.sign(way) * 0.4)
            people.append(ObstaclePrediction(means, 0.01 * np.eye(2), 0.3))
        plan = mpc.step(x, this.model.state(np.array([4.0, 0.0]), np.zeros(2)), people)
        if not plan.ok and not plan.status.ok:
            bad += 1
            ways = np.linalg.norm(np.diff(plan.X[:, this.model.position], axis=0), axis=1)
            brake = SCP(this).brake(x, x).X[:, this.model.position]
            slow = np.linalg.norm(np.diff(brake, axis=0), axis=1) + 0.05 * 0.2 + 1e-9
            assert (ways <= slow)[plan.slack.max(axis=0) > 1e-6].all()
        x = this.model.step(x, plan.u0)
    return bad


def test_whoever_comes_too_close_finds_the_robot_at_rest():
    """In a corridor that is too narrow for two: it stops well before they meet, and stays."""
    this = problem(20, max_obstacles=3, nodes_per_interval=4)
    sides = [
        ObstaclePrediction.static(20, [0, y], 0, shape=Polytope.box([40, 1])) for y in (0.8, -0.8)
    ]
    mpc, x, gap, speeds = MPC(this), np.array([0.0, 1.5, 0.0, 0.0]), 6.0, []
    while gap - x[0] > 0.36:
        plan = mpc.step(x, straight_reference(20, 1.5), [*sides, walker(gap, 3.2, 20)])
        x, gap = this.model.step(x, plan.u0), gap - 0.64
        speeds.append(x[1])
    assert speeds[-1] <= 0.05
    assert speeds[0] > 0.5


def test_no_status_says_that_braking_is_in_time_when_it_is_not():
    this, fast = problem(N, nodes_per_interval=4), np.array([0.0, 3.0, 0.0, 0.0])
    wall = [ObstaclePrediction.static(N, [1.0, 0.0], 0.0, shape=Polytope.box([0.2, 20.0]))]
    plan = SCP(this).solve(fast, straight_reference(N, 3.0), wall)
    assert plan.status is Status.FALLBACK
    np.testing.assert_allclose(plan.u0, [-3.0, 0.0])


def test_inputs_that_lead_where_the_model_ends_are_no_plan():
    """Beyond a metre it has no next state: nothing is known to be passively safe there."""

    def shift(x, u):
        return np.where(np.abs(x) > 1.0, np.nan, x + 0.2 * u)

    robot = FunctionModel(shift, nx=2, nu=2, dt=0.2, position=[0, 1], discrete=True)
    this = Problem(robot, horizon=8, Q=[1, 1], R=[1, 1], u_min=-2.0, u_max=2.0)
    away = SCP(this).follow(np.zeros(2), np.zeros(2), [], np.full((8, 2), 1.5))
    assert away.status is Status.FALLBACK
    assert away.kkt.feasibility == np.inf
    assert np.isfinite(away.X).all()
