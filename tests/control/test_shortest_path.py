"""Shortest paths: against lengths known by hand, a judge that samples, and what is refused."""

import numpy as np
import pytest

from scp_mpc import (
    BoundsError,
    DoubleIntegrator,
    NotFiniteError,
    ObstaclePrediction,
    Polytope,
    Problem,
    Quadrotor,
    ShapeError,
)
from scp_mpc.control import shortest_path

N, RADIUS, CELL = 10, 0.3, 0.05
START, GOAL = np.zeros(2), np.array([6.0, 0.0])


def problem(**more):
    given = {"Q": [1, 0.1, 1, 0.1], "R": [0.1, 0.1], "u_min": -2.0, "u_max": 2.0}
    given |= {"horizon": N, "robot_radius": RADIUS}
    return Problem(DoubleIntegrator(0.2), **(given | more))


def disc(x, y, radius, speed=0.0):
    means = np.array([x, y]) + 0.2 * speed * np.arange(N + 1)[:, None] * [0.0, 1.0]
    return ObstaclePrediction(means, np.zeros((2, 2)), radius)


def box(low, high):
    low, high = np.array(low), np.array(high)
    return Polytope.box(high - low).static(N, at=(low + high) / 2)


def room(found, obstacles):
    """Least distance of a path's finest samples from discs and boxes, by hand."""
    p = found.positions(np.linspace(0, found.length, 4001))
    gaps = []
    for o in obstacles:
        half = np.zeros(2) if o.shape is None else o.shape.vertices.max(axis=0)
        outside = np.maximum(np.abs(p - o.means[0]) - half, 0.0)
        gaps.append(np.hypot(*outside.T).min() - o.radius - RADIUS)
    return min(gaps)


def around(radius, away):
    """Length of tangent, arc and tangent around a disc halfway between points 2 away apart."""
    return 2 * (np.sqrt(away**2 - radius**2) + radius * (np.pi / 2 - np.arccos(radius / away)))


def test_with_nothing_in_the_way_it_is_a_line():
    for others in ([], [disc(3.0, 0.0, 0.5, speed=0.5)], [disc(3.0, 2.0, 0.5)]):
        found = shortest_path(problem(), START, GOAL, others)
        np.testing.assert_allclose(found.positions(found.knots), [START, GOAL])


@pytest.mark.parametrize("radius", [0.2, 1.0, 2.0])
def test_around_a_disc(radius):
    obstacles = [disc(3.0, 0.0, radius)]
    found = shortest_path(problem(), START, GOAL, obstacles, clearance=0.1)
    best = around(radius + RADIUS + 0.1, 3.0)
    assert best - 0.01 < found.length < 1.02 * best
    assert 0.1 - CELL**2 / (4 * RADIUS) <= room(found, obstacles) < 0.1 + CELL


def test_around_a_wall_and_out_of_a_pocket():
    wall = [box([3.0, -1.0], [3.2, 2.0])]
    found = shortest_path(problem(), START, GOAL, wall, clearance=0.0)
    assert found.length == pytest.approx(2 * np.hypot(2.9, 1.3) + 0.3, rel=0.03)
    # A pocket that opens towards the start: the way to the goal leads back first.
    start = np.array([2.5, 0.0])
    pocket = [*wall, box([0.0, -1.2], [3.2, -1.0]), box([0.0, 2.0], [3.2, 2.2])]
    found = shortest_path(problem(), start, GOAL, pocket)
    assert found.positions(found.knots)[:, 0].min() < 0.0
    assert room(found, pocket) > 0.04


