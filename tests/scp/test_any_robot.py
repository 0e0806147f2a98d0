"""Any robot in any scene: what a step promises, judged by what the plan really does."""

import pickle
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
from any_robot import DT, ROBOTS, complaints, scene, start, world

from scp_mpc import MPC, SCP, ObstaclePrediction, Problem, Settings
from scp_mpc.models import KinematicBicycle, Unicycle
from scp_mpc.scp import Iterate, KKTResiduals, Multipliers, Status
from scp_mpc.scp.nodes import Nodes
from scp_mpc.scp.plan import Result
from scp_mpc.simulation.crowds import Crowd


def drive(robot, seed, steps=2):
    """Plans along a run with pushes, and what is wrong with them."""
    problem, rng = world(robot, seed, horizon=4, most=2)
    mpc, x, last, plans, said = MPC(problem), start(problem, rng), None, [], []
    for _ in range(steps):
        made, goal = scene(problem, rng, x)
        obstacles = [obstacle for obstacle, _ in made]
        given = x.copy(), goal.copy()
        plan = mpc.step(x, goal, obstacles)
        assert np.array_equal(x, given[0])
        assert np.array_equal(goal, given[1])
        known = last if problem.limits_rates else None
        said += complaints(problem, x, made, plan, known)
        plans.append(plan)
        last = plan.u0
        x = problem.model.step(x, last) + 0.05 * rng.normal(size=x.shape)
    return plans, said


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize("seed", [1, 6, 9])
def test_plans_are_what_they_say(robot, seed):
    _, said = drive(robot, seed)
    assert not said


def test_steps_repeat_bit_for_bit():
    (one, _), (other, _) = drive("unicycle", 2), drive("unicycle", 2)
    assert all(a.U.tobytes() == b.U.tobytes() for a, b in zip(one, other, strict=True))


def car(model, **changes):
    values = {
        "horizon": 3, "Q": [1.0] * 2 + [0.1] * (model.nx - 2), "R": [0.01] * 2,
        "u_min": -2.0, "u_max": 2.0, "robot_radius": 0.2,
    }  # fmt: skip
    return Problem(model, **(values | changes))


@pytest.mark.parametrize("model", [Unicycle(DT), KinematicBicycle(DT, 1.0)])
def test_several_discs_between_samples_without_obstacles(model):
    problem = car(model, discs=[-0.3, 0.3], nodes_per_interval=4)
    mpc, far = MPC(problem), ObstaclePrediction.static(3, [0.5, 0.1], 0.2)
    x = model.state(np.zeros(2), np.array([6.0, 0.0]))
    goal = model.state(np.array([5.0, 0.0]), np.zeros(2))
    mpc.step(x, goal, [far])
    plan = mpc.step(x, goal, [])
    assert plan.ok  # the last plan's nodes are between the samples
    assert plan.slack.shape == (0, 3)
    assert plan.step.nodes.interpolated(np.zeros((0, 4, 2))).shape == (0, 3 * 4 * 2 + 1, 2)


def test_deviation_is_that_of_the_path_and_not_of_its_samples():
    problem = car(Unicycle(DT))
    states, inputs = [np.array([0.0, 0.0, 0.0, 3.0])], np.array([[0.0, 2.0], [0.0, -2.0]] * 2)
    for u in inputs:  # turns that cancel from one chord to the next
        states.append(problem.model.step(states[-1], u))
    nodes = Nodes.of(replace(problem, horizon=4, nodes_per_interval=1))
    truth = 3.0 / 2.0 * (1 - np.cos(0.2))  # of an arc of 0.4 rad and 1.5 m radius
    np.testing.assert_allclose(nodes.deviation(np.array(states), inputs), truth, rtol=1e-3)


@pytest.mark.parametrize(("slack", "force", "wanted"), [(0, 0, False), (0, 1, True), (1, 0, True)])
def test_ways_past_are_tried_where_an_obstacle_matters(slack, force, wanted):
    rows, none = np.ones((1, 3)), np.zeros((3, 4))
    duals = Multipliers(none, none, np.zeros(1), -force * rows, 0 * rows)
    point = Iterate(np.zeros((4, 4)), np.zeros((3, 2)), np.zeros(1), slack * rows, duals)
    residuals = KKTResiduals(1.0, 1.0, 1.0)
    problem = car(Unicycle(DT))
    for settings, known, expected in (
        (Settings(), object(), wanted),
        (Settings(), None, False),  # no program was solved
        (Settings(multi_start=False), object(), False),
    ):
        end = Result(point, 0.0, 0.0, residuals, Status.VIOLATING, 1, known)
        assert SCP(problem, settings)._multi_start.wanted(end, due=False) is expected


def test_a_crowds_problem_keeps_the_rest():
    crowd = Crowd(8, 3)
    assert crowd.problem().max_obstacles == 3
    assert crowd.problem().nodes_per_interval == 1


def test_copies_of_a_problem_are_as_frozen_and_plan_alike():
    problem = car(Unicycle(DT), Qf=[2.0] * 4, du_max=0.5, x_max=2.0, discs=[-0.1, 0.1])
    x, goal = np.zeros(4), np.array([1.0, 0.5, 0.0, 0.0])
    plan = MPC(problem).step(x, goal)
    for copy in (pickle.loads(pickle.dumps(problem)), deepcopy(problem), replace(problem)):
        for name in Problem.__dataclass_fields__:
            value = getattr(copy, name)
            if isinstance(value, np.ndarray):
                assert np.array_equal(value, getattr(problem, name))
                assert not value.flags.writeable, name
        assert MPC(copy).step(x, goal).U.tobytes() == plan.U.tobytes()
