"""Polygons whose corners and means are world coordinates both: offset twice, and refused."""

import re

import numpy as np
import pytest

from scp_mpc import GeometryError, ObstaclePrediction, Polytope

N = 5
BOX = np.array([[-1.0, -0.5], [1.0, -0.5], [1.0, 0.5], [-1.0, 0.5]])
WALL = np.array([[3.0, -4.0], [3.4, -4.0], [3.4, -0.6], [3.0, -0.6]])
TRIANGLE = np.array([[0.0, 0.0], [2.0, 0.0], [0.5, 1.5]])


def made(corners, mean):
    means = np.asarray(mean) + 0.1 * np.arange(N + 1)[:, None]
    return ObstaclePrediction(means, np.zeros((len(mean),) * 2), 0.0, shape=Polytope(corners))


@pytest.mark.parametrize("at", [(5.0, 2.0), (-3.0, 0.5), (0.0, -0.8), (388096.0, 3948996.0)])
@pytest.mark.parametrize("corners", [BOX, WALL, TRIANGLE])
def test_means_in_the_middle_of_the_corners_are_refused(corners, at):
    world = corners + at
    middle = world.mean(axis=0)
    if (Polytope(world).normals @ np.zeros(2) <= Polytope(world).offsets).all():
        pytest.skip("the origin is within: nothing to tell by")
    offset = re.escape(f"{np.linalg.norm(middle):.3g} m")
    with pytest.raises(GeometryError, match=f"offset by {offset} twice") as error:
        made(world, middle)
    assert error.value.argument == "shape"
    made(world - middle, middle)  # what was meant
    Polytope(world).static(N)


@pytest.mark.parametrize("seed", range(20))
def test_measured_means_anywhere_within_are_refused(seed):
    """A tracked body, its corners as they were seen: the mean is not exactly their middle."""
    rng = np.random.default_rng(seed)
    dim = 2 + seed % 2
    at = rng.normal(size=dim)
    at *= rng.uniform(3, 30) / np.linalg.norm(at)
    body = Polytope.box(rng.uniform(0.5, 2.0, dim))
    shares = rng.dirichlet(np.ones(len(body.vertices)))
    with pytest.raises(GeometryError, match="twice"):
        made(body.vertices + at, at + shares @ body.vertices)


def test_a_reference_point_outside_of_the_body_is_no_mistake():
    """A trailer behind its hitch, wherever it drives, and a far lever arm elsewhere."""
    trailer = Polytope.box([4.0, 2.0], centre=[-3.5, 0.0]).vertices
    for x in np.linspace(-9, 9, 50):
        for y in (-0.41, 0.0, 1.7):
            made(trailer, [x, y])
    for mean in ([0.0, 0.0], [9.0, 0.5], [5.0, 2.9], [-5.0, -2.0]):
        made(BOX + [5.0, 1.0], mean)


def test_centred_bodies_may_be_anywhere():
    rng = np.random.default_rng(0)
    for at in rng.normal(scale=3, size=(100, 2)):
        made(BOX, at)
        made(TRIANGLE, at)
    made(BOX, [0.0, 0.0])
    made(BOX + [0.3, 0.1], [0.3, 0.1])  # the origin is within
