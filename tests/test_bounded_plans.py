"""Plans within bounds of states and of rates, against IPOPT on a formulation of its own."""

from dataclasses import replace

import numpy as np
import pytest
from bounded_referee import Bounded
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import DT, instance, obstacle, problem, straight_reference
from test_subproblem import dense

from scp_mpc import MPC, SCP, Settings, Status
from scp_mpc.comparison.audit import audit
from scp_mpc.comparison.violation import largest_violation
from scp_mpc.solver.iterate import Iterate, Multipliers
from scp_mpc.solver.sampling import Sampling
from scp_mpc.solver.sparse_scp import SparseSCP
from scp_mpc.solver.step_data import StepData
from scp_mpc.solver.stopwatch import Stopwatch
from scp_mpc.solver.subproblem import Subproblem

PATHS = (False, True)
INF = np.inf
N = 8
SPEED = {"x_max": [INF, 2.0, INF, 1.5], "x_min": [-INF, -2.0, -INF, -INF]}
ALL = {
    "x_max": [INF, 1.9, 0.25, 1.5],
    "x_min": [-INF, 0.5, -INF, -0.4],
    "du_min": [-0.6, -INF],
    "du_max": [0.6, 0.8],
}

paths = pytest.mark.parametrize("condense", PATHS)


def slow(this, step, spaces, soft):
    """The other tests' dense rebuild, with the limits' rows and columns written one by one."""
    P, q, A, lower, upper = dense(this, step, spaces, soft)
    nx, nu, n = this.model.nx, this.model.nu, len(q)
    below = [(i, a) for i in range(N) for a in range(nx) if np.isfinite(this.x_min[a])]
    above = [(i, a) for i in range(N) for a in range(nx) if np.isfinite(this.x_max[a])]
    extra = len(below) + len(above)
    rows, low, high = [], [], []
    for i in range(N):
        for a in range(nx):
            if np.isfinite(this.x_min[a]) or np.isfinite(this.x_max[a]):
                row = np.zeros(n + extra)
                row[i * nx + a] = 1.0
                if (i, a) in below:
                    row[n + below.index((i, a))] = 1.0
                if (i, a) in above:
                    row[n + len(below) + above.index((i, a))] = -1.0
                rows.append(row)
                low.append(this.x_min[a] - step.x_ref[i + 1, a])
                high.append(this.x_max[a] - step.x_ref[i + 1, a])
    for k in range(extra):
        rows.append(np.eye(n + extra)[n + k])
        low.append(0.0)
        high.append(INF)
    for i in range(N):
        for a in range(nu):
            if np.isfinite(this.du_min[a]) or np.isfinite(this.du_max[a]):
                row, before = np.zeros(n + extra), 0.0
                row[N * nx + i * nu + a] = 1.0
                if i > 0:
                    row[N * nx + (i - 1) * nu + a] = -1.0
                else:
                    before = step.u_last[a]
                rows.append(row)
                low.append(before + this.du_min[a])
                high.append(before + this.du_max[a])
    return (
        np.block([[P, np.zeros((n, extra))], [np.zeros((extra, n + extra))]]),
        np.append(q, np.full(extra, this.state_slack_weight)),
        np.vstack([np.hstack([A, np.zeros((len(A), extra))]), rows]),
        np.append(lower, low),
        np.append(upper, high),
    )


@pytest.mark.parametrize("changes", [ALL, SPEED, {"du_max": [INF, 0.5]}, {"x_min": -1.0}])
@pytest.mark.parametrize("soft", [False, True])
def test_the_sparse_program_equals_the_dense_rebuild(changes, soft):
    case, rng = instance("crossing", N, "exact", 0.5, 0), np.random.default_rng(1)
    this = problem(N, "exact", 0.5, max_obstacles=2, state_slack_weight=70.0, **changes)
    subproblem = Subproblem(this)
    subproblem.soft = soft
    for _ in range(2):
        x0, x_ref, u_last = rng.normal(size=4), rng.normal(size=(N + 1, 4)), rng.normal(size=2)
        step = StepData.read(this, x0, x_ref, case.obstacles, u_last=u_last)
        spaces = step.half_spaces(rng.normal(size=(N + 1, 4)), rng.uniform(1, 3, 2))
        subproblem.write_step(step.x0, step.x_ref, step.u_last)
        subproblem.write_half_spaces(spaces)
        program = subproblem.program
        found = program.P.toarray(), program.q, program.A.toarray(), program.lower, program.upper
        for mine, theirs in zip(found, slow(this, step, spaces, soft), strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-14, atol=1e-14)


