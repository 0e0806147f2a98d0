"""More obstacles than slots: the most dangerous are kept, and the plan says how many were not."""

import logging

import numpy as np
import pytest

from scp_mpc import (
    MPC,
    SCP,
    DoubleIntegrator,
    InvalidArgumentError,
    ObstaclePrediction,
    Polytope,
    Problem,
    Settings,
    ShapeError,
    TooManyObstaclesError,
)
from scp_mpc.control.selection import clearances

N, DT = 20, 0.1
ALONE = Settings(deadline=None)


def problem(slots, **changes):
    values = {
        "horizon": N, "Q": [1, 0.1, 1, 0.1], "R": [0.1, 0.1], "u_min": -2, "u_max": 2,
        "robot_radius": 0.3, "max_obstacles": slots, "nodes_per_interval": 1, **changes,
    }  # fmt: skip
    return Problem(DoubleIntegrator(DT), **values)


def walker(at, velocity=(0.0, 0.0), name=None, std=0.05):
    means = np.array(at) + DT * np.arange(N + 1)[:, None] * np.array(velocity)
    return ObstaclePrediction(means, std**2 * np.eye(2), 0.3, name=name)


@pytest.mark.parametrize("seed", range(3))
def test_clearances_are_those_of_a_loop(seed):
    rng = np.random.default_rng(seed)
    obstacles = []
    for j in range(6):
        means = rng.normal(scale=3, size=2) + np.cumsum(rng.normal(scale=0.2, size=(N + 1, 2)), 0)
        shape = Polytope.box([2.0, 0.5], angle=rng.uniform(0, 3)) if j % 3 == 0 else None
        obstacles.append(ObstaclePrediction(means, np.eye(2), 0.1 * j, shape=shape))
    paths = rng.normal(scale=3, size=(2, N + 1, 2))
    wanted = np.full(6, np.inf)
    for j, o in enumerate(obstacles):
        for path in paths:
            for i, p in enumerate(path):
                y = p - o.means[i]
                gap = np.linalg.norm(y) if o.shape is None else distance(o.shape, y)
                wanted[j] = min(wanted[j], gap - o.radius)
    np.testing.assert_allclose(clearances(obstacles, paths), wanted, atol=1e-9)


def distance(shape, y):
    """Signed distance to a polygon: of the edges' segments outside, of its faces inside."""
    inside = (shape.normals @ y - shape.offsets).max()
    if inside <= 0:
        return inside
    a, b = shape.vertices[shape.edges[:, 0]], shape.vertices[shape.edges[:, 1]]
    t = np.clip(((y - a) * (b - a)).sum(1) / ((b - a) ** 2).sum(1), 0, 1)
    return np.linalg.norm(a + t[:, None] * (b - a) - y, axis=1).min()


def test_eight_with_room_for_six():
    """Without an error, and as if the two that do not matter were not there."""
    crowd = [walker([1.5 + 0.4 * j, 1.0 - (j % 2) * 2.2], name=j) for j in range(6)]
    far = [walker([-9.0, 5.0], name="a"), walker([20.0, 20.0], name="b")]
    everybody = [crowd[0], far[0], *crowd[1:4], far[1], *crowd[4:]]
    many, few = MPC(problem(6), ALONE), MPC(problem(6), ALONE)
    x, goal = np.zeros(4), [5.0, 0.0, 0.0, 0.0]
    for _ in range(4):
        plan, other = many.step(x, goal, everybody), few.step(x, goal, crowd)
        assert (plan.left_out, other.left_out) == (2, 0)
        assert [o.name for o in many.obstacles] == list(range(6))
        assert plan.s.shape == (6,)
        np.testing.assert_array_equal(plan.U, other.U)
        x = many.problem.model.step(x, plan.u0)


