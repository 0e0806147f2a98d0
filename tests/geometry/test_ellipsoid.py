"""The signed distance against brute force, and its theory."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from scp_mpc.geometry import signed_distance

coordinate = st.floats(-10, 10).map(lambda v: 0.0 if abs(v) < 1e-6 else v)
axis = st.floats(0, 5).map(lambda v: 0.0 if v < 1e-6 else v)


def support_gap(y, e, n):
    """n'y - |diag(e) n|, which no unit n lifts above the signed distance."""
    return n @ y - np.linalg.norm(e * n, axis=-1)


def brute_force(y, e):
    """Largest support gap over a fine grid of directions, refined twice."""
    centre, width = 0.0, np.pi
    for _ in range(8):
        theta = centre + width * np.linspace(-1, 1, 2001)
        n = np.stack([np.cos(theta), np.sin(theta)], axis=1)
        centre, width = theta[np.argmax(support_gap(y, e, n))], width / 100
    return support_gap(y, e, np.array([[np.cos(centre), np.sin(centre)]]))[0]


@given(y=st.tuples(coordinate, coordinate), e=st.tuples(axis, axis))
def test_agrees_with_brute_force(y, e):
    y, e = np.array(y), np.array(e)
    sd, n = signed_distance(y, e)
    assert np.isfinite(n).all()
    assert np.linalg.norm(n) == pytest.approx(1)
    assert sd == pytest.approx(brute_force(y, e), abs=1e-9)
    assert sd == pytest.approx(support_gap(y, e, n), abs=1e-12)


@given(
    y=st.tuples(coordinate, coordinate, coordinate),
    e=st.tuples(axis, axis, axis),
    seed=st.integers(0, 2**32 - 1),
)
def test_no_direction_exceeds_it_in_space(y, e, seed):
    y, e = np.array(y), np.array(e)
    n = np.random.default_rng(seed).standard_normal((500, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    sd, normal = signed_distance(y, e)
    assert sd >= support_gap(y, e, n).max() - 1e-12
    near = normal + 1e-3 * n
    near /= np.linalg.norm(near, axis=1, keepdims=True)
    assert sd >= support_gap(y, e, near).max() - 1e-12


@pytest.mark.parametrize(
    ("y", "e", "distance", "normal"),
    [
        ((3.0, 0.0), (1.0, 1.0), 2.0, (1.0, 0.0)),  # disc, outside
        ((0.5, 0.0), (1.0, 1.0), -0.5, (1.0, 0.0)),  # disc, inside
        ((0.0, -4.0), (3.0, 1.0), 3.0, (0.0, -1.0)),  # along the short axis
        ((4.0, 0.0), (3.0, 1.0), 1.0, (1.0, 0.0)),  # along the long axis
        ((0.0, 0.2), (3.0, 1.0), -0.8, (0.0, 1.0)),  # inside: out the short way
        ((3.0, 4.0), (0.0, 0.0), 5.0, (0.6, 0.8)),  # a point
        ((0.5, 2.0), (1.0, 0.0), 2.0, (0.0, 1.0)),  # beside a segment
        ((4.0, 4.0), (1.0, 0.0), 5.0, (0.6, 0.8)),  # beyond the end of a segment
    ],
)
def test_known_cases(y, e, distance, normal):
    sd, n = signed_distance(np.array(y), np.array(e))
    assert sd == pytest.approx(distance, abs=1e-9)
    np.testing.assert_allclose(n, normal, atol=1e-6)


def test_the_side_decides_where_the_nearest_point_is_not_unique():
    e = np.array([[2.0, 1.0], [2.0, 1.0], [1.0, 1.0]])
    y = np.array([[0.3, 0.0], [0.3, 0.0], [0.0, 0.0]])
    side = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
    sd, n = signed_distance(y, e, lambda: side)
    assert np.isfinite(sd).all()
    assert n[0, 1] > 0.9
    assert n[1, 1] < -0.9
    assert (n[2] < 0).all()


def test_a_stack_equals_its_parts():
    rng = np.random.default_rng(1)
    y, e = rng.normal(size=(3, 7, 2)) * 3, rng.uniform(0, 2, size=(3, 7, 2))
    sd, n = signed_distance(y, e)
    for j in range(3):
        for i in range(7):
            one_sd, one_n = signed_distance(y[j, i], e[j, i])
            assert sd[j, i] == pytest.approx(one_sd, abs=1e-12)
            np.testing.assert_allclose(n[j, i], one_n, atol=1e-9)


def test_what_counts_as_zero_is_not_measured_by_a_huge_neighbour():
    """Ellipses from a line to a thousand kilometres: each as if it were alone."""
    y = np.array([[0.1, 1e-8], [3e5, 2e5], [0.2, 0.1]])
    semi_axes = np.array([[0.3, 0.0], [8e5, 8e5], [0.3, 1e-7]])
    together, normals = signed_distance(y, semi_axes)
    for k in range(3):
        alone, normal = signed_distance(y[k], semi_axes[k])
        assert together[k] == alone
        np.testing.assert_array_equal(normals[k], normal)
