"""The controller: deterministic, without side effects, one thread at a time."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from driving import N, drive, good, same
from instances import obstacle, problem, straight_reference

from scp_mpc import (
    MPC,
    SCP,
    ConcurrentUseError,
    InvalidArgumentError,
    Iterate,
    ObstaclePrediction,
    Settings,
    Status,
)

NAN, INF = np.nan, np.inf


def test_same_steps_same_bits():
    assert same(drive(MPC(problem(N)), 12), drive(MPC(problem(N)), 12))


def test_reset_restores_bit_identity():
    mpc = MPC(problem(N))
    first = drive(mpc, 12)
    mpc.reset()
    assert same(first, drive(mpc, 12))


def test_two_controllers_do_not_know_of_each_other():
    alone = drive(MPC(problem(N)), 6)
    other = MPC(problem(N))
    together = drive(MPC(problem(N)), 6, lambda _: drive(other, 2))
    assert same(alone, together)


@pytest.mark.parametrize(
    "covariance", [np.zeros((2, 2)), np.diag([1.0, 0.0]), 1e12 * np.eye(2), 1e-12 * np.eye(2)]
)
@pytest.mark.parametrize("inflation", ["exact", "axes"])
def test_extreme_covariances_give_finite_inputs(covariance, inflation):
    step = good() | {"obstacles": [obstacle(N, (1.5, 0.1), covariance=covariance)]}
    plan = MPC(problem(N, inflation)).step(**step)
    assert np.isfinite(plan.X).all()
    assert (np.abs(plan.U) <= 3.0).all()
    assert np.isfinite(plan.cost)


@pytest.mark.parametrize("inflation", ["exact", "axes"])
def test_an_obstacle_on_the_robot_gives_finite_inputs(inflation):
    ref = straight_reference(N)
    on_top = ObstaclePrediction(ref[:, [0, 2]], 0.04 * np.eye(2), 0.2)
    plan = MPC(problem(N, inflation)).step(ref[0], ref, [on_top])
    assert np.isfinite(plan.U).all()
    assert (np.abs(plan.U) <= 3.0).all()
    assert not plan.ok


def test_arguments_are_never_written_to():
    step = good()
    means, covariances = np.ones((N + 1, 2)), np.tile(0.04 * np.eye(2), (N + 1, 1, 1))
    weights = np.array([0.2, 0.05, 0.2, 0.05])
    arrays = [step["x0"], step["x_ref"], means, covariances, weights]
    before = [a.tobytes() for a in arrays]
    mpc = MPC(problem(N, Q=weights))
    for _ in range(3):
        mpc.step(step["x0"], step["x_ref"], [ObstaclePrediction(means, covariances, 0.2)])
    assert before == [a.tobytes() for a in arrays]


def test_a_prediction_does_not_follow_its_source_arrays():
    means = np.ones((N + 1, 2))
    prediction = ObstaclePrediction(means, np.eye(2), 0.2)
    means[:] = 7.0
    assert (prediction.means == 1.0).all()
    with pytest.raises(ValueError, match="read-only"):
        prediction.means[0] = 3.0


def test_views_lists_and_other_types_mean_the_same_numbers():
    step = good()
    plain = MPC(problem(N)).step(**step)
    whole = np.arange(4)
    for x0, x_ref in (
        (step["x0"].tolist(), step["x_ref"].tolist()),
        (np.repeat(step["x0"], 2)[::2], np.asfortranarray(step["x_ref"])),
        (step["x0"][::-1].copy()[::-1], step["x_ref"][::-1].copy()[::-1]),
    ):
        other = MPC(problem(N)).step(x0, x_ref, step["obstacles"])
        np.testing.assert_array_equal(other.X, plain.X)
    as_int, as_float = (
        MPC(problem(N)).step(whole.astype(kind), step["x_ref"], step["obstacles"])
        for kind in (np.int32, np.float32)
    )
    np.testing.assert_array_equal(as_int.X, as_float.X)


def test_a_constant_reference_is_held():
    goal = np.array([2.0, 0.0, 1.0, 0.0])
    held = MPC(problem(N)).step(np.zeros(4), goal)
    spelt_out = MPC(problem(N)).step(np.zeros(4), np.tile(goal, (N + 1, 1)))
    np.testing.assert_array_equal(held.X, spelt_out.X)


def test_standing_still_at_the_goal_is_silent(capfd):
    mpc = MPC(problem(N, max_obstacles=0))
    for _ in range(3):
        plan = mpc.step(np.zeros(4), np.zeros(4))
        assert np.abs(plan.u0).max() < 1e-9
    assert capfd.readouterr() == ("", "")


def test_obstacles_may_come_and_go():
    mpc = MPC(problem(N, max_obstacles=2))
    ref = straight_reference(N)
    one, two = obstacle(N, (1.5, 0.1)), obstacle(N, (2.0, -0.9))
    for present in ([one], [], [one, two], [two], [two, one], []):
        plan = mpc.step(ref[0], ref, present)
        assert plan.ok, plan.status
        assert plan.s.shape == (len(present),)


def test_a_plan_cannot_be_edited_into_the_next_step():
    mpc = MPC(problem(N))
    plan = mpc.step(**good())
    for array in (plan.X, plan.U, plan.s, plan.slack, plan.u0):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 7.0


def test_any_iterable_of_obstacles_will_do():
    step = good()
    plain = MPC(problem(N)).step(**step)
    lazy = MPC(problem(N)).step(step["x0"], step["x_ref"], (o for o in step["obstacles"]))
    np.testing.assert_array_equal(plain.X, lazy.X)


def test_problem_takes_numpy_numbers_and_can_be_varied():
    case = problem(np.int64(N), max_obstacles=np.int32(2))
    assert (case.horizon, case.max_obstacles) == (N, 2)
    longer = replace(case, horizon=20)
    assert longer.horizon == 20
    np.testing.assert_array_equal(longer.Q, case.Q)
    assert type(longer.no_go) is type(case.no_go)


def test_concurrent_use_of_one_controller_raises():
    """While a step is under way (here: within a generator of obstacles), another is refused."""
    mpc = MPC(problem(N))
    step = good()

    def meddling():
        with pytest.raises(ConcurrentUseError):
            mpc.step(**step)
        yield from step["obstacles"]

    meddled = mpc.step(step["x0"], step["x_ref"], meddling())
    np.testing.assert_array_equal(meddled.X, MPC(problem(N)).step(**step).X)


def test_controllers_in_threads_equal_serial_ones():
    with ThreadPoolExecutor(2) as pool:
        threaded = list(pool.map(lambda _: drive(MPC(problem(N)), 12), range(2)))
    serial = drive(MPC(problem(N)), 12)
    assert same(threaded[0], serial)
    assert same(threaded[1], serial)


def test_points_without_extent_have_an_empty_no_go_set():
    """Zero covariance and zero radii: nothing to keep out of, and nothing to divide by."""
    for inflation in ("exact", "axes"):
        ref = straight_reference(N)
        point = ObstaclePrediction(np.tile([1.5, 0.0], (N + 1, 1)), np.zeros((2, 2)), 0.0)
        plan = MPC(problem(N, inflation, robot_radius=0.0)).step(ref[0], ref, [point])
        assert plan.ok, plan.status
        assert np.isfinite(plan.U).all()


def test_multipliers_and_guesses_are_safe_from_each_other():
    """A plan's multipliers are read-only; a caller's guess stays as writable as it was."""
    case = problem(N)
    plan = SCP(case).solve(**good())
    with pytest.raises(ValueError, match="read-only"):
        plan.multipliers.obstacles[...] = NAN
    mine = Iterate(*(np.array(a) for a in (plan.X, plan.U, plan.iterate.s, plan.iterate.slack)))
    before = [a.copy() for a in (mine.states, mine.inputs, mine.s, mine.slack)]
    step = good()
    SCP(case).solve(step["x0"], step["x_ref"], step["obstacles"], mine)
    for array, copy in zip((mine.states, mine.inputs, mine.s, mine.slack), before, strict=True):
        np.testing.assert_array_equal(array, copy)
        array[...] = 1.0


def test_sides_are_tried_at_first_contact_and_then_at_intervals():
    """Trailing exactly behind a slow obstacle keeps it in touch with every plan."""
    case = problem(20)
    for interval in (1, 3):
        mpc, tried = MPC(case, Settings(multi_start_interval=interval)), []
        for _ in range(2):
            x = np.array([0.0, 2.0, 0.3, 0.0])
            for k in range(7):
                ref = straight_reference(20) + [0.4 * k, 0, 0, 0]
                blocking = [obstacle(20, (4.0 + 0.06 * k, 0.0), (0.3, 0.0), 0.3 * np.eye(2))]
                plan = mpc.step(x, ref, blocking)
                assert plan.iterate.touches
                tried.append(len(plan.candidates) > 0)
                x = case.model.step(x, plan.u0)
            mpc.reset()
        pattern = [k % interval == 0 for k in range(7)]
        assert tried == pattern + pattern


def test_a_deadline_drops_other_sides_first_then_iterations():
    """Where there is no time for the first program, the robot brakes if that is safe."""
    case, ref = problem(20), straight_reference(20)
    blocking = [obstacle(20, (3.0, 0.1), (0.5, 0.0))]
    patient = SCP(case).solve(ref[0], ref, blocking)
    assert patient.candidates
    hurried = SCP(case, Settings(deadline=1e-9)).solve(ref[0], ref, blocking)
    assert hurried.candidates == ()
    assert hurried.iterations == 0
    assert hurried.status is Status.BRAKING
    np.testing.assert_allclose(hurried.u0, [-3.0, 0.0])
    other = SCP(case, Settings(deadline=1e-9, solver="piqp")).solve(ref[0], ref, blocking)
    assert (other.iterations, other.status) == (0, Status.BRAKING)
    # The free plan is no shortcut's victim: it takes no iteration at all.
    clear = SCP(case, Settings(deadline=1e-9)).solve(ref[0], ref)
    assert clear.status is Status.CONVERGED


@pytest.mark.parametrize("deadline", [0.0, -1.0, NAN, "soon"])
def test_deadlines_are_positive_seconds(deadline):
    with pytest.raises(InvalidArgumentError, match="deadline"):
        Settings(deadline=deadline)
