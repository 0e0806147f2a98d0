"""From convex steps to Newton's: the series, its sum, and what is done where there is none."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from instances import DT, KINDS, S_REF, instance, obstacle, problem, straight_reference
from qpsolvers import solve_qp
from scipy.sparse import csc_array

from scp_mpc import (
    SCP,
    DoubleIntegrator,
    ObstaclePrediction,
    Problem,
    Settings,
    Status,
    Trajectory,
)
from scp_mpc.deadline import Clock
from scp_mpc.geometry import NoGoSets
from scp_mpc.geometry.inflation import AxesInflation, ExactInflation
from scp_mpc.geometry.tangent_basis import inverse_root, tangents
from scp_mpc.models import Unicycle
from scp_mpc.qp.active_set import CondensedQP, settled
from scp_mpc.scp import loop
from scp_mpc.scp.loop import Loop
from scp_mpc.scp.newton import newton_program, newton_step, summed
from scp_mpc.scp.nodes import Nodes
from scp_mpc.scp.step import Step
from scp_mpc.scp.transcription import Transcription


def held_on(A):
    """The solution of a program whose half-spaces A v >= 1 are all that matters."""
    k, n = A.shape
    p = CondensedQP(np.eye(n), np.full(n, -1e3), np.full(n, 1e3), A, np.ones(k), np.eye(n))
    guess = np.concatenate([np.zeros(n, int), -np.ones(k, int)])
    return settled(p, guess, np.zeros(n + k, dtype=bool), 100).solution


def bent(scale, seed=0, n=8, k=2, q=3):
    """A program's solution, and bends that make the convex steps shrink or grow."""
    rng = np.random.default_rng(seed)
    A, L = rng.normal(size=(k, n)), scale * rng.normal(size=(q, n)) / np.sqrt(n)
    held = held_on(A)
    return held, L, rng.normal(size=n), np.eye(n) - np.linalg.pinv(held.rows) @ held.rows


def test_the_sum_is_that_of_the_convex_steps():
    held, L, d, P = bent(0.6)
    T = P @ L.T @ L
    assert np.abs(np.linalg.eigvals(T)).max() < 1
    steps, total = P @ d, np.zeros(8)
    for _ in range(5000):
        total, steps = total + steps, T @ steps
    whole = summed(held, L, L @ (P @ d))
    np.testing.assert_allclose(whole.v - held.v, total - P @ d, atol=1e-9)
    # The active set holds all along, at forces that keep the balance.
    np.testing.assert_allclose(held.rows @ whole.v, held.rows @ held.v, atol=1e-9)
    turned = L.T @ np.linalg.solve(np.eye(3) - L @ P @ L.T, L @ (P @ d))
    np.testing.assert_allclose(whole.v, whole.force @ np.vstack([np.eye(8), held.rows]) + turned)


def test_there_is_no_sum_where_the_steps_grow():
    held, L, d, P = bent(3.0)
    assert np.abs(np.linalg.eigvals(P @ L.T @ L)).max() > 1
    assert summed(held, L, L @ (P @ d)) is None


@pytest.mark.parametrize("seed", range(12))
def test_a_program_with_another_hessian_is_solved(seed):
    """Against a solver of quadratic programs; from the active set of the one with the identity."""
    rng = np.random.default_rng(seed)
    n, k = 6, 5
    A, here = rng.normal(size=(k, n)), rng.normal(size=n)
    b = A @ here - rng.uniform(0.0, 1.5, k)
    F = np.vstack([np.eye(n), rng.normal(size=(3, n))])
    width = rng.uniform(0.5, 2.0, (2, len(F)))
    p = CondensedQP(F, F @ here - width[0], F @ here + width[1], A, b, np.eye(n))
    convex = settled(p, np.zeros(9 + k, int), np.zeros(9 + k, dtype=bool), 100).solution
    values, vectors = rng.uniform(-1.0, 4.0, n), np.linalg.qr(rng.normal(size=(n, n)))[0]
    if seed % 2:  # all other curvatures are one
        values, vectors = values[:2], vectors[:, :2]
    H = np.eye(n) + (vectors * (np.maximum(values, 0.1) - 1.0)) @ vectors.T
    found = newton_program(p, here, values, vectors, convex)
    G, h = np.vstack([F, -F, -A]), np.concatenate([p.upper, -p.lower, -b])
    best = solve_qp(csc_array(H), here - H @ here, csc_array(G), h, solver="clarabel")
    np.testing.assert_allclose(found.v, best, atol=1e-4)  # an interior point
    push = found.force @ np.vstack([F, A])
    np.testing.assert_allclose(here + H @ (found.v - here), push, atol=1e-8)
    np.testing.assert_allclose(found.factor.T @ found.factor, found.rows @ found.rows.T, atol=1e-9)
    assert (found.force[found.active == 0] == 0).all()


