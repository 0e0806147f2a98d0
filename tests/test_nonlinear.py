"""Nonlinear robots: convergence against IPOPT, defects, and agreement with the linear path."""

import itertools

import numpy as np
import pytest
from instances import obstacle, problem, straight_reference
from machines import KINDS, MODELS, machine_problem, ride, straight
from referee_models import ModelReferee

from scp_mpc import (
    MPC,
    SCP,
    DoubleIntegrator,
    FunctionModel,
    InvalidArgumentError,
    ObstaclePrediction,
    Settings,
    Status,
    Trajectory,
    Unicycle,
)

INSTANCES = [
    ride(name, kind, horizon, 0)
    for name, kind, horizon in itertools.product(MODELS, KINDS, (8, 20))
]
OTHER_OPTIMA = 3  # of 32 that may end in another local optimum than IPOPT from the same guess
SETTINGS = Settings(sides=False, max_iterations=100)


def defects(model, plan):
    """How far the states are from where the inputs lead, stage by stage."""
    ends = [model.step(x, u) for x, u in zip(plan.X[:-1], plan.U, strict=True)]
    return np.abs(plan.X[1:] - ends).max()


@pytest.fixture(scope="module")
def outcomes():
    """Every instance once: our plan, IPOPT from there, and IPOPT from the same guess."""
    rows = {}
    for case in INSTANCES:
        model, N = case.problem.model, case.problem.horizon
        guess = Trajectory(case.x_ref, np.tile(model.idle, (N, 1)))
        plan = SCP(case.problem, SETTINGS).solve(case.x0, case.x_ref, case.obstacles, guess)
        bounds = {"x_min": case.problem.x_min, "x_max": case.problem.x_max}
        referee = ModelReferee(case.problem, case.x0, case.x_ref, case.obstacles, **bounds)
        far = referee.solve(guess.states, guess.inputs, near=False)
        rows[case.name] = case, plan, referee.solve(plan.X, plan.U, near=True), far
    return rows


NAMES = [case.name for case in INSTANCES]


@pytest.mark.parametrize("name", NAMES)
def test_certified_without_defects_and_not_improved_by_ipopt(outcomes, name):
    case, plan, near, _ = outcomes[name]
    assert plan.status is Status.CONVERGED
    assert plan.kkt.worst <= 1e-6
    assert defects(case.problem.model, plan) <= 1e-8
    assert near.ok
    assert plan.cost == pytest.approx(near.cost, rel=2e-6)
    np.testing.assert_allclose(plan.X, near.X, atol=1e-3)


def test_from_the_same_guess_the_optimum_is_mostly_that_of_ipopt(outcomes):
    gaps = [(plan.cost - far.cost) / far.cost for _, plan, _, far in outcomes.values() if far.ok]
    assert len(gaps) >= 30
    assert sum(gap > 1e-3 for gap in gaps) <= OTHER_OPTIMA


def test_instances_are_worth_solving(outcomes):
    touching = [plan.iterate.touches for _, plan, _, _ in outcomes.values()]
    assert sum(touching) >= 28


def as_function(model):
    """A double integrator that nobody knows to be linear."""
    A, B = model.A, model.B

    def f(x, u):
        return x @ A.T + u @ B.T

    def slopes(x, _):
        lead = x.shape[:-1]
        return np.broadcast_to(A, (*lead, *A.shape)), np.broadcast_to(B, (*lead, *B.shape))

    options = {"nx": 4, "nu": 2, "dt": model.dt, "position": [0, 2]}
    return FunctionModel(f, slopes, discrete=True, vectorised=True, **options)


BOUNDED = {"x_max": [np.inf, 2.1, 0.6, 1.0], "du_min": -0.8, "du_max": 0.8}