@pytest.mark.parametrize("seed", range(8))
def test_it_keeps_clear_among_many(seed):
    rng = np.random.default_rng(seed)
    obstacles = [disc(*rng.uniform([1, -2], [5, 2]), rng.uniform(0.1, 0.4)) for _ in range(6)]
    for x, y in rng.uniform([1.0, -2.0], [5.0, 2.0], (6, 2)):
        width, height = rng.uniform(0.1, 0.6, 2)
        obstacles.append(box([x, y], [x + width, y + height]))
    found = shortest_path(problem(), START, GOAL, obstacles)
    assert found is not None
    assert room(found, obstacles) >= 0.05 - CELL**2 / (4 * RADIUS)
    # A finer grid finds no way that is much shorter, whatever the lines made of it.
    fine = shortest_path(problem(), START, GOAL, obstacles, cell=0.02)
    assert fine.length == pytest.approx(found.length, rel=0.05)


def test_margins_and_bounds_count():
    person = ObstaclePrediction.static(N, [3.0, 0.0], 0.2)
    vague = ObstaclePrediction(person.means, 0.04 * np.eye(2), 0.2)
    lengths = [shortest_path(problem(), START, GOAL, [o]).length for o in (person, vague)]
    assert lengths[1] == pytest.approx(around(0.2 + RADIUS + 0.05 + 2.4477 * 0.2, 3.0), rel=0.02)
    assert lengths[1] > lengths[0] + 0.1
    low = [-np.inf, -np.inf, -0.5, -np.inf]
    wall = [box([3.0, -1.0], [3.2, 2.0])]
    for start in (START, [0.0, -0.7]):  # the short way is out of bounds
        found = shortest_path(problem(x_min=low), start, GOAL, wall)
        assert found.positions(found.knots)[:, 1].max() > 2.3


def test_there_is_no_way():
    ring = [box([-2, 2], [9, 2.2]), box([-2, -2.2], [9, -2]), box([-2, -2], [-1.8, 2])]
    door = [box([3.0, -2.0], [3.2, -0.45]), box([3.0, 0.45], [3.2, 2.0])]
    shut = [box([3.0, -2.0], [3.2, 2.0])]
    ring.append(box([8.8, -2], [9, 2]))
    assert shortest_path(problem(), START, GOAL, ring + door) is not None
    assert shortest_path(problem(robot_radius=0.44), START, GOAL, ring + door) is None
    assert shortest_path(problem(), START, GOAL, ring + shut) is None
    assert shortest_path(problem(), START, GOAL, [disc(6.0, 0.0, 0.5)]) is None
    near = shortest_path(problem(), START, GOAL, [disc(6.2, 0.0, 0.2)], tolerance=0.5)
    assert near.positions(near.length) == pytest.approx([5.65, 0.0], abs=CELL)


def test_start_and_goal_may_be_close_to_something():
    walls = [box([-2.0, -0.51], [0.5, -0.31]), box([5.0, 0.31], [7.0, 0.5])]
    found = shortest_path(problem(), START, GOAL, walls, clearance=0.2)
    assert 0.005 < room(found, walls) < 0.0101
    inside = shortest_path(problem(), START, GOAL, [disc(0.3, 0.0, 0.2)])
    assert room(inside, [disc(0.3, 0.0, 0.2)]) == pytest.approx(-0.2, abs=0.01)


def test_misuse_is_refused():
    plane = problem()

    def path(problem=plane, goal=GOAL, **more):
        return shortest_path(problem, START, goal, [], **more)

    with pytest.raises(BoundsError, match=r"goal: \[0.0, 0.0\] m is where the path starts"):
        path(goal=START)
    with pytest.raises(BoundsError, match="clearance: -1"):
        path(clearance=-1.0)
    with pytest.raises(BoundsError, match="cell: 0"):
        path(cell=0.0)
    with pytest.raises(NotFiniteError, match="goal"):
        path(goal=[np.nan, 0.0])
    flying = Problem(
        Quadrotor(0.1), horizon=N, Q=np.ones(Quadrotor.nx), R=np.ones(4), u_min=-1, u_max=9
    )
    with pytest.raises(ShapeError, match="moves in 3-D"):
        path(problem=flying)
