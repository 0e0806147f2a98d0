"""The exact solve on a guessed active set, and its repair: against Clarabel and linear programs."""

from dataclasses import replace

import numpy as np
import pytest
import qpsolvers
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.sparse import csc_matrix

from scp_mpc.qp.active_set import CondensedQP, holds, settled, solve_on

PLENTY = 1000  # changes of the active set
SEEDS = st.integers(0, 10_000)
SIZES = st.sampled_from([(12, 0, 6), (40, 0, 4), (6, 0, 10), (8, 5, 4), (5, 12, 3)])


def program(seed, n=12, more=0, K=6, far=False):
    """Random bounds about zero and half-spaces that the origin violates, met by some point.

    Besides the square box of n entries there are `more` bounded entries.
    """
    rng = np.random.default_rng(seed)
    F, A = rng.normal(size=(n + more, n)) / np.sqrt(n), rng.normal(size=(K, n)) / np.sqrt(n)
    inside = rng.normal(size=n) * (3.0 if far else 0.5)
    lower = np.minimum(F @ inside, 0.0) - rng.uniform(0, 0.3, n + more)
    upper = np.maximum(F @ inside, 0.0) + rng.uniform(0, 0.3, n + more)
    b = A @ inside - rng.uniform(0, 0.1, K)
    return CondensedQP(F, lower, upper, A, b, np.linalg.inv(F[:n]), least=0.7)


def relaxable(p, l1_weight):
    """The same program with half-spaces that yield at a force."""
    return replace(
        p, l1_weight=np.concatenate([np.full(len(p.F), np.inf), np.full(len(p.b), l1_weight)])
    )


def oracle(p):
    """Solve the same program with Clarabel, a slack for each constraint that yields."""
    n = p.F.shape[1]
    l1_weight = np.full(len(p.F) + len(p.b), np.inf) if p.l1_weight is None else p.l1_weight
    soft = np.isfinite(l1_weight)
    k = int(soft.sum())
    E = np.zeros((len(l1_weight), k))
    E[soft] = np.eye(k)
    bounds, spaces = E[: len(p.F)], E[len(p.F) :]
    P = np.zeros((n + k, n + k))
    P[:n, :n] = np.eye(n)
    G = np.block([[p.F, -bounds], [-p.F, -bounds], [-p.A, -spaces], [np.zeros((k, n)), -np.eye(k)]])
    h = np.concatenate([p.upper, -p.lower, -p.b, np.zeros(k)])
    q = np.concatenate([np.zeros(n), l1_weight[soft]])
    some = np.abs(h) < 1e20
    z = qpsolvers.solve_qp(
        csc_matrix(P), q, csc_matrix(G[some]), h[some], solver="clarabel",
        tol_gap_abs=1e-11, tol_gap_rel=1e-11, tol_feas=1e-11,
    )  # fmt: skip
    return None if z is None else z[:n]


def check(p, solution, tolerance=1e-7):
    """The KKT conditions, spelt out."""
    rows, force, v = np.vstack([p.F, p.A]), solution.force, solution.v
    nf = len(p.F)
    l1_weight = np.full(len(force), np.inf) if p.l1_weight is None else p.l1_weight
    np.testing.assert_allclose(v, force @ rows, atol=tolerance * (1 + np.abs(force).max()))
    bounded, gap = p.F @ v, p.A @ v - p.b
    beta, push = force[:nf], force[nf:]
    assert (push >= 0).all()
    assert (np.abs(force) <= l1_weight * (1 + 1e-9)).all()
    hard = np.abs(force) < l1_weight
    assert (bounded >= p.lower - tolerance)[hard[:nf]].all()
    assert (bounded <= p.upper + tolerance)[hard[:nf]].all()
    assert (gap >= -tolerance)[hard[nf:]].all()
    # Who pushes stands at its bound, or beyond it where it yields.
    at_lower, at_upper = bounded - p.lower, p.upper - bounded
    assert (at_lower[beta > 1e-9] < tolerance).all()
    assert (at_upper[beta < -1e-9] < tolerance).all()
    assert (gap[push > 1e-9] < tolerance).all()


def cold(p, guess=None, changes=PLENTY):
    active = np.zeros(len(p.F) + len(p.b), dtype=np.intp) if guess is None else guess
    return settled(p, active, np.zeros(len(active), dtype=bool), changes)


@given(seed=SEEDS, sizes=SIZES)
def test_agrees_with_another_solver(seed, sizes):
    p = program(seed, *sizes)
    end = cold(p)
    assert end.solution is not None
    assert not end.infeasible
    check(p, end.solution)
    np.testing.assert_allclose(end.solution.v, oracle(p), atol=1e-4)
    assert p.merit(end.solution.v) == pytest.approx(0.7 + end.solution.v @ end.solution.v / 2)


