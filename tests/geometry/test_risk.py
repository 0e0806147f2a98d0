"""Risk: sizes, half-space bounds, what a plan commits to, and its allocation."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import obstacle, problem, rotated, straight_reference
from scipy.stats import chi2, norm

from scp_mpc import (
    MPC,
    SCP,
    BoundsError,
    Containment,
    DoubleIntegrator,
    InvalidArgumentError,
    JointRisk,
    Margin,
    ObstaclePrediction,
    StageRisk,
)
from scp_mpc.geometry import NoGoSets, containment_size, risk_bound, size_at_risk
from scp_mpc.scp.risk_allocation import reallocated

S95 = 5.991**0.5


@pytest.mark.parametrize("risk", [0.4, 0.1, 0.05, 0.01, 1e-6])
def test_sizes_are_quantiles(risk):
    assert size_at_risk(risk) == pytest.approx(norm.isf(risk), rel=1e-12)
    for dim in (2, 3):
        assert containment_size(1 - risk, dim) == pytest.approx(chi2.ppf(1 - risk, dim) ** 0.5)


def sets_of(means, covariances, radius):
    return NoGoSets.pairs(np.array(means), np.array(covariances), np.full(len(means), radius))


def slow_bound(p, mu, Sigma, r):
    """Best of a fine fan of half-spaces, each evaluated by its formula."""
    angle = np.linspace(0, 2 * np.pi, 20001)
    n = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return norm.sf((n @ (p - mu) - r) / np.sqrt(np.einsum("ki,ij,kj->k", n, Sigma, n))).min()


@settings(deadline=None, max_examples=60)
@given(
    st.floats(0, np.pi), st.floats(0.05, 2.0), st.floats(0.05, 2.0), st.floats(0, 2 * np.pi),
    st.floats(0.5, 4.0),
)  # fmt: skip
def test_the_bound_is_that_of_the_best_half_space(angle, first, second, bearing, distance):
    Sigma, r = rotated((first, second), angle), 0.35
    p = distance * np.array([np.cos(bearing), np.sin(bearing)])
    mine = risk_bound(sets_of([[0.0, 0.0]], [Sigma], r), p[None])[0, 0]
    best = slow_bound(p, np.zeros(2), Sigma, r)
    assert 0.99 * best - 1e-12 <= mine <= best * (1 + 1e-9) + 1e-12  # the fan is not quite dense


@pytest.mark.parametrize("dim", [2, 3])
def test_the_bound_bounds_the_measured_frequency(dim):
    rng = np.random.default_rng(0)
    G = rng.normal(size=(dim, dim))
    Sigma, r = 0.05 * G @ G.T, 0.4
    drawn = rng.multivariate_normal(np.zeros(dim), Sigma, size=100_000)
    for distance in (0.5, 0.8, 1.2):
        p = distance * np.eye(dim)[0]
        bound = risk_bound(sets_of([np.zeros(dim)], [Sigma], r), p[None])[0, 0]
        measured = (np.linalg.norm(p - drawn, axis=1) <= r).mean()
        assert measured <= bound + 3e-3
        assert bound < 1e-3 or measured > 0.05 * bound  # and is no empty promise


def test_the_bound_without_doubt_and_within_the_disc():
    certain = sets_of([[0.0, 0.0]], [np.zeros((2, 2))], 0.3)
    assert risk_bound(certain, np.array([[0.31, 0.0]]))[0, 0] == 0.0
    assert risk_bound(certain, np.array([[0.29, 0.0]]))[0, 0] == 1.0
    inside = risk_bound(sets_of([[0.0, 0.0]], [0.04 * np.eye(2)], 0.3), np.array([[0.1, 0.0]]))
    assert inside[0, 0] == pytest.approx(norm.sf(-1.0))


def test_promises_become_sizes():
    def size(margin, obstacles=2, **changes):
        values = {"max_obstacles": 3, "nodes_per_interval": 4, **changes}
        return problem(10, margin=margin, **values).size_for(obstacles, 4)

    assert size(StageRisk(0.05)) == pytest.approx(norm.isf(0.05 / 5))
    assert problem(10, margin=StageRisk(0.05)).size_for(2, 1) == pytest.approx(norm.isf(0.05))
    assert size(JointRisk(0.05)) == pytest.approx(norm.isf(0.05 / (2 * 10 * 4)))
    assert size(Containment(0.95)) == pytest.approx(chi2.ppf(0.95, 2) ** 0.5)
    assert size(Margin(reference=2.0, lower=1.0)) == 2.0
    assert problem(10, margin=None).size == Margin()
    space = {"model": DoubleIntegrator(0.2, 3), "Q": [1.0, 0.1] * 3, "R": [0.1] * 3}
    deep = problem(10, margin=None, **space)
    assert deep.size.lower == deep.size.reference == pytest.approx(chi2.ppf(0.95, 3) ** 0.5)


@pytest.mark.parametrize(
    "make",
    [
        lambda: StageRisk(0.0),
        lambda: StageRisk(0.5),
        lambda: JointRisk(float("nan")),
        lambda: JointRisk(0.1, "fair"),
        lambda: Containment(1.0),
        lambda: problem(5, margin=0.05),
        lambda: problem(5, nodes_per_interval=0),
        lambda: problem(5, nodes_per_interval=2.0),
    ],
)
def test_bad_promises_are_refused(make):
    with pytest.raises(InvalidArgumentError):
        make()


def test_the_offending_risk_is_named():
    with pytest.raises(BoundsError, match=r"delta: 0\.7 "):
        JointRisk(0.7)


CROSSING = {"position": (3.2, -1.6), "velocity": (0.0, 0.8), "covariance": 0.03 * np.eye(2)}
AHEAD = {"position": (2.6, 0.1), "velocity": (0.4, 0.0), "covariance": rotated((0.3, 0.1), 0.6)}


def solved(margin, nodes_per_interval=1, **changes):
    N, ref = 15, straight_reference(15)
    both = [obstacle(N, **CROSSING), obstacle(N, **AHEAD)]
    case = problem(
        N, margin=margin, max_obstacles=3, nodes_per_interval=nodes_per_interval, **changes
    )
    return SCP(case).solve(ref[0], ref, both)


@pytest.mark.parametrize("nodes_per_interval", [1, 4])
@pytest.mark.parametrize("delta", [0.1, 0.01])
def test_plans_commit_to_no_more_than_promised(delta, nodes_per_interval):
    stage = solved(StageRisk(delta), nodes_per_interval)
    assert stage.ok
    assert stage.risk.stages.shape == (2, 15)
    assert stage.risk.stages.max() <= delta * (1 + 1e-5)
    uniform = solved(JointRisk(delta), nodes_per_interval)
    iterative = solved(JointRisk(delta, "iterative"), nodes_per_interval)
    for plan in (uniform, iterative):
        assert plan.ok
        assert plan.risk.joint <= delta * (1 + 1e-5)
        assert plan.risk.joint == pytest.approx(plan.risk.obstacles.sum())
        # Between the samples, the point that two intervals share counts for both.
        assert (plan.risk.stages.sum(axis=1) >= plan.risk.obstacles * (1 - 1e-9)).all()
    # The allocation buys cost with risk that the uniform one left unused.
    assert uniform.risk.joint < 0.5 * delta
    assert iterative.risk.joint > 0.6 * delta
    assert iterative.cost < 0.97 * uniform.cost
    # One point in fifteen times two obstacles: a joint promise costs more than one per stage.
    assert stage.cost < uniform.cost


def test_an_interval_answers_for_the_points_at_both_ends():
    plan = solved(StageRisk(0.05), 4)
    step, iterate = plan.step, plan.iterate
    path = step.nodes.positions(iterate.states, iterate.inputs)
    points = step.risks(path)
    K = step.nodes.count
    for i in range(15):
        own = points[:, i * K : (i + 1) * K].sum(axis=1)
        before = points[:, i * K - 1] if i else 0.0
        np.testing.assert_allclose(plan.risk.stages[:, i], own + before)
    assert plan.risk.joint == pytest.approx(points.sum())


def test_a_promise_for_one_obstacle_does_not_pay_for_empty_slots():
    ref, one = straight_reference(15), [obstacle(15, **AHEAD)]
    few, many = (
        SCP(problem(15, margin=JointRisk(0.05), max_obstacles=slots)).solve(ref[0], ref, one)
        for slots in (1, 8)
    )
    assert few.cost == pytest.approx(many.cost, rel=1e-6)


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 10_000))
def test_reallocation_keeps_the_sum_and_takes_from_nobody_what_it_used(seed):
    rng = np.random.default_rng(seed)
    allocated = np.full((2, 12), 0.05 / 24)
    for _ in range(4):
        used = allocated * rng.choice([1.0, 0.0, 0.3], size=allocated.shape)
        new = reallocated(allocated, used)
        assert new.sum() == pytest.approx(allocated.sum(), rel=1e-12)
        assert (new >= used * (1 - 1e-12)).all()
        assert new.min() > 0
        allocated = new


def test_axes_commit_to_more_than_they_promise():
    """Beside an elongated ellipse the report's set is too small, and the plan says so."""
    N, ref = 15, straight_reference(15)
    long = [obstacle(N, (2.8, 0.25), (0.2, 0.0), rotated((0.5, 0.04), 0.8), growth=0.0)]
    plans = {
        shape: SCP(problem(N, shape, margin=StageRisk(0.05))).solve(ref[0], ref, long)
        for shape in ("exact", "axes")
    }
    assert all(plan.ok for plan in plans.values())
    assert plans["exact"].risk.stages.max() <= 0.05 * (1 + 1e-5)
    assert plans["axes"].risk.stages.max() > 0.08


def test_the_robots_own_covariance_adds_to_the_obstacles():
    N, ref = 15, straight_reference(15)
    mine = 0.02 * np.eye(2)
    theirs = obstacle(N, **AHEAD)
    together = ObstaclePrediction(theirs.means, theirs.covariances + mine, theirs.radius)
    case = problem(N, margin=StageRisk(0.05))
    added = SCP(case).solve(ref[0], ref, [theirs], robot_covariance=mine)
    grown = SCP(case).solve(ref[0], ref, [together])
    np.testing.assert_allclose(added.X, grown.X, atol=1e-8)
    assert added.risk.joint == pytest.approx(grown.risk.joint, rel=1e-6)
    stepped = MPC(case).step(ref[0], ref, [theirs], robot_covariance=np.tile(mine, (N + 1, 1, 1)))
    np.testing.assert_array_equal(stepped.X, added.X)
    with pytest.raises(InvalidArgumentError, match="robot_covariance"):
        MPC(case).step(ref[0], ref, [theirs], robot_covariance=-mine)
