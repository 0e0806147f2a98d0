"""Ways past an obstacle: out of the no-go set, on both sides, only where there is a conflict."""

import numpy as np
import pytest
from instances import S_REF, obstacle, problem, rotated, straight_reference
from solving import half_spaces

from scp_mpc import SCP, DoubleIntegrator, ObstaclePrediction, Settings
from scp_mpc.scp.candidates import MAX_CANDIDATES, PassingPattern, candidate_paths, same_pattern
from scp_mpc.scp.multi_start import Incumbent
from scp_mpc.scp.step import Step

N = 20
S = np.array([S_REF])


def conflicts(step, path, s):
    """Which no-go sets a path (C, d) enters: (J, C)."""
    return step.depths(path, s) > 0


def ways(case, reference, obstacles, present=None):
    """Ways past, about a plan that follows the reference; not those that wait."""
    step = Step.read(case, reference[0], reference, obstacles)
    free = reference[1:, case.model.position]
    s = np.full(case.max_obstacles, S_REF)
    found = candidate_paths(step, free, free if present is None else present, s)
    return step, [way for way in found if not way.waits]


def test_one_path_stays_in_front_of_the_first_obstacle():
    case, ref = problem(N, "exact", max_obstacles=2), straight_reference(N)
    obstacles = [obstacle(N, (x, 0.1), growth=0.0) for x in (4.0, 2.5)]
    step, free = Step.read(case, ref[0], ref, obstacles), ref[1:, [0, 2]]
    found = candidate_paths(step, free, free, np.full(2, S_REF))
    (waiting,) = [way for way in found if way.waits]
    first = int(conflicts(step, free, np.full(2, S_REF))[1].argmax())
    assert waiting.obstacle == 1
    np.testing.assert_allclose(waiting.normal, [-1.0, 0.0], atol=1e-12)
    np.testing.assert_array_equal(waiting.path[:first], free[:first])
    np.testing.assert_array_equal(waiting.path[first:], np.tile(free[first - 1], (N - first, 1)))
    assert not conflicts(step, waiting.path, np.full(2, S_REF)).any()


def test_the_free_plans_own_time_passes_left_and_right():
    """At tau = 0 every point of the conflict moves square to the motion, out of the axes' set."""
    case, ref = problem(N, "axes"), straight_reference(N)
    blocking = obstacle(N, (3.0, 0.1), (0.5, 0.0), rotated((0.4, 0.1), 0.7))
    step, found = ways(case, ref, [blocking])
    free = ref[1:, [0, 2]]
    inside = conflicts(step, free, S)[0]
    assert 2 < inside.sum() < N
    left, right = (side for side in found if side.time == 0)
    for side in (left, right):
        shift = side.path - free
        np.testing.assert_array_equal(shift.any(axis=1), inside)
        np.testing.assert_allclose(shift[:, 0], 0.0, atol=1e-9)
        assert (shift[inside] @ side.normal > 0).all()
        value = half_spaces(step, side.path, S).value[0]
        np.testing.assert_allclose(value[inside], 0.0, atol=1e-9)
    np.testing.assert_allclose(left.normal, -right.normal)


@pytest.mark.parametrize("inflation", ["exact", "axes"])
def test_no_way_leads_through_the_conflict(inflation):
    case, ref = problem(N, inflation), straight_reference(N)
    step, found = ways(case, ref, [obstacle(N, (3.0, 0.1), (0.5, 0.0))])
    stages = np.flatnonzero(conflicts(step, ref[1:, [0, 2]], S)[0])
    assert {side.time for side in found} == {0.0, -1.0, 1.0, -2.0}
    assert len(found) == 8
    for side in found:
        offset = side.path[stages] - step.means[0, stages + 1]
        y = offset / (S_REF * np.sqrt(np.diagonal(step.covariances[0, stages + 1], 0, 1, 2)) + 0.35)
        assert (np.linalg.norm(y, axis=1) >= 1 - 1e-9).all()


def test_the_first_conflict_comes_first_and_others_keep_the_present_plan():
    case, ref = problem(N, "exact", max_obstacles=2), straight_reference(N)
    near, far = obstacle(N, (2.0, 0.0)), obstacle(N, (6.0, 0.0))
    present = ref[1:, [0, 2]] + [0.0, 1.5]
    step, found = ways(case, ref, [far, near], present)
    conflict = conflicts(step, ref[1:, [0, 2]], np.full(2, S_REF))
    assert [side.obstacle for side in found] == [1] * 8 + [0] * 8
    for side in found[:8]:
        np.testing.assert_array_equal(side.path[conflict[0]], present[conflict[0]])
        assert not np.array_equal(side.path[conflict[1]], present[conflict[1]])


