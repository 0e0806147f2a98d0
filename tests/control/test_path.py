"""Paths: arc length, continuity, projections against brute force, misuse."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from scp_mpc import BoundsError, InvalidArgumentError, NotFiniteError, ShapeError
from scp_mpc.control import Path

KINDS = ["circle", "clockwise", "polyline", "closed polyline", "spline", "closed spline"]
EIGHT = Path.spline([[0, 0], [3, 2], [6, 0], [3, -2], [0, 0.1], [-3, 2], [-6, 0], [-3, -2]], True)

paths = st.builds(
    lambda kind, dim, seed: drawn(kind, dim, np.random.default_rng(seed)),
    st.sampled_from(KINDS),
    st.sampled_from([2, 3]),
    st.integers(0, 2**32 - 1),
)


def waypoints(dim, rng):
    """Points that go round and up and down, a few metres apart."""
    count = int(rng.integers(4, 9))
    angle = 2 * np.pi * (np.arange(count) + rng.uniform(-0.2, 0.2, count)) / count
    points = rng.uniform(3, 8, (count, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.hstack([points, rng.uniform(-2, 2, (count, dim - 2))])


def drawn(kind, dim, rng):
    if kind in ("circle", "clockwise"):
        centre = rng.uniform(-2, 2, dim)
        return Path.circle(rng.uniform(0.5, 9), centre, rng.uniform(-4, 4), kind == "clockwise")
    make = Path.spline if "spline" in kind else Path.polyline
    return make(waypoints(dim, rng), closed="closed" in kind)


@settings(max_examples=40, deadline=None)
@given(paths)
def test_progress_is_arc_length(path):
    s = np.linspace(0, path.length, 4001)
    t = path.tangents(s)
    assume(path.curvatures(s).max() < 20)  # not nearly a cusp
    np.testing.assert_allclose(np.linalg.norm(t, axis=1), 1, atol=3e-8)
    way = np.linalg.norm(np.diff(path.positions(s), axis=0), axis=1)
    assert way.max() <= np.diff(s).max() * (1 + 3e-8)
    assert way.sum() == pytest.approx(path.length, rel=1e-2)
    h = 1e-4
    inner = s[1:-1][np.abs(s[1:-1, None] - path.knots).min(axis=1) > 2 * h]
    slope = (path.positions(inner + h) - path.positions(inner - h)) / (2 * h)
    np.testing.assert_allclose(slope, path.tangents(inner), atol=1e-5)
    bend = np.linalg.norm(path.tangents(inner + h) - path.tangents(inner - h), axis=1) / (2 * h)
    np.testing.assert_allclose(bend, path.curvatures(inner), atol=1e-4 * (1 + bend.max() ** 3))


@settings(max_examples=30, deadline=None)
@given(st.booleans(), st.sampled_from([2, 3]), st.integers(0, 2**32 - 1))
def test_curves_go_through_their_points_and_splines_are_smooth(closed, dim, seed):
    points = waypoints(dim, np.random.default_rng(seed))
    for make in (Path.polyline, Path.spline):
        path = make(points, closed)
        for point in points:
            at = path.positions(path.project(point))
            np.testing.assert_allclose(at, point, atol=1e-9)
        ends = path.positions([0.0, path.length])
        np.testing.assert_allclose(ends, points[[0, 0 if closed else -1]], atol=1e-9)
    knots = path.knots if closed else path.knots[1:-1]
    before, after = (path.derivatives(knots + side) for side in (-1e-9, 1e-9))
    np.testing.assert_allclose(before, after, atol=1e-6 * (1 + np.abs(after[2]).max() ** 2))


def test_a_circle_is_a_circle():
    path = Path.circle(2.0, centre=(1.0, -1.0, 5.0), start=np.pi / 2, clockwise=True)
    assert path.length == pytest.approx(4 * np.pi, rel=1e-14)
    s = np.linspace(-3, 20, 500)
    p = path.positions(s)
    np.testing.assert_allclose(np.linalg.norm(p - [1, -1, 5], axis=1), 2, atol=1e-9)
    angle = np.pi / 2 - s / 2
    np.testing.assert_allclose(p[:, 0], 1 + 2 * np.cos(angle), atol=1e-9)
    np.testing.assert_allclose(p[:, 1], -1 + 2 * np.sin(angle), atol=1e-9)
    np.testing.assert_allclose(path.curvatures(s), 0.5, atol=1e-6)


@settings(max_examples=60, deadline=None)
@given(paths, st.integers(0, 2**32 - 1))
def test_projection_is_as_near_as_brute_force(path, seed):
    rng = np.random.default_rng(seed)
    grid = np.linspace(0, path.length, 5001)
    p = path.positions(grid)
    for x in rng.uniform(-9, 9, (6, path.dim)):
        s = path.project(x)
        assert 0 <= s <= path.length
        gap, nearest = np.linalg.norm(path.positions(s) - x), np.linalg.norm(p - x, axis=1).min()
        assert nearest - (grid[1] / 2) <= gap <= nearest + 1e-9


@settings(max_examples=60, deadline=None)
@given(paths, st.integers(0, 2**32 - 1))
def test_projection_within_a_window(path, seed):
    """The window may begin anywhere, on any lap, and be longer than one."""
    rng = np.random.default_rng(seed)
    low = rng.uniform(-0.5, 2.5) * path.length
    high = low + rng.choice([0.0, 0.01, 0.3, 1.2]) * path.length
    grid = np.linspace(low, high, 5001)
    if not path.closed:
        grid = np.clip(grid, 0, path.length)
    p = path.positions(grid)
    for x in rng.uniform(-9, 9, (6, path.dim)):
        s = path.project(x, (low, high))
        assert grid[0] <= s <= grid[-1]
        gap, nearest = np.linalg.norm(path.positions(s) - x), np.linalg.norm(p - x, axis=1).min()
        assert gap <= nearest + 1e-9


@settings(max_examples=30, deadline=None)
@given(paths, st.floats(0, 1))
def test_a_point_on_the_path_is_its_own_projection(path, share):
    s = share * path.length
    found = path.project(path.positions(s), (s - 0.2, s + 0.2))
    assert found == pytest.approx(s, abs=1e-7)


def test_windows_tell_branches_of_a_crossing_apart():
    middle = np.array([0.0, 0.05])
    first, second = EIGHT.project(middle, (-1, 1)), EIGHT.project(middle, (11, 20))
    assert abs(first - second) > 5
    np.testing.assert_allclose(EIGHT.positions([first, second]), [middle] * 2, atol=0.1)


def test_corners():
    square = Path.polyline([[0, 0], [2, 0], [2, 2], [0, 2]], closed=True)
    np.testing.assert_allclose(square.corners(), np.pi / 2)
    np.testing.assert_array_equal(square.tangents([1.9, 2.0, 8.0]), [[1, 0], [0, 1], [1, 0]])
    np.testing.assert_allclose(Path.polyline([[0, 0], [1, 0], [0, 0]]).corners(), [0, np.pi, 0])
    assert EIGHT.corners().max() < 1e-6


WAY = np.array([[0, 0], [2, 0.5], [4, 1.5], [6, 1], [8, 0], [10, 0.5], [12, 2], [14, 2.0]])


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("back", [1e-12, 1e-6, 1e-4, 1e-3, 0.01, 0.1, 0.5])
@pytest.mark.parametrize("at", [0, 3, 7])
def test_a_step_back_is_refused_and_named(at, back, scale):
    """Of any length below the steps around it, wherever it is on the way."""
    way = WAY[at] - WAY[at - 1] if at else WAY[1] - WAY[0]
    extra = WAY[at] - back * way / np.linalg.norm(way)
    points = scale * np.insert(WAY, at + 1, extra, axis=0)
    with pytest.raises(InvalidArgumentError, match=rf"points: {at} and {at + 1} are") as error:
        Path.spline(points)
    step = float(str(error.value).split(" m")[0].split()[-1])
    assert step == pytest.approx(scale * back, rel=0.01) or back < 1e-9
    if back <= 1e-4:
        with pytest.raises(InvalidArgumentError, match="are the same"):
            Path.polyline(points)
    Path.spline(scale * WAY)


@pytest.mark.parametrize("back", [1e-6, 1e-3, 0.1, 0.6])
def test_a_step_back_on_a_closed_way_is_refused(back):
    square = np.array([[0.0, 0.0], [2, 0], [2, 2], [0, 2]])
    for at, extra in ((1, [2 - back, 0.0]), (3, [back, 2.0])):
        with pytest.raises(InvalidArgumentError, match=rf"points: {at} and {at + 1} are"):
            Path.spline(np.insert(square, at + 1, extra, axis=0), closed=True)
    with pytest.raises(InvalidArgumentError, match="points: 4 and 0 are"):
        Path.spline(np.append(square, [[0.0, -back]], axis=0), closed=True)


def test_turns_back_as_long_as_the_way_are_no_mistake():
    Path.spline([[0, 0], [3, 0], [1, 1], [4, 1]])
    Path.spline([[0, 0], [2, 0], [2, 0.2], [0, 0.2]])  # a hairpin
    Path.spline([[0, 0], [2, 0], [1.9, 0.2], [0, 0.3]])
    Path.polyline([[0, 0], [3, 0], [2.5, 0], [4, 0]])  # as told, corner by corner


LINE = [[0, 0], [1, 0], [2, 1]]
BAD = {
    "one point": (lambda: Path.polyline([[0, 0]]), ShapeError, "points: 1 are too few"),
    "two, closed": (lambda: Path.spline(LINE[:2], True), ShapeError, "points: 2 are too few"),
    "repeated": (
        lambda: Path.spline([*LINE, [2, 1], [3, 3]]),
        InvalidArgumentError,
        "points: 2 and 3 are the same",
    ),
    "closed twice": (
        lambda: Path.polyline([*LINE, [0, 0]], True),
        InvalidArgumentError,
        "points: 3 and 0 are the same",
    ),
    "NaN": (
        lambda: Path.polyline([[0, 0], [1, np.nan]]),
        NotFiniteError,
        r"points: nan at index \(1, 1\)",
    ),
    "4-D": (lambda: Path.spline(np.eye(4)), ShapeError, r"points: shape \(4, 4\)"),
    "no array": (lambda: Path.spline("abc"), InvalidArgumentError, "points"),
    "there and back": (
        lambda: Path.spline([[0, 0], [1, 0], [0, 0]]),
        InvalidArgumentError,
        "points: the spline turns on the spot between points (0 and 1|1 and 2)$",
    ),
    "radius": (lambda: Path.circle(-1.0), BoundsError, "radius: -1.0 is not positive"),
    "centre": (lambda: Path.circle(1.0, [0.0]), ShapeError, "centre"),
    "point": (lambda: EIGHT.project([0, 0, 0]), ShapeError, "point"),
    "NaN point": (lambda: EIGHT.project([0, np.nan]), NotFiniteError, "point: nan at index"),
}


@pytest.mark.parametrize(("make", "error", "message"), BAD.values(), ids=BAD)
def test_misuse(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_points_are_not_written_to_nor_followed():
    points = np.array(LINE, dtype=float)
    path = Path.polyline(points)
    before = path.positions([0.5, 1.5])
    points[:] = 7.0
    np.testing.assert_array_equal(path.positions([0.5, 1.5]), before)