@pytest.mark.parametrize("changes", [{}, BOUNDED], ids=["free", "bounded"])
@pytest.mark.parametrize("s_min", [2.4, 0.5])
def test_a_linear_robot_given_as_a_function_gets_the_same_plan(changes, s_min):
    changes = {"R": [0.05, 0.05], **changes}
    linear = problem(20, "exact", s_min, 2, **changes)
    other = problem(20, "exact", s_min, 2, model=as_function(DoubleIntegrator(0.2)), **changes)
    ref = straight_reference(20)
    obstacles = [obstacle(20, (3.0, 0.15)), obstacle(20, (5.0, -0.6), (-0.3, 0.1))]
    x0 = ref[0] + [0.0, 0.1, 0.1, 0.2]
    plans = [SCP(p, SETTINGS).solve(x0, ref, obstacles, u_last=[0.1, 0.0]) for p in (linear, other)]
    for plan in plans:
        assert plan.status is Status.CONVERGED
        assert plan.iterate.touches
    mine, theirs = plans
    assert theirs.cost == pytest.approx(mine.cost, rel=1e-6)
    np.testing.assert_allclose(theirs.X, mine.X, atol=1e-4)
    for name in ("obstacles", "inputs", "dynamics", "states", "rates", "margin"):
        a, b = (getattr(plan.multipliers, name) for plan in plans)
        np.testing.assert_allclose(b, a, atol=1e-3 * (1 + np.abs(a).max(initial=0.0)))


def drive(mpc, x, reference, predictions, steps):
    """Closed loop; returns plans and states."""
    plans, states = [], [x]
    for k in range(steps):
        plans.append(mpc.step(states[-1], reference(k), predictions(k)))
        states.append(mpc.problem.model.step(states[-1], plans[-1].u0))
    return plans, np.array(states)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("subsamples", [1, 4])
def test_closed_loops_pass_the_obstacle_and_keep_rates(name, subsamples):
    case = machine_problem(name, 15, subsamples=subsamples)
    room = 0.25 * (case.u_max - case.u_min)
    case = machine_problem(name, 15, subsamples=subsamples, du_min=-room, du_max=room)
    model, shift = case.model, np.zeros(case.model.nx)
    shift[model.position[0]] = 1.5 * model.dt
    ref, at = straight(model, 15), np.zeros(model.dim)
    at[:2] = 3.0, 0.1
    there = ObstaclePrediction(np.tile(at, (16, 1)), 0.01 * np.eye(model.dim), 0.25)
    mpc = MPC(case)
    plans, states = drive(mpc, ref[0], lambda k: ref + k * shift, lambda _: [there], 25)
    assert all(plan.ok for plan in plans)
    assert sum(plan.status is Status.CONVERGED for plan in plans) >= 24
    inputs = np.array([plan.u0 for plan in plans])
    assert (np.abs(np.diff(inputs, axis=0)) <= room + 1e-9).all()
    clear = np.linalg.norm(states[1:, model.position] - at, axis=1) - 0.55 - 2.0 * 0.1
    assert clear.min() >= -1e-6
    assert states[-1, model.position[0]] > 4.0
    mpc.reset()
    again, _ = drive(mpc, ref[0], lambda k: ref + k * shift, lambda _: [there], 3)
    np.testing.assert_array_equal(again[-1].U, plans[2].U)


def test_no_good_plan_is_forgotten_for_a_clear_one():
    """A bicycle that is pushed off its line finds back; plans' costs fall all the way."""
    case = machine_problem("bicycle", 20, subsamples=1)
    model, ref = case.model, straight(case.model, 20, speed=3.0)
    shift = np.array([3.0 * model.dt, 0, 0, 0, 0])
    there = ObstaclePrediction(np.tile([4.0, 0.2], (21, 1)), 0.01 * np.eye(2), 0.3)
    plans, _ = drive(MPC(case), ref[0], lambda k: ref + k * shift, lambda _: [there], 30)
    costs = np.array([plan.cost for plan in plans])
    assert plans[0].iterate.touches
    assert not plans[-1].iterate.touches
    assert (np.diff(costs[5:]) <= 1e-6 + 0.02 * costs[5:-1]).all()
    assert costs[-1] < 0.01 * costs.max()


