"""Candidates on other sides: on the boundary, on both sides, only where there is a conflict."""

import numpy as np
import pytest
from instances import S_REF, obstacle, problem, rotated, straight_reference

from scp_mpc import DoubleIntegrator, Iterate, ObstaclePrediction
from scp_mpc.solver.sides import candidates
from scp_mpc.solver.step_data import StepData

N = 20


def starts(case, reference, obstacles):
    """Candidates about a plan that follows the reference."""
    step = StepData.read(case, reference[0], reference, obstacles)
    M = case.max_obstacles
    free = Iterate(reference, np.zeros((N, case.model.nu)), np.full(M, S_REF), np.zeros((M, N)))
    value = step.half_spaces(free.states, free.s).value
    position = case.model.position
    return step, value, candidates(free, position, step.sets, value)


def test_planar_candidates_pass_left_and_right():
    case, ref = problem(N, "exact"), straight_reference(N)
    blocking = obstacle(N, (3.0, 0.1), (0.5, 0.0), rotated((0.4, 0.1), 0.7))
    step, value, (left, right) = starts(case, ref, [blocking])
    inside = value[0] < 0
    assert 2 < inside.sum() < N
    sides = []
    for start in (left, right):
        moved = (start.states != ref).any(axis=1)[1:]
        np.testing.assert_array_equal(moved, inside)
        spaces = step.half_spaces(start.states, start.s)
        np.testing.assert_allclose(spaces.value[0, inside], 0.0, atol=1e-9)
        normal = spaces.normal[0, inside]
        np.testing.assert_allclose(normal[:, 0], 0.0, atol=1e-7)  # square to the motion
        sides.append(set(np.sign(normal[:, 1])))
    assert sides in ([{1.0}, {-1.0}], [{-1.0}, {1.0}])


def test_the_first_conflict_in_time_decides():
    case, ref = problem(N, "exact", max_obstacles=2), straight_reference(N)
    near, far = obstacle(N, (2.0, 0.0)), obstacle(N, (6.0, 0.0))
    step, value, found = starts(case, ref, [far, near])
    for start in found:
        moved = np.flatnonzero((start.states != ref).any(axis=1)[1:])
        np.testing.assert_array_equal(moved, np.flatnonzero(value[1] < 0))
    assert len(found) == 2
    assert step.count == 2


def test_no_conflict_no_candidates():
    case, ref = problem(N, "exact"), straight_reference(N)
    assert starts(case, ref, [obstacle(N, (3.0, 5.0))])[2] == []
    assert starts(case, ref, [])[2] == []


def test_in_space_there_are_four_sides():
    case = problem(N, model=DoubleIntegrator(0.1, dim=3), Q=[1.0, 0.1] * 3, R=[0.01] * 3)
    ref = np.zeros((N + 1, 6))
    ref[:, 0], ref[:, 1] = 0.2 * np.arange(N + 1), 2.0
    ball = ObstaclePrediction(np.tile([2.0, 0.02, 0.05], (N + 1, 1)), 0.01 * np.eye(3), 0.2)
    step, value, found = starts(case, ref, [ball])
    assert len(found) == 4
    normals = [
        step.half_spaces(start.states, start.s).normal[0, value[0] < 0].mean(axis=0)
        for start in found
    ]
    np.testing.assert_allclose(np.sum(normals, axis=0), 0.0, atol=1e-6)
    np.testing.assert_allclose(np.array(normals)[:, 0], 0.0, atol=1e-6)


@pytest.mark.parametrize("inflation", ["exact", "axes"])
def test_keeping_pace_with_the_obstacle_still_gives_sides(inflation):
    """No relative motion: the sides are square to the way out."""
    case, ref = problem(N, inflation), straight_reference(N)
    alongside = obstacle(N, (0.1, 0.3), (2.0, 0.0))
    _, _, found = starts(case, ref, [alongside])
    assert len(found) == 2
    offsets = [(s.states - ref)[1:, [0, 2]] for s in found]
    assert all(np.isfinite(offset).all() for offset in offsets)
    moved = offsets[0].any(axis=1)
    assert moved.any()
    # Two sides, opposite to each other and square to the offset (-0.1, -0.3) from the obstacle.
    across = np.array([-0.3, 0.1]) / np.hypot(0.3, 0.1)
    sides = [np.sign((offset[moved] @ across).mean()) for offset in offsets]
    assert sorted(sides) == [-1.0, 1.0]


def test_an_obstacle_met_head_on_is_left_on_the_side_the_robot_comes_from():
    """At p = mu the offset now, p_0 - mu_0, decides: it points from the obstacle to the robot."""
    case, ref = problem(N, "exact"), straight_reference(N)
    x0 = ref[0] + [0.0, 0.0, 0.4, 0.0]
    centre = ObstaclePrediction(ref[:, [0, 2]] + [0.1, 0.0], 0.04 * np.eye(2), 0.2)
    step = StepData.read(case, x0, ref, [centre])
    np.testing.assert_allclose(step.start, [[-0.1, 0.4]])
    on_top = ref.copy()
    on_top[1:, [0, 2]] = centre.means[1:]
    normal = step.half_spaces(on_top, np.array([S_REF])).normal[0, 0]
    assert normal @ step.start[0] > 0
