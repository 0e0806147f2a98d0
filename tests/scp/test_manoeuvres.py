"""Standing is no answer where the goal is elsewhere, and swerving none where it is dear."""

from itertools import product

import numpy as np
import pytest

from scp_mpc import MPC, SCP, DoubleIntegrator, ObstaclePrediction, Problem, Settings, Status
from scp_mpc.geometry.margin import Containment
from scp_mpc.models import KinematicBicycle, Quadrotor, Unicycle
from scp_mpc.scp.manoeuvres import manoeuvres
from scp_mpc.scp.step import Step
from scp_mpc.trajectory import Trajectory, rollout

INF = np.inf


def parked(reverse=0.0, horizon=25, **changes):
    """A unicycle that may drive backwards as fast as this."""
    values = {
        "horizon": horizon,
        "Q": [1.0, 1.0, 0.0, 0.05],
        "R": [0.02, 0.02],
        "u_min": -2.0,
        "u_max": 2.0,
        "x_min": [-INF, -INF, -INF, -reverse],
        "x_max": [INF, INF, INF, 1.5],
    }
    return Problem(Unicycle(0.1), **{**values, **changes})


def steered(reverse, horizon=25):
    return Problem(
        KinematicBicycle(0.1, 0.5, 0.25),
        horizon=horizon,
        Q=[1.0, 1.0, 0.0, 0.05, 0.01],
        R=[0.02, 0.02],
        u_min=-2.0,
        u_max=2.0,
        x_min=[-INF, -INF, -INF, -reverse, -0.6],
        x_max=[INF, INF, INF, 1.5, 0.6],
    )


def driven(problem, goal, heading=0.0, steps=90):
    mpc, x = MPC(problem, Settings(deadline=None)), np.zeros(problem.model.nx)
    x[2] = heading
    x_ref = np.zeros(problem.model.nx)
    x_ref[:2] = goal
    plans = []
    for _ in range(steps):
        plans.append(mpc.step(x, x_ref))
        x = problem.model.step(x, plans[-1].u0)
    return plans, float(np.hypot(*(x[problem.model.position] - goal)))


@pytest.mark.parametrize(
    ("goal", "reverse"), [((0.0, 1.0), 1.0), ((-2.0, 0.0), 0.0), ((0.1, -3.0), 0.0)]
)
def test_a_unicycle_turns_towards_a_goal_beside_or_behind_it(goal, reverse):
    plans, away = driven(parked(reverse), goal, steps=60)
    assert away < 0.1
    assert not any(p.status is Status.CONVERGED and p.kkt.curvature < -1e-6 for p in plans)


def test_a_bicycle_reverses_where_it_may_and_turns_round_where_not():
    assert driven(steered(1.0), (-1.0, 0.5), steps=45)[1] < 0.1
    assert driven(steered(0.0, 40), (-3.0, 0.5), steps=55)[1] < 0.1


def test_a_robot_that_stands_is_given_a_new_goal_behind_it():
    problem = parked()
    mpc, x = MPC(problem, Settings(deadline=None)), np.zeros(4)
    for goal in (1.0, -1.0):
        for _ in range(45):
            x = problem.model.step(x, mpc.step(x, [goal, 0.0, 0.0, 0.0]).u0)
        assert abs(x[0] - goal) < 0.1


def test_a_robot_at_its_goal_tries_nothing():
    problem = parked(1.0)
    plan = MPC(problem, Settings(deadline=None)).step([1.0, 2.0, 0.3, 0.0], [1.0, 2.0, 0.0, 0.0])
    assert plan.cost == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("robot", ["unicycle", "bicycle"])
def test_the_first_manoeuvre_is_the_best_of_all(robot):
    problem = parked(0.5, 8, speed_max=1.0) if robot == "unicycle" else steered(0.5)
    model, N = problem.model, problem.horizon
    rng = np.random.default_rng(5)
    x0 = np.zeros(model.nx)
    x0[2:4] = rng.uniform(-1, 1), 0.1
    x_ref = np.zeros((N + 1, model.nx))
    x_ref[:, :2] = [-1.5, 0.7]
    step = Step.read(problem, x0, x_ref, [])

    def resting(x, u):
        """The input, less what leads further out of bounds."""
        u = np.array(u, dtype=float)
        for i in range(model.nu):
            still = u.copy()
            still[i] = 0.0
            now, then = (
                problem.row_excess(np.stack([x, model.step(x, v)])).sum() for v in (u, still)
            )
            u = still if then < now else u
        return u

    best = np.inf
    corners = list(product((0.0, -2.0, 2.0), repeat=2))
    for first, second in product(corners, repeat=2):
        for share in (0.25, 0.5, 0.75):
            x, states, inputs = x0, [x0], []
            for k in range(N):
                u = resting(x, first if k < round(share * N) else second)
                x = model.step(x, u)
                states.append(x)
                inputs.append(u)
            best = min(best, problem.cost(np.array(states), np.array(inputs), np.ones(1), x_ref))
    found = manoeuvres(step, 3)
    costs = [problem.cost(rollout(model.step, x0, u).states, u, np.ones(1), x_ref) for u in found]
    assert costs[0] == pytest.approx(best, rel=1e-9)
    assert costs == sorted(costs)
    assert len({tuple(u[0]) for u in found}) == len(found) == 3


def test_many_inputs_are_tried_one_at_a_time():
    problem = Problem(
        Quadrotor(0.1),
        horizon=6,
        Q=np.ones(9),
        R=np.ones(4),
        u_min=[2, -4, -4, -4],
        u_max=[18, 4, 4, 4],
    )
    step = Step.read(problem, np.zeros(9), np.ones(9), [])
    off = manoeuvres(step, 5)[:, 0] != problem.model.equilibrium_input
    assert (off.sum(axis=1) <= 1).all()
    assert off.any()


@pytest.mark.parametrize("factor", [1.0, 1e2, 1e6])
def test_where_swerving_is_dear_the_robot_waits(factor):
    """Weights six decades apart: what is cheapest from rest is not missed from the reference."""
    N, t = 20, 0.1 * np.arange(21)[:, None]
    problem = Problem(
        DoubleIntegrator(0.1),
        horizon=N,
        Q=[1.0, 0.01, factor, 0.01 * factor],
        R=[0.01, 0.01],
        u_min=-3.0,
        u_max=3.0,
        robot_radius=0.3,
        margin=Containment(0.95),
        nodes_per_interval=1,
    )
    x_ref = problem.model.state(np.hstack([t, 0 * t]), np.tile([1.0, 0.0], (N + 1, 1)))
    obstacle = [ObstaclePrediction(np.tile([1.4, 0.1], (N + 1, 1)), 0.01 * np.eye(2), 0.3)]
    solver = SCP(problem)
    plan = solver.solve(x_ref[0], x_ref, obstacle)
    stop = rollout(problem.model.step, x_ref[0], np.tile([-0.5, 0.0], (N, 1)))
    waits = solver.solve(x_ref[0], x_ref, obstacle, Trajectory(stop.states, stop.inputs))
    assert plan.status is Status.CONVERGED
    assert plan.cost <= 2 * waits.cost
    if factor > 1:
        side = SCP(problem, Settings(multi_start=False)).solve(x_ref[0], x_ref, obstacle)
        assert plan.cost < side.cost / 2
        assert plan.cost <= 1.01 * waits.cost
