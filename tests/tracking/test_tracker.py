"""The tracker: who is followed, from when to when, and what is refused."""

import numpy as np
import pytest

from scp_mpc import MPC, DoubleIntegrator, ObstaclePrediction, Problem, Settings, StalenessPolicy
from scp_mpc.errors import (
    BoundsError,
    CovarianceError,
    InvalidArgumentError,
    NotFiniteError,
    ShapeError,
    StaleDataError,
)
from scp_mpc.tracking import WALKING_AND_TURNING, Motion, Tracker, TrackerSettings

CONFIRMED = TrackerSettings(confirmations=2)


def tracker(settings=None, **changes):
    values = {"dt": 0.2, "horizon": 10, "radius": 0.3, "measurement_std": 0.05, **changes}
    return Tracker(**values, settings=settings)


def state(tracker):
    return tracker.time, tracker.names, *(a.tolist() for a in tracker.estimates())


def test_a_walk_is_predicted():
    follower = tracker()
    for k in range(20):
        follower.update(0.4 * k, [[0.48 * k, 1.0]], ["ann"])
    (ann,) = follower.predictions()
    assert isinstance(ann, ObstaclePrediction)
    assert (ann.name, ann.radius, ann.horizon) == ("ann", 0.3 + TrackerSettings().room, 10)
    assert ann.stamp == pytest.approx(7.6)
    walk = np.stack([9.12 + 1.2 * 0.2 * np.arange(11), np.ones(11)], axis=1)
    assert np.abs(ann.means - walk).max() < 0.02
    assert (np.diff(ann.largest_std) > 0).all()
    eigenvalues = np.linalg.eigvalsh(ann.covariances)
    assert np.allclose(ann.largest_std, np.sqrt(eigenvalues[:, -1]))
    assert not ann.means.flags.writeable


def test_predictions_later_are_the_same_ones_moved_on():
    """Row i at time t + dt is row i + 1 at t: nothing was learnt in between."""
    follower = tracker()
    for k in range(5):
        follower.update(0.4 * k, [[0.4 * k, 0.1 * k]], [7])
    now, later = follower.predictions(1.6)[0], follower.predictions(1.8)[0]
    assert np.allclose(later.means[:-1], now.means[1:], atol=1e-12)
    assert np.allclose(later.covariances[:-1], now.covariances[1:], atol=1e-12)


def test_dropouts_cost_certainty_and_tracks_end():
    follower = tracker()
    for k in range(5):
        follower.update(0.2 * k, [[0.2 * k, 0], [0, 5]], ["a", "b"])
    follower.update(1.0, [[1.0, 0]], ["a"])
    a, b = follower.predictions()
    assert b.largest_std[0] > a.largest_std[0]
    follower.update(2.2, [[2.2, 0]], ["a"])
    assert [o.name for o in follower.predictions()] == ["a", "b"]  # 1.4 s without
    assert [o.name for o in follower.predictions(2.4)] == ["a"]
    follower.update(2.4, [], [])
    assert follower.names == ("a",)
    follower.update(2.6, [[0, 5]], ["b"])
    assert follower.predictions()[1].largest_std[-1] > 1.0  # b begins anew: its speed is not known


def test_a_first_sighting_is_told_of_as_wide_as_it_is():
    """Nothing is known of the velocity but how fast people walk."""
    settings = TrackerSettings(motions=(Motion(1e-9),), speed=0.7)
    follower = tracker(settings)
    follower.update(0.0, [[0.9, 0.0]])
    (told,) = follower.predictions()
    np.testing.assert_allclose(told.means, np.tile([0.9, 0.0], (11, 1)), atol=1e-12)
    std = np.sqrt(0.05**2 + (0.7 * 0.2 * np.arange(11)) ** 2)
    np.testing.assert_allclose(told.largest_std, std, rtol=1e-6)
    assert follower.healthy(0.0)


@pytest.mark.parametrize(("dt", "nodes"), [(0.01, 1), (0.1, 4), (1.0, 4)])
def test_a_robot_does_not_run_into_a_first_sighting(dt, nodes):
    """One measurement 0.9 m ahead of a robot at 1 m/s; then the sensor is silent for a second."""
    problem = Problem(
        DoubleIntegrator(dt), horizon=20, Q=[1, 0.1, 1, 0.1], R=[0.1, 0.1], u_min=-2, u_max=2,
        robot_radius=0.3, nodes_per_interval=nodes,
    )  # fmt: skip
    follower, x = Tracker(dt, 20, radius=0.3, measurement_std=0.05), np.array([0.0, 1.0, 0.0, 0.0])
    follower.update(0.0, [[0.9, 0.0]])
    mpc = MPC(problem, Settings(deadline=None))
    for k in range(3):
        plan = mpc.step(x, [9.0, 0, 0, 0], follower.predictions(k * dt), time=k * dt)
        assert not (plan.ok and plan.u0[0] > 1.9)
        assert plan.step.count == 1
        x = problem.model.step(x, plan.u0)


