"""How candidates leave polytopes: towards the side that was asked for, and all of them."""

import numpy as np
import pytest
from hulls import distance
from instances import S_REF, problem

from scp_mpc import ObstaclePrediction
from scp_mpc.obstacles import Polytope
from scp_mpc.scp.candidates import PassingPattern, Walls, candidate_paths, same_pattern
from scp_mpc.scp.step import Step

N = 8
UP = np.array([0.0, 1.0])
BOX, SLAB = Polytope.box([1.6, 1.0], angle=0.3), Polytope.box([0.4, 3.0])
THINGS = [
    ObstaclePrediction(
        np.array([1.5, 0.1]) + 0.05 * np.arange(N + 1)[:, None] * UP,
        0.01 * np.eye(2),
        0.1,
        shape=BOX,
    ),
    SLAB.static(N, (3.6, 0.3)),
]
RHO = np.array([0.15 + 0.1 + S_REF * 0.1, 0.15])
PATH = np.stack([np.linspace(0.0, 4.0, N), np.zeros(N)], axis=1)


@pytest.fixture
def step():
    case = problem(N, max_obstacles=2)
    return Step.read(case, np.zeros(4), np.zeros(4), THINGS)


def walls(step, *slots):
    return Walls.of(step, np.full(2, S_REF), np.array(slots), slice(0, N))


def rooms(path, j):
    """How far points are from an obstacle's no-go set, by search."""
    corners, y = THINGS[j].shape.vertices, path - THINGS[j].means[1:]
    return np.array([distance(corners, one) for one in y]) - RHO[j]


@pytest.mark.parametrize("side", [UP, -UP, np.array([-1.0, 0.0])])
def test_points_within_go_straight_to_the_side_and_no_others(step, side):
    moved = walls(step, 0).aside(PATH[None], side[None])[0]
    within = rooms(PATH, 0) < 0
    assert 2 <= within.sum() < N
    np.testing.assert_array_equal(moved[~within], PATH[~within])
    way = moved[within] - PATH[within]
    assert (way @ side > 0.05).all()
    np.testing.assert_allclose(way - (way @ side)[:, None] * side, 0.0, atol=1e-12)
    # At the boundary beside a face, off it by no more than the tip of a corner.
    assert (rooms(moved, 0)[within] > -1e-6).all()
    assert (rooms(moved, 0)[within] < RHO[0] * 0.42).all()


def test_out_of_one_and_of_what_comes_next():
    boxes = [Polytope.box([1.0, 1.0]).static(N, (0.0, y)) for y in (1.1, 0.0, 2.2)]
    case = problem(N, max_obstacles=3)
    stack = Step.read(case, np.zeros(4), np.zeros(4), boxes)
    moved = Walls.of(stack, np.zeros(3), np.arange(3), slice(0, N))
    moved = moved.aside(np.zeros((1, N, 2)), UP[None])[0]
    np.testing.assert_allclose(moved, np.tile([0.0, 2.85], (N, 1)))


def test_each_polytope_towards_a_side_of_its_own(step):
    apart = walls(step, 0, 1).apart(PATH, np.array([-UP, UP]))
    only_first = (rooms(PATH, 0) < 0) & (rooms(PATH, 1) > 0)
    only_second = (rooms(PATH, 0) > 0) & (rooms(PATH, 1) < 0)
    assert only_first.any()
    assert only_second.any()
    assert (apart[only_first, 1] < -0.2).all()
    assert (apart[only_second, 1] > 1.5).all()


def test_outward_is_through_the_nearest_face_bent_to_the_side(step):
    moved = walls(step, 1).outward(PATH[None], UP[None])[0]
    within = rooms(PATH, 1) < 0
    assert (rooms(moved, 1)[within] > -1e-6).all()
    assert (moved[within, 1] > 0).all()
    assert (np.abs(moved[within, 1]) < 0.3).all()  # not all the way along the slab


def test_flips_put_touching_stages_beyond_every_other_face(step):
    touched = np.zeros((1, N), dtype=bool)
    touched[0, 3] = True
    body = walls(step, 0)
    below = body.aside(PATH[None], -UP[None])[0]
    found = body.flips(below, touched, 1)
    assert len(found) == 3
    here = body.shapes.nearest(below[None] - body.means).normal[0, 3]
    seen = [here]
    for path in found:
        np.testing.assert_array_equal(np.delete(path, 3, axis=0), np.delete(below, 3, axis=0))
        near = body.shapes.nearest(path[None] - body.means)
        assert near.distance[0, 3] == pytest.approx(RHO[0])
        assert all(near.normal[0, 3] @ n < 0.9 for n in seen)
        seen.append(near.normal[0, 3])


def test_candidates_pass_polytopes_on_both_sides_together_and_apart(step):
    ways = candidate_paths(step, PATH, PATH, np.full(2, S_REF), most=32)
    heights = [(way.path[3, 1], way.path[6, 1]) for way in ways]
    for first, second in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        assert any(a * first > 0.1 and b * second > 0.1 for a, b in heights)
    (waiting,) = [way.path for way in ways if way.waits]
    assert rooms(waiting, 0).min() > 0
    np.testing.assert_array_equal(waiting[-1], waiting[-2])


def test_the_two_faces_of_a_long_wall_are_two_sides():
    """Seen from its middle both lie in almost the same direction."""
    wall = Polytope.box([0.2, 20.0]).static(N, (2.0, 0.0))
    case = problem(N, max_obstacles=1)
    step = Step.read(case, np.zeros(4), np.zeros(4), [wall])
    touched = np.ones((1, N), dtype=bool)
    left, right, up = (
        PassingPattern(np.tile(p, (N, 1)), touched) for p in ([1.7, 9.0], [2.3, 9.0], [1.7, -9.0])
    )
    assert not same_pattern(step, left, right)
    assert same_pattern(step, left, up)