@given(seed=SEEDS)
def test_bounds_may_yield_while_half_spaces_do_not(seed):
    """Some bounds are out of reach; what they pay is their distance times their l1_weight."""
    p, rng = program(seed), np.random.default_rng(seed)
    soft = np.arange(12) % 3 == 0
    shift = np.where(soft, rng.choice([-4.0, 4.0], 12), 0.0)
    l1_weight = np.where(np.concatenate([soft, np.zeros(6, bool)]), 1.5, np.inf)
    p = replace(p, lower=p.lower + shift, upper=p.upper + shift, l1_weight=l1_weight)
    solution = cold(p).solution
    assert solution is not None
    check(p, solution)
    beyond = np.maximum(0, np.maximum(p.lower - p.F @ solution.v, p.F @ solution.v - p.upper))
    assert (beyond[~soft] < 1e-8).all()
    assert (np.abs(solution.force[:12][beyond > 1e-7]) == 1.5).all()
    paid = p.merit(solution.v) - 0.7 - solution.v @ solution.v / 2
    assert paid == pytest.approx(1.5 * beyond[soft].sum())
    np.testing.assert_allclose(solution.v, oracle(p), atol=1e-3)


@given(seed=SEEDS)
def test_yields_like_an_exact_l1_penalty(seed):
    p = program(seed)
    tight = relaxable(replace(p, b=p.b + 2.0), 3.0)
    solution = cold(tight).solution
    assert solution is not None
    check(tight, solution)
    np.testing.assert_allclose(solution.v, oracle(tight), atol=1e-3)


@pytest.mark.parametrize("l1_weight", [None, 3.0])
def test_any_guess_leads_to_the_same_point_and_the_right_one_at_once(l1_weight):
    rng, p = np.random.default_rng(0), program(3)
    p = p if l1_weight is None else relaxable(replace(p, b=p.b + 2.0), l1_weight)
    reference = cold(p).solution
    for _ in range(50):
        guess = rng.integers(-1, 2, 18)
        guess[12:] = -np.abs(guess[12:])
        relaxed = (
            np.zeros(18, dtype=bool) if l1_weight is None else (guess != 0) & (rng.random(18) < 0.3)
        )
        relaxed[:12] = False
        warm = settled(p, guess, relaxed, PLENTY).solution
        np.testing.assert_allclose(warm.v, reference.v, atol=1e-9)
        np.testing.assert_allclose(warm.force, reference.force, atol=1e-7)
    again = settled(p, reference.active, reference.relaxed, 0)
    assert again.systems == 1
    np.testing.assert_array_equal(again.solution.v, reference.v)
    np.testing.assert_array_equal(again.solution.active, reference.active)


@given(seed=SEEDS)
def test_a_guess_that_yields_at_the_wrong_bound_is_repaired(seed):
    """The point it leads to can be beyond the other bound."""
    p, rng = program(seed), np.random.default_rng(seed)
    soft = np.concatenate([np.ones(12, bool), np.zeros(6, bool)])
    p = replace(p, l1_weight=np.where(soft, 3.0, np.inf))
    guess = np.where(soft, rng.choice([-1, 1], 18), 0)
    end = settled(p, guess, soft, PLENTY)
    np.testing.assert_allclose(end.solution.v, cold(p).solution.v, atol=1e-8)


@given(seed=SEEDS, sizes=SIZES)
def test_one_wrong_constraint_is_repaired(seed, sizes):
    p, rng = program(seed, *sizes), np.random.default_rng(seed)
    right = cold(p).solution
    guess = right.active.copy()
    k = rng.integers(len(guess))
    guess[k] = 0 if guess[k] else -1
    end = settled(p, guess, right.relaxed, PLENTY)
    assert end.solution is not None
    np.testing.assert_allclose(end.solution.v, right.v, atol=1e-8)


@given(seed=SEEDS, share=st.floats(0.1, 0.9))
def test_a_budget_is_kept_and_nothing_wrong_leaves(seed, share):
    p, rng = program(seed, 20, 10, 8), np.random.default_rng(seed)
    guess = np.where(rng.random(38) < share, rng.choice([-1, 1], 38), 0)
    guess[30:] = -np.abs(guess[30:])
    for changes in (0, 1, 3):
        end = settled(p, guess, np.zeros(38, dtype=bool), changes)
        assert end.systems <= changes + 2  # the last one only takes rounding away
        assert not end.infeasible
        if end.solution is not None:
            check(p, end.solution)