@pytest.mark.parametrize("discs", [[-0.4, 0.4], [0.0, 0.5, 1.0]])
def test_discs_keep_out_with_all_of_them(discs):
    case = machine_problem("bicycle", 20, subsamples=4, discs=discs)
    model, ref = case.model, straight(case.model, 20)
    there = ObstaclePrediction(np.tile([3.0, 0.1], (21, 1)), np.zeros((2, 2)), 0.25)
    plan = SCP(case).solve(ref[0], ref, [there])
    assert plan.status is Status.CONVERGED
    assert plan.slack.shape == (1, 20)
    nearest = np.inf
    for share in np.linspace(0.0, 1.0, 21):
        x = model.advance(plan.X[:-1], plan.U, share)
        for offset in discs:
            ahead = np.stack([np.cos(x[:, 2]), np.sin(x[:, 2])], axis=1)
            gap = np.linalg.norm(x[:, :2] + offset * ahead - [3.0, 0.1], axis=1) - 0.55
            nearest = min(nearest, gap.min())
    assert -1e-6 <= nearest < 0.2  # clear all along, and not by staying away


def test_a_start_beyond_a_bound_of_the_state_is_reported():
    case = machine_problem("unicycle", 15, x_max=[np.inf, np.inf, np.inf, 1.0])
    ref = straight(case.model, 15, speed=0.8)
    x0 = ref[0] + [0, 0, 0, 1.2]
    plan = SCP(case, SETTINGS).solve(x0, ref)
    assert plan.status is Status.SOFTENED
    assert plan.x_slack[0, 3] == pytest.approx(x0[3] - 2.0 * case.model.dt - 1.0, abs=1e-6)
    assert plan.x_slack[4:].max() < 1e-9


def test_a_far_start_converges_through_the_trust_region():
    """Heading backwards, at rest, two metres beside the line."""
    case = machine_problem("unicycle", 25)
    ref = straight(case.model, 25)
    for theta in (2.0, -2.5, 3.0):
        plan = SCP(case, SETTINGS).solve([0.0, 2.0, theta, 0.0], ref)
        assert plan.status is Status.CONVERGED
        assert defects(case.model, plan) <= 1e-8


def test_misuse_is_refused():
    with pytest.raises(InvalidArgumentError, match="condense"):
        SCP(machine_problem("unicycle", 8), Settings(condense=False))
    with pytest.raises(InvalidArgumentError, match="R: is singular"):
        SCP(machine_problem("unicycle", 8, R=[1.0, 0.0]))
    with pytest.raises(InvalidArgumentError, match="no heading"):
        problem(8, discs=[0.0, 1.0])
    with pytest.raises(InvalidArgumentError, match="discs"):
        machine_problem("unicycle", 8, discs=[])


def test_a_model_that_breaks_down_ends_on_the_ladder(capfd):
    """Where f has no value, the input is still one that can be applied."""
    fine = Unicycle(0.2)

    def f(x, u):
        return np.where(x[..., :1] > 1.0, np.nan, fine.advance(x, u))

    def slopes(x, u):
        there = fine.linearise(x, u)
        return there.A, there.B

    options = {"nx": 4, "nu": 2, "dt": 0.2, "position": [0, 1], "heading": 2}
    robot = FunctionModel(f, slopes, discrete=True, vectorised=True, **options)
    values = {"horizon": 10, "Q": [1, 1, 0.1, 0.1], "R": [0.1, 0.1], "u_min": -2, "u_max": 2}
    mpc = MPC(type(machine_problem("unicycle", 8))(robot, **values))
    ref = straight(fine, 10)
    for x in ([0.0, 0, 0, 1.5], [0.9, 0, 0, 1.5], [2.0, 0, 0, 1.5]):
        with np.errstate(all="ignore"):
            plan = mpc.step(x, ref)
        assert np.isfinite(plan.u0).all()
        assert (np.abs(plan.u0) <= 2).all()
    assert plan.status is Status.FALLBACK
    assert np.isfinite(plan.X).all()
    assert not capfd.readouterr().out