def test_a_robot_that_turns_before_it_drives_is_planned_for_in_a_few_iterations():
    """Bounds come and go on the way; convex steps alone, which do not bend, end uncertified."""
    limit = np.array([np.inf, np.inf, np.inf, 1.5])
    turns = Problem(
        Unicycle(0.1), horizon=30, Q=[1, 1, 0.01, 0.05], R=[0.02] * 2, u_min=-2.0, u_max=2.0,
        x_min=-limit, x_max=limit,
    )  # fmt: skip
    for goal in ([-2.0, 1.0], [0.5, -3.0], [-1.0, -0.2], [2.0, 2.0]):
        plan = SCP(turns, Settings(history=True)).solve(np.zeros(4), [*goal, 0.0, 0.0])
        assert plan.status is Status.CONVERGED
        assert len(plan.history) <= 12


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("kind", [ExactInflation, AxesInflation])
def test_the_bend_is_the_second_derivative(kind, dim):
    """Against differences of gradient and slope; for the axes in the position only."""
    rng = np.random.default_rng(dim)
    K, inflation = 7, kind(S_REF)
    G = 0.4 * rng.normal(size=(K, dim, dim))
    direction = rng.normal(size=(K, dim))
    mu = rng.normal(size=(K, dim))
    p = mu + 2.5 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    sets = NoGoSets.pairs(mu, G @ np.swapaxes(G, 1, 2), rng.uniform(0.2, 0.5, K))
    s, start = rng.uniform(1, 3, K), np.ones((K, dim))

    def linear(p, s):
        spaces = inflation.linearise(sets, p[:, None], s, start)
        return spaces, np.concatenate([spaces.normal[:, 0], spaces.slope], axis=1)

    spaces, _ = linear(p, s)
    L = inflation.curvature_factor(sets, s, spaces)[:, 0]
    assert L.shape == (K, dim + 1, dim - 1)
    hessian, h = L @ np.swapaxes(L, 1, 2), 1e-5
    for a in range(dim + (kind is ExactInflation)):
        dp, ds = (h * np.eye(dim)[a], 0.0) if a < dim else (0.0, h)
        change = (linear(p + dp, s + ds)[1] - linear(p - dp, s - ds)[1]) / (2 * h)
        rows = slice(None) if kind is ExactInflation else slice(dim)
        np.testing.assert_allclose(hessian[:, rows, a], change[:, rows], atol=1e-7)


@pytest.mark.parametrize("dim", [2, 3])
def test_tangents_complete_a_basis(dim):
    n = np.random.default_rng(0).normal(size=(50, dim))
    n = np.vstack([n, np.eye(dim), -np.eye(dim)])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    basis = np.concatenate([n[..., None], tangents(n)], axis=-1)
    unit = np.broadcast_to(np.eye(dim), basis.shape)
    np.testing.assert_allclose(np.swapaxes(basis, 1, 2) @ basis, unit, atol=1e-12)
    M = np.array([[[2.0, 0.5], [0.5, 1.0]]])[:, : dim - 1, : dim - 1]
    root = inverse_root(M, 1e-9)
    np.testing.assert_allclose(
        root @ np.swapaxes(root, 1, 2) @ M, np.eye(dim - 1)[None], atol=1e-12
    )


def plain(monkeypatch):
    """Take away the sums: convex steps only."""
    monkeypatch.setattr(loop, "refined", lambda _, __, solution: solution)


@pytest.mark.parametrize("inflation", ["exact", "axes"])
def test_summed_and_plain_reach_the_same_optimum_the_former_sooner(monkeypatch, inflation):
    cases = [
        instance(kind, 20, inflation, S_REF, s) for kind, s in itertools.product(KINDS, (0, 1))
    ]
    settings = Settings(multi_start=False, max_iterations=2000)

    def solve(case):
        guess = Trajectory(case.x_ref, np.zeros((20, 2)))
        return SCP(case.problem, settings).solve(case.x0, case.x_ref, case.obstacles, guess)

    quick = [solve(case) for case in cases]
    plain(monkeypatch)
    slow = [solve(case) for case in cases]
    assert all(plan.status is Status.CONVERGED for plan in quick + slow)
    for a, b in zip(quick, slow, strict=True):
        assert a.cost == pytest.approx(b.cost, rel=1e-5)
    assert sum(p.iterations for p in quick) < 0.4 * sum(p.iterations for p in slow)


