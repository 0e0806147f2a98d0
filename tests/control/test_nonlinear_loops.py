"""Nonlinear robots in closed loops: past obstacles, back on their line, with all of their discs."""

from itertools import product

import numpy as np
import pytest
from instances import obstacle, problem, straight_reference
from nonlinear_cases import MODELS, machine_problem, straight

from scp_mpc import (
    MPC,
    SCP,
    DoubleIntegrator,
    FunctionModel,
    ObstaclePrediction,
    Settings,
    Status,
    Trajectory,
)

SETTINGS = Settings(multi_start=False, max_iterations=100, deadline=None)


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
    # Both from a path on the same side: there are several, and the two search in different ways.
    path = SCP(linear, SETTINGS).solve(x0, ref, obstacles, u_last=[0.1, 0.0])
    guess = Trajectory(path.X, 0.5 * path.U)
    plans = [
        SCP(p, SETTINGS).solve(x0, ref, obstacles, guess, u_last=[0.1, 0.0])
        for p in (linear, other)
    ]
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


# A robot that is only a function takes its time: 8 intervals of 2 points are the quick version.
LOOPS = [
    pytest.param(count, name, 15, marks=pytest.mark.slow if name == "function" else ())
    for count, name in product([1, 4], MODELS)
]


@pytest.mark.parametrize(("nodes_per_interval", "name", "horizon"), [*LOOPS, (2, "function", 8)])
def test_closed_loops_pass_the_obstacle_and_keep_rates(name, nodes_per_interval, horizon):
    case = machine_problem(name, horizon, nodes_per_interval=nodes_per_interval)
    room = 0.25 * (case.u_max - case.u_min)
    case = machine_problem(
        name, horizon, nodes_per_interval=nodes_per_interval, du_min=-room, du_max=room
    )
    model, shift = case.model, np.zeros(case.model.nx)
    shift[model.position[0]] = 1.5 * model.dt
    ref, at = straight(model, horizon), np.zeros(model.dim)
    at[:2] = 3.0, 0.1
    there = ObstaclePrediction(np.tile(at, (horizon + 1, 1)), 0.01 * np.eye(model.dim), 0.25)
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


@pytest.mark.parametrize("name", ["unicycle", "bicycle"])
def test_a_robot_that_is_pushed_about_goes_on_from_its_last_plan(name):
    """Rolled out open loop, an error of the heading now would grow over the whole horizon."""
    case = machine_problem(name, 30)
    rng, mpc = np.random.default_rng(1), MPC(case, SETTINGS)
    ball = obstacle(30, (12.0, 0.1), (0.1, 0.0))
    ref, plans = straight(case.model, 30, 6.0), []
    state = ref[0]
    for _ in range(12):
        plans.append(mpc.step(state + 0.05 * rng.normal(size=case.model.nx), ref, [ball]))
        state, ref = case.model.step(state, plans[-1].u0), ref + (ref[1] - ref[0])
    assert all(plan.status is Status.CONVERGED for plan in plans)
    assert max(plan.iterations for plan in plans[1:]) <= 5
    assert max(plan.cost for plan in plans) < 4.0


def test_no_good_plan_is_forgotten_for_a_clear_one():
    """A bicycle that is pushed off its line finds back; plans' costs fall all the way."""
    case = machine_problem("bicycle", 20, nodes_per_interval=1)
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
    case = machine_problem("bicycle", 20, nodes_per_interval=4, discs=discs)
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
