"""The controller: deterministic, without side effects, untouched by bad calls."""

import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from instances import S_REF, instance, obstacle, problem, straight_reference

from scp_mpc import (
    MPC,
    SCP,
    BoundsError,
    ConcurrentUseError,
    CovarianceError,
    InvalidArgumentError,
    Iterate,
    Margin,
    NotFiniteError,
    ObstaclePrediction,
    QPSettings,
    Settings,
    ShapeError,
    TooManyObstaclesError,
    Trajectory,
)

N = 8
NAN, INF = np.nan, np.inf


def drive(mpc, steps, disturb=lambda _: None):
    """Drive along the x-axis past a slow obstacle; return the plans."""
    x, plans = np.array([0.0, 2.0, 0.05, 0.0]), []
    for k in range(steps):
        disturb(k)
        ref = straight_reference(N) + [0.4 * k, 0, 0, 0]
        plans.append(mpc.step(x, ref, [obstacle(N, (3.0 + 0.06 * k, 0.0), (0.3, 0.0))]))
        x = mpc.problem.model.step(x, plans[-1].u0)
    return plans


def same(first, second):
    return all(
        np.array_equal(a.X, b.X) and np.array_equal(a.U, b.U) and a.cost == b.cost
        for a, b in zip(first, second, strict=True)
    )


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


def good():
    ref = straight_reference(N)
    return {"x0": ref[0], "x_ref": ref, "obstacles": [obstacle(N, (1.5, 0.1))]}


ONE = obstacle(N, (1.0, 0.0))
BAD_STEPS = [
    ({"x0": np.ma.masked_array(np.zeros(4), [0, 1, 0, 0])}, InvalidArgumentError, "masked"),
    ({"x0": [1e200, 0, 0, 0]}, BoundsError, "1e\\+200"),
    ({"obstacles": None}, InvalidArgumentError, "obstacles"),
    ({"obstacles": ONE}, InvalidArgumentError, "obstacles"),
    ({"x0": np.zeros(3)}, ShapeError, "x0"),
    ({"x0": np.zeros((4, 1))}, ShapeError, "x0"),
    ({"x0": [0, 0, NAN, 0]}, NotFiniteError, "x0"),
    ({"x0": [0, INF, 0, 0]}, NotFiniteError, "x0"),
    ({"x0": "somewhere"}, InvalidArgumentError, "x0"),
    ({"x0": [1j, 0, 0, 0]}, InvalidArgumentError, "x0"),
    ({"x0": None}, InvalidArgumentError, "x0"),
    ({"x_ref": np.zeros((N, 4))}, ShapeError, "x_ref"),
    ({"x_ref": np.zeros((N + 1, 2))}, ShapeError, "x_ref"),
    ({"x_ref": np.full((N + 1, 4), NAN)}, NotFiniteError, "x_ref"),
    ({"obstacles": [obstacle(N, (1, 0))] * 2}, TooManyObstaclesError, "max_obstacles = 1"),
    ({"obstacles": [obstacle(N + 1, (1, 0))]}, ShapeError, "obstacles"),
    ({"obstacles": [np.zeros((N + 1, 2))]}, InvalidArgumentError, "obstacles"),
]