@pytest.mark.parametrize("dt", [0.01, 0.1, 1.0])
def test_a_silent_sensor_is_told_of_and_its_tracks_go_on_growing(dt):
    follower = tracker(dt=dt)
    assert not follower.healthy(0.0)
    for k in range(5):
        follower.update(0.1 * k, [[0.1 * k, 0.0], [3.0, 3.0]][: 2 - k % 2])  # missed at times
    follower.update(0.5, [[0.5, 0.0], [-4.0, 0.0]])  # and one is new
    widths = []
    for silent in (0.0, 0.3, 0.9, 1.0, 1.6, 5.0, 59.0, 1e9):
        told = follower.predictions(0.5 + silent)
        assert len(told) == 3
        assert follower.healthy(0.5 + silent) == (silent <= 1.0)
        widths.append([o.largest_std[0] for o in told])
        assert all(o.stamp == 0.5 + silent for o in told)
    assert (np.diff(widths, axis=0) > 0).all()
    assert np.isfinite(follower.predictions(1e9)[0].covariances).all()
    assert follower.update(7.0, [[7.0, 0.0]]) == (0,)  # it comes back: who is there is known again
    assert follower.names == (0,)
    assert follower.healthy(7.0)


def test_a_robot_does_not_drive_through_who_was_there_when_the_sensor_died():
    """Somebody stands in the way; nothing is heard after 0.8 s, and the robot goes on for 6 s."""
    problem = Problem(
        DoubleIntegrator(0.2), horizon=10, Q=[1, 0.1, 1, 0.1], R=[0.1, 0.1], u_min=-2, u_max=2,
        robot_radius=0.3, speed_max=1.0, nodes_per_interval=1, x_min=[-9, -9, -0.5, -9],
        x_max=[9, 9, 0.5, 9],
    )  # fmt: skip
    follower, mpc = tracker(), MPC(problem, Settings(deadline=None))
    x, gaps = np.zeros(4), []
    for k in range(30):
        if k < 5:
            follower.update(0.2 * k, [[3.0, 0.0]])
        plan = mpc.step(x, [6.0, 0, 0, 0], follower.predictions(0.2 * k), time=0.2 * k)
        assert plan.step.count == 1
        x = problem.model.step(x, plan.u0)
        gaps.append(np.hypot(x[0] - 3.0, x[2]) - 0.6)
    assert min(gaps) > 0
    assert not follower.healthy(6.0)


def test_who_was_missed_long_before_the_silence_ends():
    follower = tracker()
    for k in range(13):
        seen = 2 if k < 2 else 1
        follower.update(0.1 * k, [[0.0, 0.0], [5.0, 0.0]][:seen], ["a", "b"][:seen])
    assert [o.name for o in follower.predictions(1.59)] == ["a", "b"]
    assert [o.name for o in follower.predictions(1.61)] == ["a"]


def test_a_false_alarm_does_not_keep_the_robot_for_long():
    follower = tracker()
    for k in range(4):
        follower.update(0.1 * k, [[0.0, 0.0]])
    follower.update(0.4, [[0.0, 0.0], [2.0, 0.0]])
    for k, told in ((5, 2), (9, 2), (10, 1)):
        follower.update(0.1 * k, [[0.0, 0.0]])
        assert len(follower.predictions()) == told


@pytest.mark.parametrize("jump", [10.0, 1e4, 1e9])
def test_a_clock_that_jumps_ahead_is_survived_and_one_that_goes_back_refused(jump):
    follower = tracker()
    for t in (0.0, 0.2, 0.4):
        follower.update(t, [[t, 0.0], [5.0, t]], ["a", "b"])
    follower.update(jump, [[1.0, 0.0]], ["a"])
    (told,) = follower.predictions()
    np.testing.assert_allclose(told.means[0], [1.0, 0.0], atol=0.01)
    ObstaclePrediction(told.means, told.covariances, told.radius)
    with pytest.raises(StaleDataError, match="is not after"):
        follower.update(0.6, [[0.6, 0.0]], ["a"])
    follower.reset()
    follower.update(0.6, [[0.6, 0.0]], ["a"])


