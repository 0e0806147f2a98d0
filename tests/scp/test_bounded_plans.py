"""Plans within bounds of states and of rates, against IPOPT on a formulation of its own."""

from dataclasses import replace

import numpy as np
import pytest
from bounded_referee import Bounded
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import DT, obstacle, problem, straight_reference
from rebuilt import couplings_of, rebuilt

from benchmarks.audit import audit
from benchmarks.peers.violation import largest_violation
from scp_mpc import MPC, SCP, DoubleIntegrator, Problem, Settings, Status, Unicycle
from scp_mpc.deadline import Clock
from scp_mpc.scp.nodes import Nodes
from scp_mpc.scp.step import Step
from scp_mpc.scp.transcription import Transcription
from scp_mpc.trajectory import rollout

INF = np.inf
N = 8
SPEED = {"x_max": [INF, 2.0, INF, 1.5], "x_min": [-INF, -2.0, -INF, -INF]}
ALL = {
    "x_max": [INF, 1.9, 0.25, 1.5],
    "x_min": [-INF, 0.5, -INF, -0.4],
    "du_min": [-0.6, -INF],
    "du_max": [0.6, 0.8],
}

paths = pytest.mark.parametrize("solver", ["osqp", "piqp"])


@pytest.mark.parametrize("changes", [ALL, SPEED, {"du_max": [INF, 0.5]}, {"x_min": -1.0}])
@pytest.mark.parametrize("elastic", [False, True])
def test_the_sparse_program_equals_the_dense_rebuild(changes, elastic):
    soft = [True, True, False, True] if elastic else False
    more = {"max_obstacles": 2, "state_slack_weight": 70.0, "x_soft": soft, "speed_max": 3.0}
    this = problem(N, "exact", 0.5, **more, **changes)
    solver, rng = SCP(this), np.random.default_rng(1)
    near = [obstacle(N, (0.5, 0.3)), obstacle(N, (-0.4, 0.2), (0.1, 0.0))]
    for seed in range(3):
        x0, x_ref = 0.3 * rng.normal(size=4), 0.3 * rng.normal(size=(N + 1, 4))
        last = np.array([[0.0, 0.0], [3.2, -0.5], [-9.0, 9.0]][seed])
        inputs = this.limited(0.3 * rng.normal(size=(N, 2)), last)
        guess = rollout(this.model.step, x0, inputs)
        given = x0, x_ref, near
        program = solver.subproblem(*given, guess=guess, elastic=elastic, u_last=last)
        couplings = couplings_of(program, this) if elastic else None
        slow = rebuilt(this, *given, inputs, elastic, last, couplings)
        found = program.P.toarray(), program.q, program.A.toarray(), program.lower, program.upper
        for mine, theirs in zip(
            found, (slow.P, slow.q, slow.A, slow.lower, slow.upper), strict=True
        ):
            np.testing.assert_allclose(mine, theirs, rtol=1e-7, atol=1e-7)


def begun(this, x0, x_ref, obstacles=(), u_last=None):
    """A control step in numbers."""
    at = Transcription(this, Settings(), Nodes.of(this))
    at.begin(Step.read(this, x0, x_ref, obstacles, nodes=at.nodes, u_last=u_last), Clock())
    return at


def test_excess_is_slack_where_it_is_paid_for_and_a_violation_where_not():
    """At an upper and a lower bound; its force is its price."""
    limits = {"x_max": [INF, 2.0, INF, 1.5], "x_min": [-INF, -2.0, -0.5, -1.5]}
    this, ref = problem(N, x_soft=True, **limits), np.zeros(4)
    x0 = np.array([0.0, 2.4, -0.6, -1.7])
    at = begun(this, x0, ref)
    plain = at.plain(np.zeros((N, 2)))
    states = np.vstack([x0, plain.rollout.deviations])
    excess = this.excess(states)
    assert (excess > 0).any(axis=0).tolist() == [False, True, True, True]
    force = np.zeros((N, 3))
    force[states[1:, 1:] > this.x_max[1:]] = -100.0
    force[states[1:, 1:] < this.x_min[1:]] = 100.0
    for share, violation in ((1.0, 0.0), (0.5, excess.max())):
        layout, empty = at.layout, np.zeros((0, 0))
        reaction = layout.gathered(np.zeros(1), np.zeros((N, 2)), empty, share * force)
        paid = at.nominal(plain.y, plain.rollout, reaction, at.no_pairs, np.zeros(0))
        np.testing.assert_allclose(paid.excess, excess[:, 1:].ravel(), atol=1e-12)
        assert paid.residuals.feasibility == pytest.approx(violation, abs=1e-12)
        price = at.merit(paid.cost, 0.0, paid.excess) - paid.cost
        assert price == pytest.approx(this.penalty(np.zeros(0), states))