@pytest.mark.parametrize(("change", "error", "message"), BAD_STEPS)
def test_a_bad_step_is_refused_and_leaves_no_trace(change, error, message):
    mpc = MPC(problem(N))

    def interrupt(k):
        if k % 3 == 1:
            with pytest.raises(error, match=message):
                mpc.step(**{**good(), **change})

    assert same(drive(MPC(problem(N)), 9), drive(mpc, 9, interrupt))


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ((np.zeros((5, 2)), np.eye(3), 0.2), ShapeError, "covariances"),
        ((np.zeros((5, 2)), np.zeros((4, 2, 2)), 0.2), ShapeError, "covariances"),
        ((np.zeros((5, 4)), np.eye(4), 0.2), ShapeError, "means"),
        ((np.zeros((1, 2)), np.eye(2), 0.2), ShapeError, "1 row"),
        ((np.full((5, 2), NAN), np.eye(2), 0.2), NotFiniteError, "means"),
        ((np.zeros((5, 2)), [[INF, 0], [0, 1]], 0.2), NotFiniteError, "covariances"),
        ((np.zeros((5, 2)), [[1.0, 0.5], [0.4, 1.0]], 0.2), CovarianceError, "not symmetric"),
        # The report's own velocity covariance: determinant -1e-4.
        ((np.zeros((5, 2)), [[0.08, 0.05], [0.05, 0.03]], 0.2), CovarianceError, "-0.00"),
        ((np.zeros((5, 2)), np.eye(2), -0.1), BoundsError, "-0.1 m"),
        ((np.zeros((5, 2)), np.eye(2), NAN), NotFiniteError, "radius"),
    ],
)
def test_bad_predictions_are_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        ObstaclePrediction(*arguments)


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


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"horizon": 0}, BoundsError, "horizon"),
        ({"horizon": 2.5}, InvalidArgumentError, "horizon"),
        ({"horizon": True}, InvalidArgumentError, "horizon"),
        ({"margin": 2.4}, InvalidArgumentError, "margin"),
        ({"inflation": []}, InvalidArgumentError, "inflation"),
        ({"max_obstacles": 0.0}, InvalidArgumentError, "max_obstacles"),
        ({"Q": [1.0, 1.0]}, ShapeError, "Q"),
        ({"Q": [1.0, -1.0, 1.0, 1.0]}, CovarianceError, "-1"),
        ({"R": [[1.0, 2.0], [0.0, 1.0]]}, CovarianceError, "R"),
        ({"u_min": 3.0, "u_max": -3.0}, BoundsError, "3.0 exceeds u_max = -3.0"),
        ({"u_min": [0.0, NAN]}, NotFiniteError, "u_min"),
        ({"robot_radius": -0.15}, BoundsError, "-0.15"),
        ({"inflation": "square"}, InvalidArgumentError, "square"),
        ({"max_obstacles": -1}, BoundsError, "-1"),
        ({"slack_weight": 0.0}, BoundsError, "slack_weight"),
        ({"model": "car"}, InvalidArgumentError, "car"),
    ],
)
def test_bad_problems_are_refused(changes, error, message):
    with pytest.raises(error, match=message):
        problem(**{"horizon": N, **changes})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"lower": 3.0, "upper": 2.0}, "margin.lower"),
        ({"lower": -1.0}, "margin.lower"),
        ({"reference": 11.0}, "11.0"),
        ({"weight": 0.0}, "weight"),
        ({"upper": NAN}, "margin.upper"),
    ],
)
def test_bad_margins_are_refused(values, message):
    with pytest.raises(InvalidArgumentError, match=message):
        Margin(**values)


@pytest.mark.parametrize(
    "values",
    [
        {"tolerance": 0.0},
        {"tolerance": NAN},
        {"tolerance": 1e-9},  # finer than what the quadratic programs deliver
        {"max_iterations": 0},
        {"max_iterations": True},
        {"sides_interval": -2},
        {"sides": "no"},
        {"acceleration": 1},
        {"qp": None},
    ],
)
def test_bad_settings_are_refused(values):
    with pytest.raises(InvalidArgumentError):
        Settings(**values)


@pytest.mark.parametrize("values", [{"rescue": "piqp"}, {"cold": 0.0}, {"max_iterations": 0}])
def test_bad_qp_settings_are_refused(values):
    with pytest.raises(InvalidArgumentError):
        QPSettings(**values)


def test_settings_of_the_wrong_kind_are_refused():
    with pytest.raises(InvalidArgumentError, match="settings"):
        MPC(problem(N), QPSettings())


def test_a_bad_guess_is_refused():
    case = instance("ahead", N, "exact", S_REF, 0)
    solver = SCP(case.problem)
    arguments = (case.x0, case.x_ref, case.obstacles)
    for guess, error in (
        (Trajectory(np.zeros((4, 4)), np.zeros((3, 2))), ShapeError),
        ("straight on", InvalidArgumentError),
    ):
        with pytest.raises(error, match="guess"):
            solver.solve(*arguments, guess)
    with pytest.raises(ShapeError, match="states"):
        Trajectory(np.zeros((4, 4)), np.zeros((4, 2)))
    with pytest.raises(NotFiniteError, match="inputs"):
        Trajectory(np.zeros((4, 4)), np.full((3, 2), NAN))


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


def test_errors_survive_the_way_out_of_a_process():
    error = ShapeError("x0", "shape (3,) is not (4,)")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is ShapeError
    assert str(again) == str(error) == "x0: shape (3,) is not (4,)"
    assert again.argument == "x0"


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
        mpc, tried = MPC(case, Settings(sides_interval=interval)), []
        for _ in range(2):
            x = np.array([0.0, 2.0, 0.3, 0.0])
            for k in range(7):
                ref = straight_reference(20) + [0.4 * k, 0, 0, 0]
                blocking = [obstacle(20, (4.0 + 0.06 * k, 0.0), (0.3, 0.0), 0.3 * np.eye(2))]
                plan = mpc.step(x, ref, blocking)
                assert plan.iterate.touches
                tried.append(plan.candidates > 0)
                x = case.model.step(x, plan.u0)
            mpc.reset()
        pattern = [k % interval == 0 for k in range(7)]
        assert tried == pattern + pattern