def test_tracks_are_told_of_once_confirmed():
    follower = tracker(TrackerSettings(confirmations=3))
    for k, told in enumerate([0, 0, 1, 1]):
        follower.update(0.1 * k, [[0.0, 0.0]], [0])
        assert len(follower.predictions()) == told


def test_measurements_without_names_are_paired():
    """Two people cross at an angle, in random order, with drop-outs: each keeps its number."""
    rng = np.random.default_rng(3)
    follower = tracker()
    whose = {0: set(), 1: set()}
    for k in range(60):
        t = 0.2 * k
        people = np.array([[1.2 * t - 7, 0.3], [0.5, 1.0 * t - 7.5]])
        seen = [i for i in rng.permutation(2) if k < 2 or rng.uniform() < 0.8]
        z = people[seen] + rng.normal(0, 0.05, (len(seen), 2))
        for i, name in zip(seen, follower.update(t, z), strict=True):
            whose[i].add(name)
    assert sorted(len(names) for names in whose.values()) == [1, 1]
    assert whose[0] != whose[1]


def test_what_is_beyond_the_gate_begins_a_new_track():
    follower = tracker(CONFIRMED)
    for k in range(4):
        assert follower.update(0.2 * k, [[0.0, 0.0]]) == (0,)
    assert follower.update(0.8, [[3.0, 0.0], [0.02, 0.0]]) == (1, 0)
    assert [o.name for o in follower.predictions()] == [0]
    assert follower.update(1.0, [[3.0, 0.0]]) == (1,)
    assert [o.name for o in follower.predictions()] == [0, 1]


def test_a_covariance_for_each_measurement():
    """The standard deviation, squared, is one; a worse measurement counts for less."""
    given, plain = tracker(), tracker()
    for k in range(5):
        z = [[0.1 * k, 0.0], [1.0, 0.1 * k]]
        given.update(0.2 * k, z, ["a", "b"], np.tile(0.05**2 * np.eye(2), (2, 1, 1)))
        plain.update(0.2 * k, z, ["a", "b"])
    assert np.array_equal(given.estimates().means, plain.estimates().means)
    given.update(1.0, [[5.0, 0.0], [6.0, 0.5]], ["a", "b"], [1e4 * np.eye(2), 1e-4 * np.eye(2)])
    assert np.allclose(given.estimates().means[:, 0], [0.5, 6.0], atol=0.15)


def test_names_of_any_kind_and_order():
    follower = tracker()
    follower.update(0.0, [[0, 0], [9, 9]], [("x", 1), 2])
    assert follower.update(0.1, [[9, 9], [4, 4], [0, 0]], [2, "new", ("x", 1)]) == (
        2,
        "new",
        ("x", 1),
    )
    assert np.allclose(follower.estimates().means[:, :2], [[0, 0], [9, 9], [4, 4]], atol=0.1)


def test_in_space():
    follower = tracker(dim=3)
    for k in range(10):
        follower.update(0.2 * k, [[0.2 * k, 0, -0.1 * k]], ["drone"])
    (drone,) = follower.predictions()
    assert drone.means.shape == (11, 3)
    assert np.allclose(drone.means[-1], [1.8 + 2.0, 0, -0.9 - 1.0], atol=0.05)


def test_reset_forgets_everything():
    follower, new = tracker(), tracker()
    follower.update(5.0, [[1, 1]], ["a"])
    follower.reset()
    assert follower.predictions() == []
    for t in (0.0, 0.3):
        assert follower.update(t, [[1 + t, 1]]) == new.update(t, [[1 + t, 1]])
    assert state(follower) == state(new)


def test_nobody_at_all():
    follower = tracker()
    assert follower.predictions(3.0) == []
    assert follower.update(0.0, []) == ()
    assert follower.update(1.0, np.zeros((0, 2))) == ()
    assert follower.predictions() == []


def test_spread_widens_and_moves_nothing():
    plain, wide = tracker(), tracker(TrackerSettings(std_inflation=1.5))
    for k in range(3):
        for follower in (plain, wide):
            follower.update(0.2 * k, [[0.2 * k, 0]], [0])
    assert np.allclose(wide.predictions()[0].largest_std, 1.5 * plain.predictions()[0].largest_std)
    assert np.array_equal(wide.predictions()[0].means, plain.predictions()[0].means)