@given(seed=SEEDS, k=st.integers(0, 6))
def test_solving_on_a_set_is_the_nearest_point_of_its_equations(seed, k):
    p, rng = program(seed, 8, 3, 5), np.random.default_rng(seed)
    active = np.zeros(16, dtype=np.intp)
    active[rng.permutation(16)[:k]] = -1
    active[:11] *= rng.choice([-1, 1], 11)
    solution = solve_on(p, active, np.zeros(16, dtype=bool))
    rows = np.vstack([p.F, p.A])[active != 0]
    wanted = np.concatenate([np.where(active[:11] < 0, p.lower, p.upper), p.b])[active != 0]
    nearest = np.linalg.lstsq(rows, wanted)[0] if k else np.zeros(8)
    np.testing.assert_allclose(solution.v, nearest, atol=1e-8)
    np.testing.assert_allclose(solution.force @ np.vstack([p.F, p.A]), solution.v, atol=1e-8)
    assert set(np.flatnonzero(solution.force)) <= set(np.flatnonzero(active))
    upper = np.triu(solution.factor)
    np.testing.assert_allclose(upper.T @ upper, rows @ rows.T, atol=1e-9)
    np.testing.assert_array_equal(solution.indices, np.flatnonzero(active))


def test_capped_constraints_push_with_their_cap_wherever_they_are():
    p = relaxable(program(1), 2.0)
    active, relaxed = np.zeros(18, dtype=np.intp), np.zeros(18, dtype=bool)
    active[[0, 13, 14]], relaxed[[13, 14]] = [1, -1, -1], True
    solution = solve_on(p, active, relaxed)
    assert (solution.force[[13, 14]] == 2.0).all()
    assert p.F[0] @ solution.v == pytest.approx(p.upper[0])
    np.testing.assert_array_equal(solution.indices, [0])
    np.testing.assert_allclose(solution.force @ np.vstack([p.F, p.A]), solution.v, atol=1e-12)


def opposed(seed=1):
    """Two half-spaces that exclude each other."""
    p = program(seed, far=True)
    return replace(p, A=np.vstack([p.A[:1], -p.A[:1]]), b=np.array([0.1, 0.1]))


def test_what_cannot_be_met_has_no_solution_unless_it_yields():
    for seed in range(20):
        end = cold(opposed(seed))
        assert end.solution is None
        assert end.infeasible
        soft = relaxable(opposed(seed), 50.0)
        solution = cold(soft).solution
        check(soft, solution)
        assert solution.relaxed.sum() >= 1


@given(seed=SEEDS, times=st.integers(2, 4))
def test_the_same_rows_several_times_do_no_harm(seed, times):
    p = program(seed)
    many = replace(p, A=np.vstack([p.A] * times), b=np.tile(p.b, times))
    once, solution = cold(p).solution, cold(many).solution
    np.testing.assert_allclose(solution.v, once.v, atol=1e-7)
    check(many, solution)
    everybody = np.concatenate([once.active[:12], np.tile(once.active[12:], times)])
    again = cold(many, everybody).solution
    np.testing.assert_allclose(again.v, once.v, atol=1e-7)
    check(many, again)


def test_a_vertex_that_more_rows_meet_than_it_needs():
    """All half-spaces go through one point, more of them than there are dimensions."""
    for seed in range(50):
        rng = np.random.default_rng(seed)
        n, K = 4, 9
        point, A = rng.normal(size=n), rng.normal(size=(K, n))
        A *= np.where(A @ point < 0, -1.0, 1.0)[:, None]
        wide = np.full(n, 1e3)
        p = CondensedQP(np.eye(n), -wide, wide, A, A @ point, np.eye(n))
        for guess in (None, np.concatenate([np.zeros(n), -np.ones(K)]).astype(np.intp)):
            solution = cold(p, guess).solution
            assert solution is not None
            check(p, solution)


def test_holds_sees_wrong_forces_and_broken_constraints():
    p = program(4)
    solution = cold(p).solution
    assert holds(p, solution, 1e-8)
    assert not holds(p, replace(solution, force=-solution.force), 1e-8)
    assert not holds(p, replace(solution, v=np.zeros(12)), 1e-8)
    beyond = solution.v + 10 * p.F[0] / (p.F[0] @ p.F[0])
    assert not holds(p, replace(solution, v=beyond), 1e-8)


@pytest.mark.parametrize("l1_weight", [np.inf, 1e3])
def test_nothing_to_do(l1_weight):
    p = program(0)
    free = replace(p, lower=p.lower - 1, upper=p.upper + 1, A=np.zeros((0, 12)), b=np.zeros(0))
    end = cold(relaxable(free, l1_weight))
    assert end.systems == 1
    assert not end.solution.v.any()
    assert not end.solution.force.any()


