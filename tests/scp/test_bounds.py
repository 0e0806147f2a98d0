"""Bounds of the states, which give way at a price, and of the inputs' rates, which do not."""

from dataclasses import replace

import numpy as np
import pytest
from driving import same
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import problem, straight_reference

from benchmarks.audit import audit
from benchmarks.peers.nlp import Unknowns
from benchmarks.peers.staged import Staged
from scp_mpc import (
    MPC,
    SCP,
    BoundsError,
    InvalidArgumentError,
    Iterate,
    NotFiniteError,
    Settings,
    ShapeError,
    Status,
)
from scp_mpc.scp import Multipliers

NAN, INF = np.nan, np.inf
N = 8
PIQP = Settings(solver="piqp", deadline=None)
SPEED = {"x_max": [INF, 2.0, INF, 1.5], "x_min": [-INF, -2.0, -INF, -INF]}


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
        ({"x_soft": [True, False]}, InvalidArgumentError, "x_soft"),
        ({"x_soft": 1.0}, InvalidArgumentError, "x_soft"),
        ({"speed_max": 0.0}, BoundsError, "speed_max: 0.0"),
        ({"speed_max": NAN}, NotFiniteError, "speed_max"),
        ({"speed_max": "fast"}, InvalidArgumentError, "speed_max"),
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
    this = problem(8, x_max=[INF, 2.0, INF, 1.5], x_min=[-INF, -2.0, -1.0, -INF], x_soft=True)
    states = np.zeros((9, 4))
    states[0] = 99.0
    states[3], states[5] = [50.0, 3.0, -4.0, 1.0], [0.0, -2.5, 0.0, -99.0]
    expected = np.zeros((8, 4))
    expected[2], expected[4] = [0.0, 1.0, 3.0, 0.0], [0.0, 0.5, 0.0, 0.0]
    np.testing.assert_array_equal(this.excess(states), expected)
    slack = np.array([[0.25, 0.5]])
    assert this.penalty(slack, states) == pytest.approx(1e3 * 0.75 + 100.0 * 4.5)
    some = replace(this, x_soft=[False, True, False, False])
    assert some.penalty(slack, states) == pytest.approx(1e3 * 0.75 + 100.0 * 1.5)


@pytest.mark.parametrize(
    ("u_last", "lower", "upper"),
    [
        ([0.0, 0.0], [-0.5, -INF], [1.0, 0.25]),
        ([3.0, -3.0], [2.5, -INF], [4.0, -2.75]),
        ([3.2, -3.1], [2.7, -INF], [4.2, -2.85]),  # outside, but not for long
        ([9.0, -9.0], [3.0, -INF], [10.0, -3.0]),  # so far outside that the rate gives way
        ([-9.0, 9.0], [-9.5, -INF], [-3.0, 9.25]),
        (None, [-INF, -INF], [INF, INF]),
    ],
)
def test_what_rates_allow_of_the_first_input(u_last, lower, upper):
    this = problem(N, du_min=[-0.5, -INF], du_max=[1.0, 0.25])
    reached = this.reach(None if u_last is None else np.array(u_last))
    np.testing.assert_allclose(reached, [lower, upper], rtol=1e-15)


numbers = st.floats(-10.0, 10.0)


@settings(max_examples=100, deadline=None)
@given(
    inputs=st.lists(st.tuples(numbers, numbers), min_size=N, max_size=N),
    u_last=st.none() | st.tuples(numbers, numbers),
    steps=st.tuples(*[st.floats(0.0, 4.0) | st.just(INF)] * 4),
)
def test_limited_inputs_keep_all_bounds_and_change_no_more_than_they_must(inputs, u_last, steps):
    this = problem(N, u_min=[-1.0, -3.0], du_min=np.negative(steps[:2]), du_max=steps[2:])
    U, last = np.array(inputs), None if u_last is None else np.array(u_last)
    before = U.copy()
    V = this.limited(U, last)
    np.testing.assert_array_equal(U, before)
    assert (this.u_min <= V).all()
    assert (this.u_max >= V).all()
    change = np.diff(V, axis=0)
    assert (change <= this.du_max + 1e-9).all()
    assert (change >= this.du_min - 1e-9).all()
    low, high = this.reach(last)
    room = np.clip([low, high], this.u_min, this.u_max)
    assert (room[0] <= V[0]).all()
    assert (room[1] >= V[0]).all()
    np.testing.assert_array_equal(V[0], np.clip(U[0], *room))
    np.testing.assert_array_equal(this.limited(V, last), V)


