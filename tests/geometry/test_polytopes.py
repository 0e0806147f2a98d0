"""The signed distance to polytopes against brute force, and its theory; what makes no polytope."""

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial import ConvexHull

from scp_mpc.errors import BoundsError, GeometryError, NotFiniteError, ShapeError
from scp_mpc.geometry.polytopes import Polytopes
from scp_mpc.obstacles import Polytope

seeds = st.integers(0, 2**32 - 1)
some = settings(max_examples=30)
dims = pytest.mark.parametrize("dim", [2, 3])
CUBE = Polytope.box([2.0, 2.0, 2.0])


def random_polytope(rng, dim, points=9):
    """The hull of random points, not around the origin."""
    cloud = rng.normal(size=(points, dim)) * rng.uniform(0.1, 2.0, dim) + rng.normal(size=dim)
    return Polytope(cloud[ConvexHull(cloud).vertices])


def stacked(*shapes):
    return Polytopes.of([shape.static(1) for shape in shapes])


def nearest(shape, y):
    """Distances (K,), normals and curvature of points (K, d) for one polytope."""
    return [part[0] for part in stacked(shape).nearest(np.array(y, dtype=float)[None])]


def slow(shape, y):
    """Inside by the faces of scipy's own hull, outside by a program for the nearest point."""
    hull = ConvexHull(shape.vertices)
    inside = (hull.equations[:, :-1] @ y + hull.equations[:, -1]).max()
    if inside <= 0:
        return inside
    found = minimize(
        lambda q: ((q - y) ** 2).sum(),
        shape.vertices.mean(axis=0),
        jac=lambda q: 2 * (q - y),
        constraints={
            "type": "ineq",
            "fun": lambda q: -(hull.equations[:, :-1] @ q + hull.equations[:, -1]),
            "jac": lambda _: -hull.equations[:, :-1],
        },
        method="SLSQP",
        options={"ftol": 1e-15, "maxiter": 300},
    )
    return np.linalg.norm(found.x - y)


@dims
@settings(max_examples=20)
@given(seed=seeds)
def test_agrees_with_a_program_for_the_nearest_point(dim, seed):
    rng = np.random.default_rng(seed)
    shape = random_polytope(rng, dim)
    y = shape.vertices.mean(axis=0) + 2 * rng.normal(size=(4, dim))
    sd, n, _ = nearest(shape, y)
    np.testing.assert_allclose(sd, [slow(shape, one) for one in y], atol=2e-6)
    np.testing.assert_allclose(np.linalg.norm(n, axis=1), 1.0, atol=1e-12)
    support = (n @ shape.vertices.T).max(axis=1)
    np.testing.assert_allclose((n * y).sum(axis=1) - support, sd, atol=1e-12)


@dims
@some
@given(seed=seeds)
def test_no_direction_exceeds_it(dim, seed):
    """Also near corners and edges, where the nearest feature changes."""
    rng = np.random.default_rng(seed)
    shape = random_polytope(rng, dim)
    weights = rng.dirichlet(np.full(len(shape.vertices), 0.1), 20)
    y = weights @ shape.vertices + 10.0 ** rng.uniform(-12, 0, (20, 1)) * rng.normal(size=(20, dim))
    sd, normal, _ = nearest(shape, y)
    n = rng.normal(size=(300, dim))
    n = np.concatenate([n / np.linalg.norm(n, axis=1, keepdims=True), shape.normals, normal])
    gaps = y @ n.T - (n @ shape.vertices.T).max(axis=1)
    assert (gaps.max(axis=1) <= sd + 1e-12).all()


@dims
@some
@given(seed=seeds)
def test_it_is_convex_and_its_gradient_is_the_unit_normal(dim, seed):
    rng = np.random.default_rng(seed)
    shape = random_polytope(rng, dim)
    p, q = shape.vertices.mean(axis=0) + 2 * rng.normal(size=(2, 30, dim))
    (at_p, n, _), (at_q, _, _) = nearest(shape, p), nearest(shape, q)
    middle = nearest(shape, (p + q) / 2)[0]
    assert (middle <= (at_p + at_q) / 2 + 1e-12).all()
    assert (at_q >= at_p + (n * (q - p)).sum(axis=1) - 1e-12).all()  # the tangent is below
    h = 1e-7
    slope = [
        (nearest(shape, p + h * e)[0] - nearest(shape, p - h * e)[0]) / (2 * h) for e in np.eye(dim)
    ]
    outside = at_p > 1e-3  # inside there are kinks
    np.testing.assert_allclose(np.transpose(slope)[outside], n[outside], atol=1e-3)