@paths
@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("changes", [ALL, SPEED, {"du_min": -0.7, "du_max": 0.7}])
def test_plans_are_those_of_ipopt(changes, seed, there, solver):
    rng = np.random.default_rng(seed)
    this, ref = problem(N, x_soft=True, **changes), straight_reference(N, rng.uniform(1.5, 3.0))
    x0 = np.array([0.0, rng.uniform(0.8, 2.6), rng.uniform(-0.2, 0.2), rng.uniform(-0.5, 0.5)])
    u_last = rng.uniform(-1.0, 1.0, 2)
    one = obstacle(N, (2.5, rng.uniform(-0.4, 0.4)), covariance=0.01 * np.eye(2))
    obstacles = [one] if there else []
    plan = SCP(this, Settings(solver=solver)).solve(x0, ref, obstacles, u_last=u_last)
    assert plan.status.certified
    X, merit = Bounded(this, x0, ref, one if there else None, u_last).best(plan)
    assert plan.cost + this.penalty(plan.slack, plan.X) == pytest.approx(merit, rel=1e-6, abs=1e-6)
    np.testing.assert_allclose(plan.X[1:], X, atol=2e-4)
    np.testing.assert_allclose(plan.x_slack, this.excess(plan.X), atol=0)
    change = np.diff(np.vstack([u_last, plan.U]), axis=0)
    assert (change <= this.du_max + 1e-9).all()
    assert (change >= this.du_min - 1e-9).all()
    worst = max(plan.x_slack.max(), plan.slack.max(initial=0.0))
    judged = largest_violation(this, x0, obstacles, plan.X, plan.U, plan.s)
    assert judged == pytest.approx(worst, abs=1e-6)
    assert plan.ok == (worst <= 1e-6)
    assert not audit(this, x0, obstacles, plan).lie


@paths
def test_slack_is_what_the_brakes_leave_of_a_start_outside(solver):
    """3 m/s where 2 m/s are allowed: 0.2 m/s less at every stage, and no more."""
    this = problem(N, u_min=-1.0, x_soft=True, **SPEED)
    ref = straight_reference(N, 3.0)
    plan = SCP(this, Settings(solver=solver)).solve(ref[0], ref)
    assert plan.status is Status.SOFTENED
    assert not plan.ok
    expected = np.maximum(0.0, 1.0 - 0.2 * np.arange(1, N + 1))
    np.testing.assert_allclose(plan.x_slack[:, 1], expected, atol=1e-7)
    assert not plan.x_slack[:, [0, 2, 3]].any()
    np.testing.assert_allclose(plan.U[:5, 0], -1.0, atol=1e-7)
    duals = plan.multipliers.states
    np.testing.assert_allclose(duals[:4, 0], 100.0, rtol=1e-7)
    assert (np.abs(duals) <= 100.0 * (1 + 1e-9)).all()
    assert plan.kkt.worst < 1e-6
    kept = SCP(this, Settings(solver=solver)).solve([0, 2.0, 0, 0], ref)
    assert kept.status is Status.CONVERGED
    assert kept.x_slack.max() <= 1e-7
    assert kept.multipliers.states[:, 0].min() > 0