def test_multipliers_of_bounds_move_with_their_stage_and_need_not_be_there():
    rng = np.random.default_rng(0)
    later = [*range(1, N), N - 1]
    for nodes in (N, 4 * N):
        shapes = (N, 4), (N, 2), (1,), (1, nodes), (1, nodes), (N, 3), (N, 2)
        old = Multipliers(*(rng.normal(size=shape) for shape in shapes))
        new = old.shifted()
        np.testing.assert_array_equal(new.states, old.states[later])
        np.testing.assert_array_equal(new.rates, old.rates[later])
        for name in ("obstacles", "slack"):
            stages = getattr(old, name).reshape(N, -1)
            np.testing.assert_array_equal(getattr(new, name).reshape(N, -1), stages[later])
    bare = Multipliers(*list(vars(old).values())[:5])
    assert bare.shifted().states.size == bare.shifted().rates.size == 0


def test_a_guess_brings_the_multipliers_of_all_bounds_or_none():
    this, ref = problem(N, x_max=[INF, 2.0, INF, 2.0], du_max=1.0), straight_reference(N)
    zeros = [np.zeros(shape) for shape in ((N, 4), (N, 2), (1,), (1, N), (1, N))]
    guess = Iterate(ref, np.zeros((N, 2)), np.ones(1), np.zeros((1, N)), Multipliers(*zeros))
    solver = SCP(this, PIQP)
    solver.solve(ref[0], ref, [], guess)
    for name, columns in (("states", 4), ("rates", 3)):
        duals = replace(guess.multipliers, **{name: np.zeros((N, columns))})
        with pytest.raises(ShapeError, match=rf"guess.{name}: shape \({N}, {columns}\)"):
            solver.solve(ref[0], ref, [], replace(guess, multipliers=duals))


@pytest.mark.parametrize(
    ("u_last", "error"),
    [
        ([0.0], ShapeError),
        (0.0, ShapeError),
        ([0.0, NAN], NotFiniteError),
        ([INF, 0.0], NotFiniteError),
        ("full", InvalidArgumentError),
    ],
)
@pytest.mark.parametrize("changes", [{}, {"du_max": 0.5, "x_max": 3.0}])
def test_a_bad_last_input_is_refused_and_leaves_no_trace(u_last, error, changes):
    ref = straight_reference(N)
    plans = []
    for disturbed in (False, True):
        mpc = MPC(problem(N, **changes), PIQP)
        for k in range(3):
            if disturbed:
                with pytest.raises(error, match="u_last"):
                    mpc.step(ref[k], ref, u_last=u_last)
            plans.append(mpc.step(ref[k], ref + [0, 0, 0.1, 0]))
    assert same(plans[:3], plans[3:])
    with pytest.raises(error, match="u_last"):
        SCP(problem(N, **changes), PIQP).solve(ref[0], ref, u_last=u_last)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"x_max": [INF, 2.0, INF, INF]}, "problem.x_max: 2.0 for state 1"),
        ({"x_min": [-INF, -INF, -1.0, -INF]}, "problem.x_min: -1.0 for state 2"),
        ({"du_min": [-1.0, -INF]}, "problem.du_min"),
        ({"du_max": 1.0}, "problem.du_max"),
    ],
)
def test_peers_refuse_what_they_do_not_bound(changes, message):
    with pytest.raises(InvalidArgumentError, match=message):
        Unknowns(problem(N, **changes))
    with pytest.raises(InvalidArgumentError, match=message):
        Staged(problem(N, "axes", **changes), "fatrop")


def test_the_audit_finds_rates_and_states_beyond_their_bounds():
    this, ref = problem(N, du_max=0.5, du_min=-0.5, **SPEED), straight_reference(N)
    plan = SCP(this, PIQP).solve(ref[0], ref)
    assert plan.ok
    assert audit(this, ref[0], [], plan) == audit(problem(N), ref[0], [], plan)
    fast = SCP(problem(N)).solve(ref[0], straight_reference(N, 4.0))
    assert "a rate is" in audit(this, ref[0], [], fast).invalid
    assert "a state is" in audit(problem(N, **SPEED), ref[0], [], fast).lie


def test_braking_keeps_rates_and_says_what_states_exceed():
    this = problem(N, du_min=-0.4, du_max=0.4, u_min=-1.0, x_soft=True, **SPEED)
    start, last = np.array([0.0, 3.0, 0.0, 0.0]), np.array([0.5, 0.0])
    plan = SCP(this).brake(start, np.zeros(4), u_last=last)
    assert plan.status is Status.FALLBACK
    change = np.diff(np.vstack([last, plan.U]), axis=0)
    assert (np.abs(change) <= 0.4 + 1e-9).all()
    np.testing.assert_allclose(plan.x_slack, this.excess(plan.X))
    assert plan.x_slack.max() == pytest.approx(1.02)
    assert plan.kkt.feasibility == pytest.approx(1.02)
    assert SCP(this).brake([0, 1.0, 0, 0], np.zeros(4), u_last=[0, 0]).status is Status.BRAKING