@dims
@some
@given(seed=seeds)
def test_the_curvature_is_the_derivative_of_the_normal(dim, seed):
    rng = np.random.default_rng(seed)
    shape = random_polytope(rng, dim)
    y = shape.vertices.mean(axis=0) + 3 * rng.normal(size=(20, dim))
    sd, _, L = nearest(shape, y)
    assert L.shape == (20, dim, dim - 1)
    H = L @ np.swapaxes(L, 1, 2)
    h = 1e-6
    for k, e in enumerate(np.eye(dim)):
        ahead, back = (nearest(shape, y + sign * h * e) for sign in (1, -1))
        turned = (ahead[1] - back[1]) / (2 * h)
        # Where the nearest feature changes within the difference, there is no second derivative.
        same = np.abs(ahead[2] @ np.swapaxes(ahead[2], 1, 2) - H).max(axis=(1, 2)) < 1e-3
        same &= np.abs(back[2] @ np.swapaxes(back[2], 1, 2) - H).max(axis=(1, 2)) < 1e-3
        smooth = same & (sd > 0.05)
        np.testing.assert_allclose(H[smooth][:, :, k], turned[smooth], atol=1e-4)


@pytest.mark.parametrize(
    ("y", "distance", "normal", "curvature"),
    [
        ((3.0, 0.2, 0.5), 2.0, (1, 0, 0), (0, 0, 0)),  # over a face: flat
        ((2.0, 2.0, 0.3), 2**0.5, (0.5**0.5, 0.5**0.5, 0), (0, 0, 2**-0.5)),  # beside an edge
        ((-2, -2, -2), 3**0.5, (-(3**-0.5),) * 3, (0, 3**-0.5, 3**-0.5)),  # before a corner
        ((0.5, 0.0, 0.1), -0.5, (1, 0, 0), (0, 0, 0)),
        ((0.1, -0.9, 0.2), -0.1, (0, -1, 0), (0, 0, 0)),
        ((1.0, 0.3, 0.2), 0.0, (1, 0, 0), (0, 0, 0)),  # on a face
    ],
)
def test_a_cube_where_the_answer_is_plain(y, distance, normal, curvature):
    sd, n, L = nearest(CUBE, [y])
    assert sd[0] == pytest.approx(distance, abs=1e-14)
    np.testing.assert_allclose(n[0], normal, atol=1e-14)
    np.testing.assert_allclose(np.linalg.eigvalsh(L[0] @ L[0].T), curvature, atol=1e-12)