def test_garbage_for_a_guess_ends_without_a_solution_or_with_the_right_one():
    p = program(0)
    right = cold(p).solution
    for guess in (np.ones(18), -np.ones(18), np.tile([-1, 1], 9)):
        end = cold(p, guess.astype(np.intp), 3)
        assert end.solution is None or np.allclose(end.solution.v, right.v, atol=1e-7)


# Bounds of the optimum, and proofs that there is none


@given(
    seed=SEEDS, scale=st.sampled_from([1e-3, 1.0, 1e3]), l1_weight=st.sampled_from([None, 0.3, 3.0])
)
def test_no_multipliers_bound_the_optimum_from_above(seed, scale, l1_weight):
    """Whatever the forces, of any sign, the bound is below the optimum, and at the solution it."""
    p, rng = program(seed, 8, 3, 4), np.random.default_rng(seed)
    p = p if l1_weight is None else relaxable(replace(p, b=p.b + 1.0), l1_weight)
    optimum = p.merit(oracle(p))
    for share in (1.0, 0.3):
        force = scale * rng.normal(size=15) * (rng.random(15) < share)
        assert p.dual_bound(force) <= optimum + 1e-7 * max(1.0, optimum)
    solution = cold(p).solution
    assert p.dual_bound(solution.force) == pytest.approx(optimum, rel=1e-6)
    for stretched in (0.5, 1e-3) if l1_weight is None else (0.5,):
        assert p.dual_bound(stretched * solution.force) == pytest.approx(optimum, rel=1e-6)
    assert p.dual_bound(np.zeros(15)) == p.least


def test_bounds_that_are_none_do_not_push():
    p = program(0, 8, 3, 4)
    free = replace(p, lower=np.full(11, -1e30), upper=np.full(11, 1e30))
    force = np.concatenate([np.random.default_rng(0).normal(size=11), np.zeros(4)])
    assert free.dual_bound(force) == free.least
    assert not free.proves_infeasible(force)


def farkas(p):
    """Multipliers of the hard constraints' least violation: a proof where that is positive."""
    n, nf = p.F.shape[1], len(p.F)
    l1_weight = np.full(nf + len(p.b), np.inf) if p.l1_weight is None else p.l1_weight
    G, h = np.vstack([p.F, -p.F, -p.A]), np.concatenate([p.upper, -p.lower, -p.b])
    hard = np.isinf(np.concatenate([l1_weight[:nf], l1_weight]))
    G = np.hstack([G, -np.ones((len(G), 1))])[hard]
    limits = [(None, None)] * n + [(0, None)]
    end = linprog(np.append(np.zeros(n), 1.0), G, h[hard], bounds=limits)
    assert end.status == 0
    y = np.zeros(len(hard))
    y[hard] = -end.ineqlin.marginals
    return np.concatenate([y[nf : 2 * nf] - y[:nf], y[2 * nf :]]), end.fun


@given(seed=SEEDS, shift=st.floats(0.0, 3.0), extra=st.sampled_from([0, 4]))
def test_only_what_has_no_solution_is_proved_to_have_none(seed, shift, extra):
    p, rng = program(seed, 5, extra, 4), np.random.default_rng(seed)
    p = replace(p, b=p.b + shift)
    proof, violation = farkas(p)
    there = violation < 1e-9
    others = rng.normal(size=(25, 9 + extra))
    others[20:] = np.abs(others[20:])
    for force in (proof, *others):
        assert not (p.proves_infeasible(force) and there)
    if violation > 1e-6:
        assert p.proves_infeasible(proof)
        assert p.proves_infeasible(1e3 * proof)
        assert p.proves_infeasible(1e-3 * proof)
        assert not relaxable(p, 5.0).proves_infeasible(proof)
        which = np.arange(9 + extra)  # bounds yield that are not of the box; obstacles do not
        given_way = replace(p, l1_weight=np.where((which >= 5) & (which < 5 + extra), 2.0, np.inf))
        assert not (given_way.proves_infeasible(proof) and farkas(given_way)[1] < 1e-9)


def test_a_proof_is_found_from_the_multipliers_of_a_solver_on_its_way():
    """The dual bound of an infeasible program grows without limit."""
    p = opposed()
    proof, violation = farkas(p)
    assert violation > 0.01
    assert p.proves_infeasible(proof)
    assert p.dual_bound(proof) > p.least + 1e3 or p.dual_bound(proof) == np.inf
