"""The active-set solver against another QP solver, with and without yielding half-spaces."""

from dataclasses import replace

import numpy as np
import pytest
import qpsolvers
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import csc_matrix

from scp_mpc.solver.active_set import ActiveSetSolver, CondensedProgram


def program(seed, n=12, K=6, far=False):
    """Random bounds about zero and half-spaces that the origin violates, met by some point."""
    rng = np.random.default_rng(seed)
    F, A = rng.normal(size=(n, n)) / np.sqrt(n), rng.normal(size=(K, n)) / np.sqrt(n)
    inside = rng.normal(size=n) * (3.0 if far else 0.5)
    lower = np.minimum(F @ inside, 0.0) - rng.uniform(0, 0.3, n)
    upper = np.maximum(F @ inside, 0.0) + rng.uniform(0, 0.3, n)
    return F, CondensedProgram(F, lower, upper, A, A @ inside - rng.uniform(0, 0.1, K))


def yielding(p, cap):
    """The same program with half-spaces that yield at a force."""
    return replace(p, cap=np.concatenate([np.full(len(p.F), np.inf), np.full(len(p.b), cap)]))


def clarabel(P, q, G, h):
    return qpsolvers.solve_qp(csc_matrix(P), q, csc_matrix(G), h, solver="clarabel")


def oracle(F, p, cap=None):
    """Solve the same program with Clarabel; with slack at `cap` per metre if given."""
    n, K = F.shape[1], len(p.b)
    if cap is None:
        G, h = np.vstack([F, -F, -p.A]), np.concatenate([p.upper, -p.lower, -p.b])
        return clarabel(np.eye(n), np.zeros(n), G, h)
    P, q = np.zeros((n + K, n + K)), np.concatenate([np.zeros(n), np.full(K, cap)])
    P[:n, :n] = np.eye(n)
    none = np.zeros((len(F), K))
    G = np.block([[F, none], [-F, none], [-p.A, -np.eye(K)], [np.zeros((K, n)), -np.eye(K)]])
    h = np.concatenate([p.upper, -p.lower, -p.b, np.zeros(K)])
    z = clarabel(P, q, G, h)
    return None if z is None else z[:n]


def check(F, p, held, cap=np.inf):
    """The KKT conditions, spelt out."""
    rows = np.vstack([F, p.A])
    force = held.force
    np.testing.assert_allclose(held.v, force @ rows, atol=1e-7 * (1 + np.abs(force).max()))
    bounded, gap = F @ held.v, p.A @ held.v - p.b
    assert (bounded >= p.lower - 1e-8).all()
    assert (bounded <= p.upper + 1e-8).all()
    beta, push = force[: len(F)], force[len(F) :]
    assert (np.abs(bounded - p.lower)[beta > 1e-9] < 1e-7).all()
    assert (np.abs(bounded - p.upper)[beta < -1e-9] < 1e-7).all()
    assert (push >= -1e-9).all()
    assert (push <= cap * (1 + 1e-9)).all()
    assert (gap[push < cap] >= -1e-7).all()
    assert (gap[push > 1e-9] <= 1e-7).all()


@given(seed=st.integers(0, 10_000), sizes=st.sampled_from([(12, 6), (40, 4), (6, 10)]))
def test_agrees_with_another_solver(seed, sizes):
    F, p = program(seed, *sizes)
    held = ActiveSetSolver(F.shape[1]).solve(p, np.zeros(sum(sizes), dtype=np.intp))
    assert held is not None
    check(F, p, held)
    # An interior point stops at a duality gap, whose root is the distance.
    np.testing.assert_allclose(held.v, oracle(F, p), atol=1e-3)


@given(seed=st.integers(0, 10_000))
def test_bounds_may_yield_while_half_spaces_do_not(seed):
    """Some bounds are out of reach; what they pay is their distance times their cap."""
    F, p = program(seed)
    rng = np.random.default_rng(seed)
    soft = np.arange(12) % 3 == 0
    shift = np.where(soft, rng.choice([-4.0, 4.0], 12), 0.0)
    cap = np.where(np.concatenate([soft, np.zeros(6, bool)]), 1.5, np.inf)
    p = replace(p, lower=p.lower + shift, upper=p.upper + shift, cap=cap)
    held = ActiveSetSolver(12).solve(p, np.zeros(18, dtype=np.intp))
    assert held is not None
    beyond = np.maximum(0, np.maximum(p.lower - F @ held.v, F @ held.v - p.upper))
    assert (beyond[~soft] < 1e-8).all()
    assert (p.A @ held.v >= p.b - 1e-8).all()
    assert (np.abs(held.force[:12][beyond > 1e-7]) == 1.5).all()
    assert (np.abs(held.force[:12][soft]) <= 1.5 * (1 + 1e-9)).all()
    np.testing.assert_allclose(held.v, held.force @ np.vstack([F, p.A]), atol=1e-7)
    assert p.penalty(held.v) == pytest.approx(1.5 * beyond[soft].sum())
    z = clarabel_soft(F, p, soft)
    np.testing.assert_allclose(held.v, z, atol=2e-3)