def test_only_the_first_of_two_conflicts_with_one_obstacle_changes():
    """An obstacle that comes back: each candidate passes it once, and keeps to the plan later."""
    case, ref = problem(40, "exact"), straight_reference(40)
    ahead = ref[:, [0, 2]] + [0.0, 3.0]
    ahead[5:8] = ahead[30:34] = 0.0
    ahead[5:8] = ref[5:8][:, [0, 2]]
    ahead[30:34] = ref[30:34][:, [0, 2]]
    twice = ObstaclePrediction(ahead, 0.01 * np.eye(2), 0.2)
    present = ref[1:, [0, 2]] + [0.0, -2.0]
    _, found = ways(case, ref, [twice], present)
    assert found
    for side in found:
        np.testing.assert_array_equal(side.path[29:33], present[29:33])


def test_no_conflict_no_candidates():
    case, ref = problem(N, "exact"), straight_reference(N)
    assert ways(case, ref, [obstacle(N, (3.0, 5.0))])[1] == []
    assert ways(case, ref, [])[1] == []


def test_many_obstacles_do_not_make_many_candidates():
    case, ref = problem(N, "exact", max_obstacles=6), straight_reference(N)
    row = [obstacle(N, (1.0 + j, 0.1)) for j in range(6)]
    assert len(ways(case, ref, row)[1]) == MAX_CANDIDATES


def test_in_space_there_are_four_sides():
    case = problem(N, model=DoubleIntegrator(0.1, dim=3), Q=[1.0, 0.1] * 3, R=[0.01] * 3)
    ref = np.zeros((N + 1, 6))
    ref[:, 0], ref[:, 1] = 0.2 * np.arange(N + 1), 2.0
    ball = ObstaclePrediction(np.tile([2.0, 0.02, 0.05], (N + 1, 1)), 0.01 * np.eye(3), 0.2)
    _, found = ways(case, ref, [ball])
    normals = np.array([side.normal for side in found if side.time == 0])
    assert len(normals) == 4
    np.testing.assert_allclose(normals.sum(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(normals[:, 0], 0.0, atol=1e-12)


@pytest.mark.parametrize("inflation", ["exact", "axes"])
def test_keeping_pace_with_the_obstacle_still_gives_sides(inflation):
    """No relative motion: the sides are square to the way out."""
    case, ref = problem(N, inflation), straight_reference(N)
    step, found = ways(case, ref, [obstacle(N, (0.1, 0.3), (2.0, 0.0))])
    assert all(np.isfinite(side.path).all() for side in found)
    offset = ref[1, [0, 2]] - step.means[0, 1]
    for side in found:
        assert side.normal @ offset == pytest.approx(0.0, abs=1e-9)


def test_the_same_way_is_the_same_stages_on_the_same_side():
    case, ref = problem(N, "exact"), straight_reference(N)
    step, found = ways(case, ref, [obstacle(N, (3.0, 0.1), (0.5, 0.0))])
    touched = conflicts(step, ref[1:, [0, 2]], S)
    left, right = (PassingPattern(side.path, touched) for side in found if side.time == 0)
    assert same_pattern(step, left, left)
    assert not same_pattern(step, left, right)
    fewer = touched.copy()
    fewer[0, np.flatnonzero(touched[0])[0]] = False
    assert not same_pattern(step, left, PassingPattern(left.path, fewer))


def test_an_obstacle_met_head_on_is_left_on_the_side_the_robot_comes_from():
    """At p = mu the offset now, p_0 - mu_0, decides: it points from the obstacle to the robot."""
    case, ref = problem(N, "exact"), straight_reference(N)
    x0 = ref[0] + [0.0, 0.0, 0.4, 0.0]
    centre = ObstaclePrediction(ref[:, [0, 2]] + [0.1, 0.0], 0.04 * np.eye(2), 0.2)
    step = Step.read(case, x0, ref, [centre])
    start = step.here - step.means[0, 0]
    np.testing.assert_allclose(start, [-0.1, 0.4])
    normal = half_spaces(step, centre.means[1:], np.array([S_REF])).normal[0, 0]
    assert normal @ start > 0


def test_rivals_begin_at_the_state_not_at_the_reference(monkeypatch):
    case, ref = problem(20), straight_reference(20)
    solver = SCP(case, Settings(max_candidates=3))
    x0, starts = ref[0] + [-0.3, 0.2, 0.2, 0.0], []
    start_from = Incumbent.start

    def noting(present, one):
        plan = start_from(present, one)
        starts.append(plan.rollout)
        return plan

    monkeypatch.setattr(Incumbent, "start", noting)
    solver.solve(x0, ref, [obstacle(20, (3.0, 0.1), (0.5, 0.0))])
    assert starts
    for start in starts:
        x = x0
        for i, u in enumerate(start.inputs):
            x = case.model.step(x, u)
            np.testing.assert_allclose(start.deviations[i], x - ref[i + 1], atol=1e-9)
            np.testing.assert_allclose(start.positions[i], (x - x0)[[0, 2]], atol=1e-9)
