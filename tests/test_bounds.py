"""Bounds of the states, which give way at a price, and of the inputs' rates, which do not."""

import numpy as np
import pytest
from instances import problem

from scp_mpc import BoundsError, InvalidArgumentError, NotFiniteError, ShapeError

NAN, INF = np.nan, np.inf


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"x_min": 1.0, "x_max": [2.0, 2.0, -2.0, 2.0]}, BoundsError, "1.0 exceeds x_max = -2.0"),
        ({"x_min": INF}, BoundsError, "x_min: inf at index 0"),
        ({"x_max": [1.0, 1.0, -INF, 1.0]}, BoundsError, "x_max: -inf at index 2"),
        ({"x_max": [1.0, NAN, 1.0, 1.0]}, NotFiniteError, "x_max: nan at index .1"),
        ({"x_max": [1.0, 1.0]}, ShapeError, "x_max"),
        ({"x_max": np.ones((4, 1))}, ShapeError, "x_max"),
        ({"x_max": 1e200}, BoundsError, "x_max: 1e\\+200"),
        ({"x_max": "fast"}, InvalidArgumentError, "x_max"),
        ({"x_min": [None] * 4}, InvalidArgumentError, "x_min"),
        ({"du_min": 0.5}, BoundsError, "du_min: 0.5 for input 0"),
        ({"du_max": [1.0, -0.5]}, BoundsError, "du_max: -0.5 for input 1"),
        ({"du_max": -INF}, BoundsError, "du_max"),
        ({"du_max": NAN}, NotFiniteError, "du_max"),
        ({"du_max": np.ones(4)}, ShapeError, "du_max"),
        ({"state_slack_weight": 0.0}, BoundsError, "state_slack_weight"),
        ({"state_slack_weight": INF}, NotFiniteError, "state_slack_weight"),
    ],
)
def test_bad_bounds_are_refused(changes, error, message):
    with pytest.raises(error, match=message):
        problem(8, **changes)


def test_no_bounds_are_infinite_ones():
    free = problem(8)
    assert not free.limits_states
    assert not free.limits_rates
    assert free.bounded_states.shape == (0,)
    assert (free.x_min == -INF).all()
    assert (free.x_max == INF).all()
    assert (free.du_min == -INF).all()
    assert (free.du_max == INF).all()
    given = problem(8, x_min=-INF, x_max=[INF] * 4, du_min=[-INF, -INF], du_max=INF)
    assert not given.limits_states
    assert not given.limits_rates


def test_bounds_are_copied_and_frozen():
    x_max = np.array([INF, 2.0, INF, 1.5])
    this = problem(8, x_max=x_max, x_min=[-INF, -INF, -1.0, -1.5], du_max=[INF, 0.5])
    x_max[:] = 0.0
    np.testing.assert_array_equal(this.x_max, [INF, 2.0, INF, 1.5])
    np.testing.assert_array_equal(this.bounded_states, [1, 2, 3])
    assert this.limits_rates
    with pytest.raises(ValueError, match="read-only"):
        this.x_max[0] = 1.0


def test_the_excess_is_what_is_outside_the_bounds_from_stage_one():
    this = problem(8, x_max=[INF, 2.0, INF, 1.5], x_min=[-INF, -2.0, -1.0, -INF])
    states = np.zeros((9, 4))
    states[0] = 99.0
    states[3], states[5] = [50.0, 3.0, -4.0, 1.0], [0.0, -2.5, 0.0, -99.0]
    expected = np.zeros((8, 4))
    expected[2], expected[4] = [0.0, 1.0, 3.0, 0.0], [0.0, 0.5, 0.0, 0.0]
    np.testing.assert_array_equal(this.excess(states), expected)
    slack = np.array([[0.25, 0.5]])
    assert this.penalty(slack, states) == pytest.approx(1e3 * 0.75 + 100.0 * 4.5)