def test_a_polygon_with_many_corners_is_almost_a_disc():
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    disc = Polytope(3 * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    y = np.random.default_rng(0).normal(size=(50, 2)) * 4
    sd, n, _ = nearest(disc, y)
    np.testing.assert_allclose(sd, np.linalg.norm(y, axis=1) - 3, atol=1e-3)
    out = sd > 0.1
    np.testing.assert_allclose(n[out], y[out] / np.linalg.norm(y[out], axis=1)[:, None], atol=0.02)


@dims
def test_padding_changes_nothing(dim):
    rng = np.random.default_rng(1)
    shapes = [random_polytope(rng, dim, points) for points in (5, 9, 30)]
    y = 2 * rng.normal(size=(4, 50, dim))
    together = stacked(shapes[2], shapes[0], shapes[1], shapes[0]).nearest(y)
    for j, k in enumerate((2, 0, 1, 0)):
        for part, alone in zip(together, nearest(shapes[k], y[j]), strict=True):
            np.testing.assert_array_equal(part[j], alone)


def test_between_two_faces_the_side_decides():
    box, middle = stacked(Polytope.box([4.0, 1.0])), np.zeros((1, 1, 2))
    for side in ([0.3, 1.0], [0.3, -1.0]):
        n = box.nearest(middle, lambda side=side: np.array([[side]])).normal
        np.testing.assert_array_equal(n[0, 0], [0, np.sign(side[1])])
    shifted = middle + [0.0, 0.1]
    assert box.nearest(shifted, lambda: np.array([[[0.0, -1.0]]])).normal[0, 0, 1] == 1


@dims
@settings(max_examples=12)
@given(seed=seeds)
def test_half_spaces_make_the_polytope_they_bound(dim, seed):
    rng = np.random.default_rng(seed)
    shape = random_polytope(rng, dim, 7)
    length = rng.uniform(0.1, 10.0, len(shape.normals))
    far = shape.normals[:1], shape.offsets[:1] + 5.0  # says nothing new
    again = Polytope.from_half_spaces(
        np.concatenate([length[:, None] * shape.normals, far[0]]),
        np.concatenate([length * shape.offsets, far[1]]),
    )
    assert len(again.vertices) == len(shape.vertices)
    gaps = np.linalg.norm(again.vertices[:, None] - shape.vertices, axis=2)
    assert gaps.min(axis=1).max() < 1e-6
    y = 2 * rng.normal(size=(10, dim))
    np.testing.assert_allclose(nearest(again, y)[0], nearest(shape, y)[0], atol=1e-6)


def test_boxes_turn_and_move():
    box = Polytope.box([2.0, 1.0], angle=np.pi / 2, centre=[1.0, 0.0])
    np.testing.assert_allclose(np.abs(box.vertices - [1.0, 0.0]), [[0.5, 1.0]] * 4, atol=1e-12)
    turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    brick = Polytope.box([1.0, 2.0, 3.0], rotation=turn)
    np.testing.assert_allclose(np.abs(brick.vertices), [[1.5, 0.5, 1.0]] * 8)
    assert (len(brick.normals), len(brick.edges)) == (6, 12)
    assert (box.dim, brick.dim) == (2, 3)
    assert "4 vertices" in repr(box)


def test_points_on_a_side_are_let_go_and_edges_within_a_face_are_none():
    square = Polytope([[0, 0], [1, 0], [1, 1], [0.5, 1.0], [0, 1]])
    assert len(square.vertices) == 4
    tetrahedron = Polytope([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    assert (len(tetrahedron.normals), len(tetrahedron.edges)) == (4, 6)


NAN = np.nan
BAD = [
    (lambda: Polytope([[0, 0], [1, 0], [1, 1], [0.5, 0.2], [0, 1]]), GeometryError, "point 3"),
    (lambda: Polytope([[0, 0], [1, 0], [2, 0]]), GeometryError, "flat"),
    (lambda: Polytope([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]), GeometryError, "flat"),
    (lambda: Polytope([[0, 0], [1, 0], [0, 1], [0, 1]]), GeometryError, "points 2 and 3"),
    (lambda: Polytope([[0, 0], [1, 0]]), ShapeError, "2 point"),
    (lambda: Polytope([0.0, 1.0]), ShapeError, "vertices"),
    (lambda: Polytope([[0, 0], [1, 0], [NAN, 1]]), NotFiniteError, "vertices"),
    (lambda: Polytope.box([1, 0]), BoundsError, "size"),
    (lambda: Polytope.box([1, 1], rotation=[[1, 0], [0, 2]]), GeometryError, "rotation"),
    (lambda: Polytope.box([1, 1, 1], angle=0.3), GeometryError, "angle"),
    (
        lambda: Polytope.from_half_spaces([[1, 0], [0, 1], [-1, 0]], np.ones(3)),
        GeometryError,
        "unb",
    ),
    (lambda: Polytope.from_half_spaces([[1, 0], [-1, 0]], [-1, -1]), GeometryError, "no point"),
    (
        lambda: Polytope.from_half_spaces([[1, 0], [-1, 0], [0, 1], [0, -1]], [1, -1, 1, 1]),
        GeometryError,
        "flat",
    ),
    (lambda: Polytope.from_half_spaces([[1, 0], [0, 0]], [1, 1]), GeometryError, "row 1"),
    (lambda: Polytope.from_half_spaces(np.zeros((0, 2)), []), GeometryError, "A"),
    (lambda: Polytope.from_half_spaces([[1, 0]], [1, 1]), ShapeError, "b"),
    (lambda: Polytope.from_half_spaces([[NAN, 0]], [1]), NotFiniteError, "A"),
]


@pytest.mark.parametrize(("make", "error", "names"), BAD)
def test_what_is_no_body_is_refused(make, error, names):
    with pytest.raises(error, match=names):
        make()


def test_it_is_frozen_and_can_be_pickled():
    given_points = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    shape = Polytope(given_points)
    given_points[0] = 9.0
    assert shape.vertices.max() == 1.0
    for array in (shape.vertices, shape.normals, shape.offsets, shape.edges):
        assert not array.flags.writeable
    again = pickle.loads(pickle.dumps(shape))
    np.testing.assert_array_equal(again.vertices, shape.vertices)