@paths
@pytest.mark.parametrize("limit", [SPEED, {"speed_max": 2.0}], ids=["axis", "speed"])
def test_a_hard_bound_is_what_full_braking_reaches(solver, limit):
    """From 3 m/s to 2 at 1 m/s^2, and no step longer: not ok as long as it lasts."""
    this = problem(N, u_min=-1.0, **limit)
    ref = straight_reference(N, 3.0)
    plan = SCP(this, Settings(solver=solver)).solve(ref[0], ref)
    assert plan.status is Status.SOFTENED
    np.testing.assert_allclose(plan.X[1:, 1], np.maximum(2.0, 3.0 - 0.2 * np.arange(1, N + 1)))
    assert plan.kkt.worst < 1e-6
    within = SCP(this, Settings(solver=solver)).solve([0.0, 2.0, 0.0, 0.0], ref)
    assert within.status is Status.CONVERGED


@paths
@pytest.mark.parametrize("kind", ["point", "unicycle"])
@pytest.mark.parametrize("seed", range(2))
def test_obstacles_yield_before_the_speed_does(solver, kind, seed):
    """Somebody comes too fast to be let pass: no plan is faster than allowed, with slack or not."""
    rng, faces = np.random.default_rng(seed), np.pi / 16
    point = kind == "point"
    this = Problem(
        DoubleIntegrator(0.2) if point else Unicycle(0.2),
        horizon=N,
        Q=[1, 0.1, 1, 0.1] if point else [1, 1, 0.05, 0.1],
        R=[0.05, 0.05],
        u_min=-2.0,
        u_max=2.0,
        robot_radius=0.3,
        speed_max=1.0,
        max_obstacles=2,
        nodes_per_interval=1,
    )
    x = this.model.state(np.zeros(2), np.array([0.9, 0.0]))
    mpc, softened = MPC(this, Settings(solver=solver)), 0
    for _ in range(6):
        ahead = [[1.2, rng.uniform(-0.3, 0.3)], [-1.2, rng.uniform(-0.3, 0.3)]]
        toward = [obstacle(N, p, (-2.0 * np.sign(p[0]), 0.0)) for p in ahead]
        plan = mpc.step(x, this.model.state(np.array([4.0, 0.0]), np.zeros(2)), toward)
        speeds = np.linalg.norm(plan.X[:, this.model.velocity], axis=1)
        assert speeds.max() <= 1.0 + 1e-6
        softened += plan.slack.max() > 0.01
        x = this.model.step(x, plan.u0)
    assert softened >= 1
    # All of the speed along an axis, and nearly all of it in between.
    for angle, least in ((0.0, 1.0), (faces, np.cos(faces)), (0.3, np.cos(faces))):
        goal = 9.0 * np.array([np.cos(angle), np.sin(angle)])
        x = this.model.state(np.zeros(2), np.array([np.cos(angle), np.sin(angle)]) * 0.5)
        plan = SCP(this, Settings(solver=solver)).solve(x, this.model.state(goal, np.zeros(2)))
        speeds = np.linalg.norm(plan.X[:, this.model.velocity], axis=1)
        assert least - 1e-6 <= speeds.max() <= 1.0 + 1e-9


def test_a_robot_too_fast_for_its_room_leaves_it_no_farther_than_braking_does():
    this = problem(N, u_min=-1.0, u_max=1.0, x_max=[2.0, INF, INF, INF])
    x0 = np.array([0.0, 2.5, 0.0, 0.0])
    plan, brake = SCP(this).solve(x0, np.zeros(4)), SCP(this).brake(x0, np.zeros(4))
    assert not plan.ok
    assert plan.X[:, 0].max() <= brake.X[:, 0].max() + 1e-6
    assert plan.x_slack[:, 0].max() == pytest.approx(max(brake.X[:, 0]) - 2.0, abs=1e-6)


@paths
def test_slack_at_lower_bounds_too_and_only_as_long_as_it_pays(solver):
    this = problem(N, x_min=[-INF, 0.5, -INF, -INF], u_max=1.0, x_soft=True)
    still = SCP(this, Settings(solver=solver)).solve(np.zeros(4), np.zeros(4))
    np.testing.assert_allclose(still.x_slack[:, 1], [0.3, 0.1, *[0.0] * 6], atol=1e-7)
    np.testing.assert_allclose(still.multipliers.states[:2, 0], -100.0, rtol=1e-7)
    cheap = replace(this, state_slack_weight=1e-4)
    plan = SCP(cheap, Settings(solver=solver)).solve(np.zeros(4), np.zeros(4))
    assert plan.status is Status.SOFTENED
    assert plan.x_slack[:, 1].min() > 0.4