def test_pack_and_unpack_are_inverse_and_find_the_excess():
    this, rng = problem(N, **ALL), np.random.default_rng(0)
    subproblem, ref = Subproblem(this), straight_reference(N)
    u_last = np.array([0.3, 0.0])
    subproblem.write_step(ref[0], ref, u_last)
    states, force = ref + rng.normal(size=ref.shape), np.zeros((N, 3))
    states[0] = ref[0]
    over, under = states[1:] > this.x_max, states[1:] < this.x_min
    force[over[:, 1:]], force[under[:, 1:]] = 100.0, -100.0
    rates = rng.normal(size=(N, 2))
    shapes = (N, 4), (N, 2), (1,), (1, N), (1, N)
    duals = Multipliers(*(rng.normal(size=s) for s in shapes), force, rates)
    inputs = this.limited(rng.uniform(-3, 3, (N, 2)), u_last)
    iterate = Iterate(states, inputs, np.full(1, 3.0), rng.uniform(0, 1, (1, N)), duals)
    z, y = subproblem.pack(iterate)
    again = subproblem.unpack(z, y)
    for name in ("states", "inputs", "s", "slack"):
        np.testing.assert_allclose(getattr(again, name), getattr(iterate, name), rtol=1e-14)
    for name, value in vars(duals).items():
        np.testing.assert_array_equal(getattr(again.multipliers, name), value)
    excess = this.excess(states)
    assert (excess > 0).any(axis=0)[1:].all()
    program = subproblem.program
    count = 5 * N  # four bounds of speed and one of the position, at each stage
    assert z[-count:].sum() == pytest.approx(excess.sum())
    assert program.q[-count:] @ z[-count:] == pytest.approx(this.penalty(np.zeros(0), states))
    unpaid = replace(iterate, multipliers=replace(duals, states=0.0 * force))
    assert not subproblem.pack(unpaid)[0][-count:].any()
    assert subproblem.residuals(unpaid).feasibility >= excess.max() * (1 - 1e-12)


@paths
@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("changes", [ALL, SPEED, {"du_min": -0.7, "du_max": 0.7}])
def test_plans_are_those_of_ipopt(changes, seed, there, condense):
    rng = np.random.default_rng(seed)
    this, ref = problem(N, **changes), straight_reference(N, rng.uniform(1.5, 3.0))
    x0 = np.array([0.0, rng.uniform(0.8, 2.6), rng.uniform(-0.2, 0.2), rng.uniform(-0.5, 0.5)])
    u_last = rng.uniform(-1.0, 1.0, 2)
    one = obstacle(N, (2.5, rng.uniform(-0.4, 0.4)), covariance=0.01 * np.eye(2))
    obstacles = [one] if there else []
    plan = SCP(this, Settings(condense=condense)).solve(x0, ref, obstacles, u_last=u_last)
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
def test_slack_is_what_the_brakes_leave_of_a_start_outside(condense):
    """3 m/s where 2 m/s are allowed: 0.2 m/s less at every stage, and no more."""
    this = problem(N, u_min=-1.0, **SPEED)
    ref = straight_reference(N, 3.0)
    plan = SCP(this, Settings(condense=condense)).solve(ref[0], ref)
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
    kept = SCP(this, Settings(condense=condense)).solve([0, 2.0, 0, 0], ref)
    assert kept.status is Status.CONVERGED
    assert kept.x_slack.max() <= 1e-7
    assert kept.multipliers.states[:, 0].min() > 0


@paths
def test_slack_at_lower_bounds_too_and_only_as_long_as_it_pays(condense):
    this = problem(N, x_min=[-INF, 0.5, -INF, -INF], u_max=1.0)
    still = SCP(this, Settings(condense=condense)).solve(np.zeros(4), np.zeros(4))
    np.testing.assert_allclose(still.x_slack[:, 1], [0.3, 0.1, *[0.0] * 6], atol=1e-7)
    np.testing.assert_allclose(still.multipliers.states[:2, 0], -100.0, rtol=1e-7)
    cheap = problem(N, x_min=[-INF, 0.5, -INF, -INF], u_max=1.0, state_slack_weight=1e-4)
    plan = SCP(cheap, Settings(condense=condense)).solve(np.zeros(4), np.zeros(4))
    assert plan.status is Status.SOFTENED
    assert plan.x_slack[:, 1].min() > 0.4


def test_the_certificate_sees_a_wrong_multiplier_and_a_wrong_input():
    this, ref = problem(N, **ALL), straight_reference(N, 3.0)
    plan = SCP(this, Settings(condense=False)).solve(ref[0], ref, u_last=np.zeros(2))
    subproblem = Subproblem(this)
    subproblem.write_step(ref[0], ref, np.zeros(2))
    duals = plan.multipliers
    assert subproblem.residuals(plan.iterate).worst < 1e-6
    assert np.abs(duals.rates).max() > 0.1
    for name in ("states", "rates"):
        flipped = replace(duals, **{name: -getattr(duals, name)})
        assert subproblem.residuals(replace(plan.iterate, multipliers=flipped)).worst > 0.1
    subproblem.write_step(ref[0], ref, np.array([1.0, 0.0]))
    assert subproblem.residuals(plan.iterate).feasibility > 0.5