def clarabel_soft(F, p, soft):
    """The same with a slack for each soft bound."""
    n, k = 12, int(soft.sum())
    P = np.zeros((n + k, n + k))
    P[:n, :n] = np.eye(n)
    E = np.zeros((n, k))
    E[soft] = np.eye(k)
    none = np.zeros((len(p.b), k))
    G = np.block([[F, -E], [-F, -E], [-p.A, none], [np.zeros((k, n)), -np.eye(k)]])
    h = np.concatenate([p.upper, -p.lower, -p.b, np.zeros(k)])
    return clarabel(P, np.concatenate([np.zeros(n), np.full(k, 1.5)]), G, h)[:n]


@given(seed=st.integers(0, 10_000))
def test_yields_like_an_exact_l1_penalty(seed):
    F, p = program(seed)
    tight = yielding(replace(p, b=p.b + 2.0), 3.0)
    held = ActiveSetSolver(F.shape[1]).solve(tight, np.zeros(18, dtype=np.intp))
    assert held is not None
    check(F, tight, held, cap=3.0)
    np.testing.assert_allclose(held.v, oracle(F, tight, cap=3.0), atol=1e-3)


def test_any_guess_leads_to_the_same_point():
    rng = np.random.default_rng(0)
    F, p = program(3)
    solver = ActiveSetSolver(F.shape[1])
    cold = solver.solve(p, np.zeros(18, dtype=np.intp))
    for _ in range(20):
        guess = rng.integers(-1, 2, 18)
        guess[12:] = -np.abs(guess[12:])
        warm = solver.solve(p, guess)
        np.testing.assert_allclose(warm.v, cold.v, atol=1e-9)
    again = solver.solve(p, cold.active)
    np.testing.assert_array_equal(again.v, cold.v)


def test_a_glimpse_is_the_same_point_without_its_forces():
    F, p = program(5)
    solver = ActiveSetSolver(F.shape[1])
    held = solver.solve(p, np.zeros(18, dtype=np.intp))
    v, pushing = solver.glimpse(p, np.zeros(12, dtype=np.intp))
    np.testing.assert_allclose(v, held.v, atol=1e-7)
    np.testing.assert_array_equal(pushing, held.force[12:] > 0)


def test_what_cannot_be_met_has_no_solution_unless_it_yields():
    F, p = program(1, far=True)
    opposed = replace(p, A=np.vstack([p.A[:1], -p.A[:1]]), b=np.array([0.1, 0.1]))
    solver, nothing = ActiveSetSolver(F.shape[1]), np.zeros(14, dtype=np.intp)
    assert solver.solve(opposed, nothing) is None
    assert solver.glimpse(opposed, nothing[:12]) is None
    held = solver.solve(yielding(opposed, 50.0), nothing)
    check(F, opposed, held, cap=50.0)
    assert held.capped.sum() >= 1


def test_the_same_row_twice_does_no_harm():
    F, p = program(2)
    twice = replace(p, A=np.vstack([p.A, p.A]), b=np.tile(p.b, 2))
    solver = ActiveSetSolver(F.shape[1])
    once = solver.solve(p, np.zeros(18, dtype=np.intp))
    held = solver.solve(twice, np.zeros(24, dtype=np.intp))
    np.testing.assert_allclose(held.v, once.v, atol=1e-7)
    check(F, twice, held)


def test_bounds_enter_as_they_matter_and_all_are_kept():
    """The half-spaces push against bounds that neither the guess nor the origin touches."""
    for n in (30, 150):
        F, p = program(11, n=n, K=8, far=True)
        held = ActiveSetSolver(F.shape[1]).solve(p, np.zeros(n + 8, dtype=np.intp))
        assert (held.active[:n] != 0).any()
        check(F, p, held)


def test_consistent_sees_wrong_forces_and_broken_constraints():
    F, p = program(4)
    solver = ActiveSetSolver(F.shape[1])
    held = solver.solve(p, np.zeros(18, dtype=np.intp))
    assert solver.consistent(p, held, 1e-9)
    assert not solver.consistent(p, replace(held, force=-held.force), 1e-9)
    assert not solver.consistent(p, replace(held, v=np.zeros(12)), 1e-9)
    beyond = held.v + 10 * F[0] / (F[0] @ F[0])
    assert not solver.consistent(p, replace(held, v=beyond), 1e-9)


@pytest.mark.parametrize("cap", [np.inf, 1e3])
def test_nothing_to_do(cap):
    F, p = program(0)
    free = CondensedProgram(F, p.lower - 1, p.upper + 1, np.zeros((0, 12)), np.zeros(0))
    held = ActiveSetSolver(12).solve(yielding(free, cap), np.zeros(12, dtype=np.intp))
    assert not held.v.any()
    assert not held.force.any()