def test_the_certificate_sees_a_wrong_multiplier_and_a_wrong_input():
    this, ref = problem(N, **ALL), straight_reference(N, 3.0)
    plan = SCP(this).solve(ref[0], ref, u_last=np.zeros(2))
    duals = plan.multipliers
    at = begun(this, ref[0], ref, u_last=np.zeros(2))
    assert at.at(plan.iterate).residuals.worst < 1e-6
    assert np.abs(duals.rates).max() > 0.1
    for name in ("states", "rates"):
        flipped = replace(duals, **{name: -getattr(duals, name)})
        assert at.at(replace(plan.iterate, multipliers=flipped)).residuals.worst > 0.1
    pushed = replace(plan.iterate, inputs=plan.U - [0.0, 0.1])
    assert at.at(pushed).residuals.worst > 1e-3
    # Another last input leaves other inputs, those that keep the rates: forces do not fit them.
    other = begun(this, ref[0], ref, u_last=np.array([1.5, 0.0])).at(plan.iterate)
    assert abs(other.rollout.inputs[0, 0] - plan.u0[0]) > 0.3
    assert other.residuals.worst > 0.1


@paths
def test_the_first_rate_counts_from_the_input_last_applied(solver):
    this, ref = problem(N, du_min=-0.3, du_max=0.4), straight_reference(N, 3.0)
    solver, x0 = SCP(this, Settings(solver=solver)), np.zeros(4)
    unknown = solver.solve(x0, ref)
    assert unknown.u0[0] == pytest.approx(3.0)
    for last, first in ((0.0, 0.4), (-1.0, -0.6), (2.9, 3.0), (3.2, 3.0), (-7.0, -3.0)):
        plan = solver.solve(x0, ref, u_last=[last, 0.0])
        assert plan.status is Status.CONVERGED
        assert plan.u0[0] == pytest.approx(first, abs=1e-9)
    plan = solver.solve(x0, -ref, u_last=[3.2, 0.0])
    assert plan.u0[0] == pytest.approx(2.9, abs=1e-9)  # the rate holds as soon as it can


@paths
def test_the_controller_remembers_its_input_unless_told_another(solver):
    this, ref = problem(N, du_min=-0.3, du_max=0.3), straight_reference(N, 3.0)
    mpc = MPC(this, Settings(solver=solver))
    first = mpc.step(np.zeros(4), -ref)
    assert first.u0[0] == pytest.approx(-3.0)
    assert mpc.step(np.zeros(4), ref).u0[0] == pytest.approx(-2.7, abs=1e-9)
    assert mpc.step(np.zeros(4), ref, u_last=[1.0, 0.0]).u0[0] == pytest.approx(1.3, abs=1e-9)
    assert mpc.step(np.zeros(4), ref).u0[0] == pytest.approx(1.6, abs=1e-9)
    mpc.reset()
    assert mpc.step(np.zeros(4), ref).u0[0] == pytest.approx(3.0)


@paths
def test_the_last_guard_knows_the_rates(solver, monkeypatch, caplog):
    this, ref = problem(N, du_min=-0.3, du_max=0.3), straight_reference(N)
    mpc = MPC(this, Settings(solver=solver))
    sound = mpc.step(ref[0], ref, u_last=np.zeros(2))
    wrong = replace(sound, U=sound.U + [0.6, 0.0])
    with monkeypatch.context() as broken:
        broken.setattr(mpc._solver, "solve_from", lambda *_, **__: wrong)
        plan = mpc.step(ref[0], ref, u_last=np.zeros(2))
    assert plan.status is Status.FALLBACK
    assert "rates" in caplog.text
    change = np.diff(np.vstack([np.zeros(2), plan.U]), axis=0)
    assert (np.abs(change) <= 0.3 + 1e-9).all()


speeds = st.floats(-4.0, 4.0)