@paths
def test_the_first_rate_counts_from_the_input_last_applied(condense):
    this, ref = problem(N, du_min=-0.3, du_max=0.4), straight_reference(N, 3.0)
    solver, x0 = SCP(this, Settings(condense=condense)), np.zeros(4)
    unknown = solver.solve(x0, ref)
    assert unknown.u0[0] == pytest.approx(3.0)
    for last, first in ((0.0, 0.4), (-1.0, -0.6), (2.9, 3.0), (3.2, 3.0), (-7.0, -3.0)):
        plan = solver.solve(x0, ref, u_last=[last, 0.0])
        assert plan.status is Status.CONVERGED
        assert plan.u0[0] == pytest.approx(first, abs=1e-9)
    plan = solver.solve(x0, -ref, u_last=[3.2, 0.0])
    assert plan.u0[0] == pytest.approx(2.9, abs=1e-9)  # the rate holds as soon as it can


@paths
def test_the_controller_remembers_its_input_unless_told_another(condense):
    this, ref = problem(N, du_min=-0.3, du_max=0.3), straight_reference(N, 3.0)
    mpc = MPC(this, Settings(condense=condense))
    first = mpc.step(np.zeros(4), -ref)
    assert first.u0[0] == pytest.approx(-3.0)
    assert mpc.step(np.zeros(4), ref).u0[0] == pytest.approx(-2.7, abs=1e-9)
    assert mpc.step(np.zeros(4), ref, u_last=[1.0, 0.0]).u0[0] == pytest.approx(1.3, abs=1e-9)
    assert mpc.step(np.zeros(4), ref).u0[0] == pytest.approx(1.6, abs=1e-9)
    mpc.reset()
    assert mpc.step(np.zeros(4), ref).u0[0] == pytest.approx(3.0)


@paths
def test_the_last_guard_knows_the_rates(condense, monkeypatch, caplog):
    this, ref = problem(N, du_min=-0.3, du_max=0.3), straight_reference(N)
    mpc = MPC(this, Settings(condense=condense))
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
def test_closed_loops_keep_inputs_and_rates_always(condense, targets, steps, seed):
    rng = np.random.default_rng(seed)
    limits = {"du_min": np.negative(steps[:2]), "du_max": steps[2:], **SPEED}
    this = problem(5, u_min=[-1.0, -2.0], **limits)
    mpc, x, last = MPC(this, Settings(condense=condense)), rng.normal(size=4), rng.normal(size=2)
    last = np.clip(last, this.u_min, this.u_max)
    for k in range(30):
        vx, vy = targets[k // 10]
        plan = mpc.step(x, [x[0] + vx, vx, vy, vy], u_last=last if k == 0 else None)
        assert plan.status.certified
        assert (this.u_min <= plan.U).all()
        assert (this.u_max >= plan.U).all()
        change = np.diff(np.vstack([last, plan.U]), axis=0)
        assert (change >= this.du_min - 1e-9).all()
        assert (change <= this.du_max + 1e-9).all()
        last = plan.u0
        x = this.model.step(x, last) + 0.02 * rng.normal(size=4)


def test_unpack_moves_inputs_into_rates():
    this, rng = problem(N, du_min=-0.3, du_max=0.2), np.random.default_rng(0)
    subproblem, last = Subproblem(this), np.array([1.0, -1.0])
    subproblem.write_step(np.zeros(4), np.zeros((N + 1, 4)), last)
    z = rng.normal(scale=3.0, size=len(subproblem.program.q))
    U = subproblem.unpack(z, np.zeros(len(subproblem.program.lower))).inputs
    change = np.diff(np.vstack([last, U]), axis=0)
    assert (change >= -0.3 - 1e-9).all()
    assert (change <= 0.2 + 1e-9).all()


def test_the_merit_includes_the_price_of_the_excess():
    this, ref = problem(N, u_min=-1.0, **SPEED), straight_reference(N, 3.0)
    sparse = SparseSCP(this, Settings(condense=False), Sampling.of(this, 1))
    sparse.begin(StepData.read(this, ref[0], ref, []), Stopwatch())
    end = sparse.descend(sparse.free(), 10)
    assert end.merit - end.cost == pytest.approx(100.0 * (0.8 + 0.6 + 0.4 + 0.2))


@paths
def test_bounds_hold_between_obstacles_that_are_constrained_between_samples(condense):
    """At 6 m/s the robot passes through the radii in one interval."""
    this = problem(N, nodes_per_interval=4, x_max=[INF, 6.0, 0.9, INF], du_min=-2.0, du_max=2.0)
    mpc, x, last = MPC(this, Settings(condense=condense)), np.array([0, 6.0, 0, 0]), np.zeros(2)
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
    y, most, shapes, points = zip(*ways, strict=True)
    assert max(y) > 0.2
    assert max(most) == pytest.approx(2.0)
    assert set(shapes) == {(1, N)}
    assert (1, 4 * N) in points