BAD = [
    ((0.4, [[0, 0]], ["a"]), StaleDataError, "time"),
    ((0.3, [[0, 0]], ["a"]), StaleDataError, "time"),
    ((float("nan"), [[0, 0]], ["a"]), NotFiniteError, "time"),
    ((1.0, [[0, float("nan")]], ["a"]), NotFiniteError, "positions"),
    ((1.0, [[0, 0, 0]], ["a"]), ShapeError, "positions"),
    ((1.0, [0, 0], ["a"]), ShapeError, "positions"),
    ((1.0, [["x", 0]], ["a"]), InvalidArgumentError, "positions"),
    ((1.0, [[0, 0], [1, 1]], ["a", "a"]), InvalidArgumentError, "names[1]"),
    ((1.0, [[0, 0]], [[]]), InvalidArgumentError, "names[0]"),
    ((1.0, [[0, 0]], [None]), InvalidArgumentError, "names[0]"),
    ((1.0, [[0, 0]], ["a", "b"]), ShapeError, "names"),
    ((1.0, [[0, 0]], "a"), InvalidArgumentError, "names"),
    ((1.0, [[0, 0]], 3), InvalidArgumentError, "names"),
    ((1.0, [[0, 0]]), InvalidArgumentError, "names"),
    ((1.0, [[0, 0]], ["a"], [[1, 2], [2, 1]]), CovarianceError, "covariances"),
    ((1.0, [[0, 0]], ["a"], [[1, 0], [0, 0]]), CovarianceError, "covariances"),
    ((1.0, [[0, 0]], ["a"], np.zeros((2, 2, 2))), ShapeError, "covariances"),
]


@pytest.mark.parametrize(("arguments", "error", "argument"), BAD)
def test_bad_measurements_are_refused_and_leave_no_trace(arguments, error, argument):
    follower = tracker()
    follower.update(0.0, [[0, 0]], ["a"])
    follower.update(0.4, [[0.1, 0], [5, 5]], ["a", "b"])
    before = state(follower)
    with pytest.raises(error) as raised:
        follower.update(*arguments)
    assert raised.value.argument == argument
    assert state(follower) == before
    assert follower.update(0.8, [[0.2, 0]], ["a"]) == ("a",)


def test_predictions_of_the_past_are_refused():
    follower = tracker()
    follower.update(1.0, [[0, 0]])
    with pytest.raises(StaleDataError, match=r"0\.5 s is before"):
        follower.predictions(0.5)
    with pytest.raises(InvalidArgumentError, match="came without names, now with"):
        follower.update(2.0, [[0, 0]], ["a"])


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"dt": 0.0}, BoundsError),
        ({"horizon": 0}, BoundsError),
        ({"horizon": 2.5}, InvalidArgumentError),
        ({"radius": -0.1}, BoundsError),
        ({"measurement_std": 0.0}, BoundsError),
        ({"dim": 4}, InvalidArgumentError),
        ({"settings": Settings()}, InvalidArgumentError),
        ({"dim": 3, "settings": TrackerSettings(motions=WALKING_AND_TURNING)}, BoundsError),
    ],
)
def test_bad_trackers_are_refused(changes, error):
    with pytest.raises(error):
        tracker(**changes)


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"motions": ()}, InvalidArgumentError),
        ({"motions": [Motion(0.1)]}, InvalidArgumentError),
        ({"motions": (0.1,)}, InvalidArgumentError),
        ({"dwell_time": 0.0}, BoundsError),
        ({"speed": -1.0}, BoundsError),
        ({"confirmations": 0}, BoundsError),
        ({"keep": -1.0}, BoundsError),
        ({"room": -0.1}, BoundsError),
        ({"keep_new": -1.0}, BoundsError),
        ({"silence": 0.0}, BoundsError),
        ({"gate": 1.0}, BoundsError),
        ({"std_inflation": float("nan")}, NotFiniteError),
    ],
)
def test_bad_settings_are_refused(changes, error):
    with pytest.raises(error):
        TrackerSettings(**changes)


def test_the_controller_takes_the_predictions():
    problem = Problem(
        DoubleIntegrator(0.2), horizon=10, Q=[1, 0.1, 1, 0.1], R=[0.1, 0.1], u_min=-3, u_max=3,
        robot_radius=0.3, max_obstacles=3, nodes_per_interval=1,
    )  # fmt: skip
    mpc = MPC(problem, Settings(staleness=StalenessPolicy(stamps="required", keep=0)))
    follower = tracker()
    for k in range(4):
        follower.update(0.4 * k, [[5.0 - 0.4 * k, 0.1]], ["a"])
        told = follower.predictions(0.4 * k + 0.1)
        assert mpc.step(np.zeros(4), [4, 0, 0, 0], told, time=0.4 * k + 0.1).ok
    assert np.abs(mpc.obstacles[0].means[0] - [3.7, 0.1]).max() < 0.1