@paths
@settings(max_examples=10, deadline=None)
@given(
    targets=st.lists(st.tuples(speeds, speeds), min_size=3, max_size=3),
    steps=st.tuples(*[st.floats(0.01, 2.0) | st.just(INF)] * 4),
    seed=st.integers(0, 1000),
)
def test_closed_loops_keep_inputs_and_rates_always(solver, targets, steps, seed):
    rng = np.random.default_rng(seed)
    limits = {"du_min": np.negative(steps[:2]), "du_max": steps[2:], **SPEED}
    this = problem(5, u_min=[-1.0, -2.0], **limits)
    mpc, x, last = MPC(this, Settings(solver=solver)), rng.normal(size=4), rng.normal(size=2)
    last = np.clip(last, this.u_min, this.u_max)
    for k in range(30):
        vx, vy = targets[k // 10]
        plan = mpc.step(x, [x[0] + vx, vx, vy, vy], u_last=last if k == 0 else None)
        assert plan.status.certified or plan.status.ok or plan.x_slack.max() > 0
        assert (this.u_min <= plan.U).all()
        assert (this.u_max >= plan.U).all()
        change = np.diff(np.vstack([last, plan.U]), axis=0)
        assert (change >= this.du_min - 1e-9).all()
        assert (change <= this.du_max + 1e-9).all()
        last = plan.u0
        x = this.model.step(x, last) + 0.02 * rng.normal(size=4)


@pytest.mark.parametrize("reach", [0.5, 1.0])
@pytest.mark.parametrize("speed", [{"speed_max": 2.0}, SPEED], ids=["speed", "axis"])
def test_slow_rates_never_carry_a_robot_beyond_its_speed(speed, reach):
    """What a plan of one second does not see, its backup does; the model is exact."""
    this = problem(5, du_min=-reach, du_max=reach, **speed)
    mpc, x = MPC(this), np.zeros(4)
    for k in range(60):
        plan = mpc.step(x, [9.0 * (-1) ** (k // 30), 0, 9.0, 0], u_last=[0, 0] if k == 0 else None)
        assert plan.ok
        x = this.model.step(x, plan.u0)
        assert this.excess(np.stack([x, x])).max() <= 1e-6
        if "speed_max" in speed:
            assert np.hypot(x[1], x[3]) <= 2.0 + 1e-6
    assert np.hypot(x[1], x[3]) > 0.02


def test_the_merit_includes_the_price_of_the_excess():
    this, ref = problem(N, u_min=-1.0, x_soft=True, **SPEED), straight_reference(N, 3.0)
    solver = SCP(this)
    at, loop = solver._at, solver._loop
    at.begin(Step.read(this, ref[0], ref, [], nodes=at.nodes), Clock())
    end = loop.run(solver._obstacle_free(None))
    assert end.merit - end.cost == pytest.approx(100.0 * (0.8 + 0.6 + 0.4 + 0.2))


@paths
def test_bounds_hold_between_obstacles_that_are_constrained_between_samples(solver):
    """At 6 m/s the robot passes through the radii in one interval."""
    this = problem(N, nodes_per_interval=4, x_max=[INF, 6.0, 0.9, INF], du_min=-2.0, du_max=2.0)
    mpc, x, last = MPC(this, Settings(solver=solver)), np.array([0, 6.0, 0, 0]), np.zeros(2)
    ways = []
    for k in range(8):
        ref = straight_reference(N, 6.0) + [6.0 * DT * k, 0, 0, 0]
        plan = mpc.step(x, ref, [obstacle(N, (6.0, -0.1), covariance=1e-3 * np.eye(2), growth=0.0)])
        assert plan.ok
        assert plan.x_slack.max() <= 1e-6
        change = np.diff(np.vstack([last, plan.U]), axis=0)
        assert (np.abs(change[k == 0 :]) <= 2.0 + 1e-9).all()  # at first u_last is not known
        last = plan.u0
        x = this.model.step(x, last)
        ways.append((x[2], np.abs(change[1:]).max(), plan.slack.shape, plan.iterate.slack.shape))
    y, most, shapes, nodes = zip(*ways, strict=True)
    assert max(y) > 0.2
    assert max(most) == pytest.approx(2.0)
    assert set(shapes) == {(1, N)}
    assert set(nodes) == {(1, 4 * N)}
