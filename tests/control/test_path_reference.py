"""References from a path: speed limits, progress, and a robot that follows in closed loop."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import problem
from test_path import EIGHT, LINE, drawn, paths

from scp_mpc import (
    MPC,
    BoundsError,
    DoubleIntegrator,
    InvalidArgumentError,
    NotFiniteError,
    ObstaclePrediction,
    ShapeError,
)
from scp_mpc.control import Path, PathReference, Schedule, SpeedLimits

DT, N = 0.2, 10
PLANE = DoubleIntegrator(DT)
LIMITS = SpeedLimits(top=3.0, lateral=2.0, longitudinal=1.5)
limits = st.builds(
    SpeedLimits,
    top=st.floats(0.5, 6),
    lateral=st.none() | st.floats(0.3, 5),
    longitudinal=st.none() | st.floats(0.3, 5),
    stop=st.booleans(),
)


class Nosed:
    """A robot with a nose: x = [p1, p2, theta, v]."""

    nx, dim, dt, heading, position = 4, 2, DT, 2, np.array([0, 1])

    def state(self, position, velocity):
        angle = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
        return np.column_stack([position, angle, np.linalg.norm(velocity, axis=1)])


@settings(max_examples=60, deadline=None)
@given(paths, limits)
def test_limits_are_kept(path, limit):
    schedule = Schedule(path, limit, DT)
    s = np.linspace(0, path.length, 3001)
    v = schedule.speeds(s)
    assert v.max() <= limit.top * (1 + 1e-12)
    if limit.lateral is not None:
        assert (v**2 * path.curvatures(s)).max() <= limit.lateral * 1.01
        jump = 2 * np.sin(path.corners() / 2) * schedule.speeds(path.knots)
        assert jump.max() <= limit.lateral * DT * (1 + 1e-9)
    if limit.longitudinal is not None:
        assert np.abs(schedule.a).max() <= limit.longitudinal * (1 + 1e-9)
        if limit.stop and not path.closed:
            assert schedule.v[-1] == 0
    if path.closed:
        assert schedule.v[0] == pytest.approx(schedule.v[-1], abs=1e-9)


@settings(max_examples=60, deadline=None)
@given(paths, limits, st.floats(0, 3))
def test_advancing_is_integrating_the_speed(path, limit, laps):
    """Against small steps of the midpoint rule."""
    schedule = Schedule(path, limit, DT)
    s0 = laps * path.length if path.closed else min(laps, 1) * path.length
    times = np.linspace(0, 4, 41)
    s, v = schedule.advance(s0, times)
    assert s[0] == pytest.approx(s0, abs=1e-9)
    assert (np.diff(s) >= -1e-12).all()
    on = s < path.length if not path.closed else np.full(len(s), True)
    np.testing.assert_allclose(v[on], schedule.speeds(s[on]), atol=1e-6)
    fine = np.linspace(0, 4, 4001)
    many, speed = schedule.advance(s0, fine)
    way = np.concatenate([[0], np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(fine))])
    np.testing.assert_allclose(many, s0 + way, atol=0.02)
    if not path.closed:
        assert s.max() <= path.length
        assert (v[~on] == 0).all()


def test_the_profile_is_the_fastest():
    """On a straight line: speed up as long as braking allows; slower anywhere would be allowed."""
    schedule = Schedule(Path.polyline([[0, 0], [40, 0]]), LIMITS, DT)
    s = np.linspace(0, 40, 500)
    wanted = np.minimum(3.0, np.sqrt(2 * 1.5 * (40 - s)))
    np.testing.assert_allclose(schedule.speeds(s), wanted, atol=0.02)
    corner = Schedule(Path.polyline([[0, 0], [10, 0], [10, 10]]), LIMITS, DT)
    slowest = 2.0 * DT / np.sqrt(2)
    assert corner.speeds(np.array([10.0]))[0] == pytest.approx(slowest)
    before = corner.speeds(np.array([8.0, 12.0]))
    np.testing.assert_allclose(before, np.sqrt(slowest**2 + 2 * 1.5 * 2), rtol=0.01)


@settings(max_examples=40, deadline=None)
@given(paths, limits, st.floats(0, 0.9))
def test_from_a_robot_on_the_path_the_reference_is_the_path(path, limit, share):
    model = DoubleIntegrator(DT, path.dim)
    reference = PathReference(path, speed=limit, model=model, horizon=N)
    s0 = share * path.length
    x = model.state(path.positions(s0), np.zeros(path.dim))
    x_ref = reference.states(x)
    assert x_ref.shape == (N + 1, model.nx)
    np.testing.assert_allclose(path.positions(reference.progress), path.positions(s0), atol=1e-6)
    s, v = reference.schedule.advance(reference.progress, DT * np.arange(N + 1))
    np.testing.assert_allclose(x_ref[:, model.position], path.positions(s), atol=1e-9)
    np.testing.assert_allclose(x_ref[:, 1::2], v[:, None] * path.tangents(s), atol=1e-9)


@settings(max_examples=40, deadline=None)
@given(paths, st.integers(0, 2**32 - 1))
def test_progress_is_monotone_whatever_the_robot_does(path, seed):
    rng = np.random.default_rng(seed)
    model = DoubleIntegrator(DT, path.dim)
    reference = PathReference(path, speed=2.0, model=model, horizon=N)
    s, before = 0.0, -np.inf
    for _ in range(40):
        s += rng.uniform(-0.5, 1.0)
        x = model.state(path.positions(s) + rng.normal(0, 0.5, path.dim), np.zeros(path.dim))
        reference.states(x)
        assert before <= reference.progress <= max(before, 0) + max(1.6, path.length)
        before = reference.progress


def test_progress_may_retreat_where_it_is_told_to():
    path = Path.polyline([[0, 0], [9, 0]])
    at = [PLANE.state(np.array([p, 0.0]), np.zeros(2)) for p in (5.0, 4.0)]
    for retreat, end in ((0.0, 5.0), (0.3, 4.7), (2.0, 4.0)):
        reference = PathReference(path, speed=2.0, model=PLANE, horizon=N, retreat=retreat)
        for x in at:
            reference.states(x)
        assert reference.progress == pytest.approx(end)


def test_a_crossing_does_not_make_progress_jump():
    reference = PathReference(EIGHT, speed=2.0, model=PLANE, horizon=N)
    s = np.arange(0.5, 2.6 * EIGHT.length, 0.35)
    for at in s:
        reference.states(PLANE.state(EIGHT.positions(at) + [0.05, -0.05], np.zeros(2)))
        assert reference.progress == pytest.approx(at, abs=0.3)
    assert not reference.finished
    reference.reset()
    assert reference.progress == 0.0
    reference.states(PLANE.state(EIGHT.positions(20.0), np.zeros(2)))
    assert reference.progress == pytest.approx(20.0, abs=1e-6)


@pytest.mark.parametrize("turns", [-7, -1, 0, 1, 4])
def test_headings_are_those_nearest_to_the_robots(turns):
    path = Path.circle(2.0)
    reference = PathReference(path, speed=3.0, model=Nosed(), horizon=40)
    own = np.pi / 2 + 0.4 + 2 * np.pi * turns
    x_ref = reference.states([2.0, 0.0, own, 1.0])
    assert abs(x_ref[0, 2] - own) == pytest.approx(0.4)
    np.testing.assert_allclose(np.diff(x_ref[:, 2]), 3.0 * DT / 2.0, atol=1e-6)


def test_a_nose_points_along_the_path_even_at_its_end():
    reference = PathReference(Path.polyline([[0, 0], [0, 2]]), speed=1.0, model=Nosed(), horizon=5)
    x_ref = reference.states([0.0, 2.0, 1.5, 0.0])
    np.testing.assert_allclose(x_ref, np.tile([0, 2, np.pi / 2, 0], (6, 1)), atol=1e-8)
    assert reference.finished


def test_the_robot_follows_a_path_round_obstacles_and_stops():
    """In closed loop: on the path where it is free, round what stands on it, to its end."""
    path = Path.spline([[0, 0], [4, 1.5], [8, -1.5], [12, 0], [14, 3]])
    horizon = 15
    task = problem(horizon, max_obstacles=2, u_min=-3.0, u_max=3.0, nodes_per_interval=4)
    reference = PathReference(path, speed=LIMITS, model=task.model, horizon=horizon)
    places = path.positions([5.0, 11.0]) + [[0.1, 0.2], [-0.1, 0.15]]
    obstacles = [
        ObstaclePrediction(np.tile(p, (horizon + 1, 1)), 0.01 * np.eye(2), 0.3) for p in places
    ]
    mpc, x, way, steps = MPC(task), np.zeros(4), [], 0
    while not reference.finished:
        steps += 1
        assert steps < 100
        plan = mpc.step(x, reference.states(x), obstacles)
        assert plan.ok
        x = task.model.step(x, plan.u0)
        way.append(x[[0, 2]])
    gaps = np.linalg.norm(np.array(way)[:, None] - places, axis=2)
    assert gaps.min() >= 0.45
    off = np.array([np.linalg.norm(path.positions(path.project(p)) - p) for p in way])
    assert off[gaps.min(axis=1) > 2.5].max() < 0.25
    assert off.max() < 1.0
    for _ in range(20):
        x = task.model.step(x, mpc.step(x, reference.states(x), obstacles).u0)
    np.testing.assert_allclose(x, [14, 0, 3, 0], atol=1e-2)


def made(**changes):
    values = {"path": EIGHT, "speed": 1.0, "model": PLANE, "horizon": 5, **changes}
    return PathReference(values.pop("path"), **values)


BAD = {
    "no path": ({"path": LINE}, InvalidArgumentError, "path: .* is not a Path"),
    "3-D path": ({"path": Path.circle(1.0, [0, 0, 0])}, ShapeError, "path: is in 3-D, the robot"),
    "standing": ({"speed": 0.0}, BoundsError, "speed: 0.0 is not positive"),
    "NaN speed": ({"speed": np.nan}, NotFiniteError, "speed"),
    "horizon": ({"horizon": 0}, BoundsError, "horizon: 0 is less than 1"),
    "model": ({"model": 3}, InvalidArgumentError, r"model: 3 has no state\("),
    "reach": ({"reach": 0.0}, BoundsError, "reach: 0.0 is not positive"),
    "retreat": ({"retreat": -1.0}, BoundsError, "retreat: -1.0 m is negative"),
    "tolerance": ({"tolerance": -1.0}, BoundsError, "tolerance: -1.0 is not positive"),
}


@pytest.mark.parametrize(("changes", "error", "message"), BAD.values(), ids=BAD)
def test_misuse(changes, error, message):
    made()
    with pytest.raises(error, match=message):
        made(**changes)


@pytest.mark.parametrize("name", ["top", "lateral", "longitudinal"])
def test_limits_are_positive(name):
    with pytest.raises(BoundsError, match=rf"speed.{name}: -1 is not positive"):
        SpeedLimits(**{"top": 1.0, name: -1})


def test_bad_states_leave_no_trace():
    reference = made()
    reference.states([3.0, 0.0, 2.0, 0.0])
    before = reference.progress
    with pytest.raises(NotFiniteError, match="x0: nan at index"):
        reference.states([np.nan, 0.0, 2.0, 0.0])
    with pytest.raises(ShapeError, match="x0"):
        reference.states([0.0, 1.0])
    assert reference.progress == before
    assert drawn("circle", 2, np.random.default_rng(0)).closed