def test_convergence_is_quadratic_at_the_end():
    """From near the optimum, each residual is about the square of the one before."""
    case = instance("ahead", 20, "exact", S_REF, 0)
    tight = Settings(multi_start=False, tolerance=1e-10)
    plan = SCP(case.problem, tight).solve(case.x0, case.x_ref, case.obstacles)
    rng, residuals = np.random.default_rng(0), []
    U = case.problem.limited(plan.U + 0.02 * rng.normal(size=plan.U.shape))
    for limit in (1, 2, 3):
        settings = Settings(multi_start=False, tolerance=1e-12, max_iterations=limit)
        at = Transcription(case.problem, settings, Nodes.of(case.problem))
        at.begin(Step.read(case.problem, case.x0, case.x_ref, case.obstacles), Clock())
        end = Loop(at).run(at.at(replace(plan.iterate, inputs=U)))
        residuals.append(end.residuals.worst)
    assert residuals[1] < 20 * residuals[0] ** 1.7
    assert residuals[2] < 1e-9


def head_on():
    """Straight behind a slow obstacle, everything symmetric: trailing is a saddle point."""
    case, ref = problem(30, "exact"), straight_reference(30, 2.0)
    behind = ref.copy()
    behind[:, 0] = np.minimum(ref[:, 0], 1.5)
    behind[1:, 2] = 1e-6
    return case, ref, [obstacle(30, (3.0, 0.0), (0.3, 0.0))], Trajectory(behind, np.zeros((30, 2)))


def test_a_saddle_is_left_sooner_than_by_convex_steps(monkeypatch):
    case, ref, slow, guess = head_on()
    settings = Settings(multi_start=False, max_iterations=500)
    quick = SCP(case, settings).solve(ref[0], ref, slow, guess)
    plain(monkeypatch)
    creeping = SCP(case, settings).solve(ref[0], ref, slow, guess)
    assert quick.status is Status.CONVERGED
    assert quick.cost <= creeping.cost * (1 + 1e-6)
    assert quick.iterations < creeping.iterations


def test_a_spatial_plan_converges_as_quickly():
    model = DoubleIntegrator(DT, dim=3)
    case = problem(15, "exact", 0.5, model=model, Q=[1.0, 0.1] * 3, R=[0.01] * 3)
    ref = np.zeros((16, 6))
    ref[:, 0], ref[:, 1] = 0.4 * np.arange(16), 2.0
    Sigma = np.diag([0.04, 0.01, 0.02])
    ball = ObstaclePrediction(np.tile([3.0, 0.05, 0.1], (16, 1)), Sigma, 0.2)
    plan = SCP(case, Settings(multi_start=False)).solve(ref[0], ref, [ball])
    assert plan.status is Status.CONVERGED
    assert plan.iterate.touches
    assert plan.iterations <= 15
    assert set(plan.qps) <= {"kkt", "osqp", "repaired"}


@pytest.mark.parametrize("seed", range(4))
def test_newton_step_solves_the_kkt_system(seed):
    rng = np.random.default_rng(seed)
    held = held_on(rng.normal(size=(3, 8)))
    W = rng.normal(size=(8, 8))
    W, step = 0.1 * (W + W.T), rng.normal(size=8)
    rows, k = held.rows, len(held.rows)
    assert k
    whole = newton_step(held, step, W)
    # minimise |v|^2/2 + (v - here)'W(v - here)/2 on the active set, here = held.v - step
    KKT = np.block([[np.eye(8) + W, -rows.T], [rows, np.zeros((k, k))]])
    right = np.concatenate([W @ (held.v - step), rows @ held.v])
    dense = np.linalg.solve(KKT, right)
    np.testing.assert_allclose(whole.v, dense[:8], atol=1e-9)
    np.testing.assert_allclose(whole.force[held.indices], dense[8:], atol=1e-9)
    L = 0.2 * rng.normal(size=(3, 8))
    other = summed(held, L, L @ step)
    whole = newton_step(held, step, -L.T @ L)
    np.testing.assert_allclose(whole.v, other.v, atol=1e-9)
    np.testing.assert_allclose(whole.force, other.force, atol=1e-9)
    assert newton_step(held, step, -100 * np.eye(8)) is None


def test_a_plan_that_is_given_up_within_an_obstacle_says_how_deep():
    """Time can run out where nobody was to yield, and a violation is one all the same."""
    case = instance("ahead", 20, "exact", S_REF, 0)
    at = Transcription(case.problem, Settings(), Nodes.of(case.problem))
    step = Step.read(case.problem, case.x0, case.x_ref, case.obstacles)
    at.begin(step, Clock())
    through = at.at(at.iterate(at.obstacle_free_optimum(None)))
    assert not through.slack.any()
    end = Loop(at).result(through)
    positions = at.nodes.positions(end.iterate.states, end.iterate.inputs)
    depths = step.depths(positions, end.iterate.s)
    assert end.status is Status.VIOLATING
    assert depths.max() > 0.1
    np.testing.assert_allclose(end.iterate.slack[: step.count], depths, atol=1e-9)