def test_who_will_be_in_the_way_counts_not_who_is_near():
    beside, behind = walker([0.5, 1.6], (0.0, 1.0)), walker([-1.5, 0.0], (-1.0, 0.0))
    oncoming = walker([5.0, 0.0], (-1.5, 0.0), name="oncoming")
    mpc, x = MPC(problem(1), ALONE), np.array([0.0, 1.0, 0.0, 0.0])
    for _ in range(5):
        plan = mpc.step(x, [5.0, 0.0, 0.0, 0.0], [beside, oncoming, behind])
        assert [o.name for o in mpc.obstacles] == ["oncoming"]
        assert plan.left_out == 2


def test_who_comes_to_where_the_robot_would_brake_counts():
    """The plan is gone from there by then; a robot that brakes would not be."""
    mpc, x = MPC(problem(1), ALONE), np.array([0.0, 1.2, 0.0, 0.0])
    goal = [9.0, 0.0, 0.0, 0.0]
    ahead = walker([6.9, 0.0], name="ahead")  # the plan ends at 6.3 m
    late = walker([0.36, -2.5], (0.0, 1.2), name="late")  # braking ends at 0.36 m
    assert mpc.step(x, goal).X[-1, 0] == pytest.approx(6.3, abs=0.1)
    apart = clearances([ahead, late], mpc.nominal().states[None, :, [0, 2]])
    assert apart[0] < apart[1]
    mpc.step(x, goal, [ahead, late])
    assert [o.name for o in mpc.obstacles] == ["late"]


def test_a_backups_path_is_its_inputs_then_braking_then_rest():
    mpc, x = MPC(problem(1), ALONE), np.array([0.0, 1.0, 0.5, -0.4])
    inputs = 0.1 * np.ones((3, 2))
    for backup, last in ((inputs, None), (None, np.zeros(2))):
        path = mpc._backups.path(x, backup, last)
        state = x
        given = [] if backup is None else list(backup)
        for u in given:
            state = mpc.problem.model.step(state, u)
        stop, states = mpc._backups.stopping(state, given[-1] if given else last)
        np.testing.assert_allclose(path[len(given)], state)
        np.testing.assert_allclose(path[len(given) : len(given) + len(stop) + 1], states)
        np.testing.assert_allclose(path[-1], states[-1])


def test_no_slot_at_all_is_no_licence(caplog):
    mpc = MPC(problem(0), ALONE)
    assert mpc.step(np.zeros(4), np.zeros(4)).left_out == 0
    with pytest.raises(TooManyObstaclesError, match="1 exceed max_obstacles = 0"):
        mpc.step(np.zeros(4), np.zeros(4), [walker([3.0, 0.0])])
    with pytest.raises(TooManyObstaclesError, match="2 exceed max_obstacles = 1"):
        SCP(problem(1)).solve(np.zeros(4), np.zeros(4), [walker([3.0, 0.0])] * 2)
    assert not caplog.records


def test_it_is_said_once(caplog):
    mpc, two = MPC(problem(1), ALONE), [walker([3.0, 0.0]), walker([9.0, 0.0])]
    for given, said in ((two, 1), (two, 1), (two[:1], 1), (two, 2)):
        mpc.step(np.zeros(4), np.zeros(4), given)
        assert len(caplog.records) == said
    assert caplog.records[0].levelno == logging.WARNING


def test_too_many_bad_ones_are_refused_and_leave_no_trace():
    mpc = MPC(problem(1), ALONE)
    good = walker([3.0, 0.0])
    mpc.step(np.zeros(4), np.zeros(4), [good])
    before = mpc.obstacles
    short = ObstaclePrediction(good.means[:-1], good.covariances[:-1], 0.3)
    other = ObstaclePrediction(good.means, good.covariances, 0.3, dt=0.5)
    for bad, error in ((short, ShapeError), (other, InvalidArgumentError)):
        with pytest.raises(error, match=r"obstacles\[1\]"):
            mpc.step(np.zeros(4), np.zeros(4), [good, bad])
    with pytest.raises(ShapeError, match="x0"):
        mpc.step(np.zeros(3), np.zeros(4), [good, good])
    assert mpc.obstacles == before
