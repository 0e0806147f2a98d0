"""The judge itself: it must find what is wrong with a plan, and nothing with a true one."""

from dataclasses import replace

import numpy as np
import pytest
from instances import obstacle, problem, rotated, straight_reference
from judge import axes_distances, exact_distances, judge

from scp_mpc import SCP, LinearModel, Margin, ObstaclePrediction, Status

N = 8
REF = straight_reference(N)


def solved(obstacles, **changes):
    case = problem(N, max_obstacles=max(len(obstacles), 1), **changes)
    return case, SCP(case).solve(REF[0], REF, obstacles)


def faults(case, plan, obstacles, **changes):
    return judge(case, REF[0], REF, obstacles, replace(plan, **changes)).complaints


AHEAD = [obstacle(N, (1.5, 0.1)), obstacle(N, (2.5, -0.9))]
ON_TOP = [ObstaclePrediction(REF[:, [0, 2]], 0.04 * np.eye(2), 0.2)]


@pytest.mark.parametrize("inflation", ["exact", "axes"])
@pytest.mark.parametrize("obstacles", [AHEAD, ON_TOP, []], ids=["ahead", "on top", "none"])
def test_a_true_plan_is_true(inflation, obstacles):
    case, plan = solved(obstacles, inflation=inflation)
    verdict = judge(case, REF[0], REF, obstacles, plan)
    assert verdict.complaints == []
    assert verdict.clear == plan.ok == (obstacles is not ON_TOP)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: {"U": -p.U}, "do not follow"),
        (lambda p: {"X": p.X + np.eye(4)[2] * 1e-4}, "do not follow"),
        (lambda p: {"X": np.vstack([p.X[:1] + 1e-4, p.X[1:]])}, "do not follow"),
        (lambda p: {"U": p.U + [[1e-6, 0]] * (p.U.max() == p.U)}, "beyond its limit"),
        (lambda p: {"cost": p.cost * 1.0001}, "the cost is"),
        (lambda p: {"s": p.s - 0.01}, "a size"),
        (lambda p: {"U": p.U * np.nan}, "not finite"),
        (lambda p: {"slack": p.slack + 1e-4}, "invented"),
        (lambda _: {"status": Status.SOFTENED}, "every constraint holds"),
        (lambda _: {"status": Status.FALLBACK}, "every constraint holds"),
    ],
)
def test_a_lie_about_a_clear_plan_is_found(change, words):
    case, plan = solved(AHEAD)
    assert plan.U.max() == 3.0
    assert any(words in said for said in faults(case, plan, AHEAD, **change(plan)))


def test_a_hidden_violation_is_found():
    case, plan = solved(ON_TOP)
    assert plan.slack.max() > 0.1
    hidden = faults(case, plan, ON_TOP, slack=0 * plan.slack)
    assert any("hidden" in said for said in hidden)
    late = plan.slack.copy()
    late[plan.slack.argmax() // N, plan.slack.argmax() % N] -= 1e-4
    assert any("hidden" in said for said in faults(case, plan, ON_TOP, slack=late))
    proud = faults(case, plan, ON_TOP, status=Status.CONVERGED)
    assert any("is violated" in said for said in proud)


def test_a_swapped_sign_of_an_obstacle_is_found():
    """A plan that passes on one side does not clear the mirror image of what it passed."""
    beside = [obstacle(N, (1.6, 0.4))]
    case, plan = solved(beside)
    mirrored = [obstacle(N, (1.6, -0.4))]
    assert judge(case, REF[0], REF, beside, plan).complaints == []
    assert any("is violated" in said for said in faults(case, plan, mirrored))


def test_other_dynamics_are_found():
    case, plan = solved(AHEAD)
    model = case.model
    other = replace(case, model=LinearModel(model.A, -model.B, model.dt, model.position))
    assert any("do not follow" in said for said in faults(other, plan, AHEAD))


def test_sizes_that_give_way_are_held_to_their_limits():
    case, plan = solved(AHEAD, margin=Margin(lower=0.5))
    assert judge(case, REF[0], REF, AHEAD, plan).complaints == []
    assert any("a size" in said for said in faults(case, plan, AHEAD, s=0 * plan.s + 0.4))


def test_distances_to_balls():
    rng = np.random.default_rng(0)
    for d in (2, 3):
        p, mu = rng.normal(size=(2, 40, d))
        p[0] = mu[0]
        Sigma = np.tile(0.09 * np.eye(d), (40, 1, 1))
        wanted = np.linalg.norm(p - mu, axis=1) - 2 * 0.3 - 0.1
        for distances in (
            exact_distances(p, mu, Sigma, np.full(40, 2.0), 0.1),
            exact_distances(p, mu, 0 * Sigma, np.zeros(40), 0.7),
        ):
            np.testing.assert_allclose(distances, wanted, atol=1e-12)
        ratio = np.linalg.norm(p - mu, axis=1) / 0.7
        axes = axes_distances(p, mu, Sigma, np.full(40, 2.0), 0.1, 2.0)
        np.testing.assert_allclose(axes, 0.7 * (ratio - 1), atol=1e-12)


@pytest.mark.parametrize("deviations", [(0.5, 0.3), (1.0, 0.05), (0.4, 0.4)])
def test_distances_to_ellipses_are_those_to_their_boundary(deviations):
    """Found by walking along the boundary, which the support function knows nothing of."""
    rng = np.random.default_rng(1)
    p, s, angle = rng.normal(size=(30, 2)), 1.7, 0.7
    Sigma = rotated(deviations, angle)
    t = np.linspace(0.0, 2 * np.pi, 200_001)
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    boundary = (R @ (s * np.array(deviations)[:, None] * np.array([np.cos(t), np.sin(t)]))).T
    nearest = np.array([np.linalg.norm(boundary - q, axis=1).min() for q in p])
    inside = np.einsum("ki,ij,kj->k", p, np.linalg.inv(Sigma), p) < s**2
    found = exact_distances(p, 0 * p, np.tile(Sigma, (30, 1, 1)), np.full(30, s), 0.0)
    np.testing.assert_allclose(found, np.where(inside, -nearest, nearest), atol=1e-7)
    assert inside.any()
    assert not inside.all()


def test_distances_in_space_are_those_to_the_boundary():
    rng = np.random.default_rng(2)
    semi = np.array([0.9, 0.5, 0.2])
    V = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    Sigma = V @ np.diag(semi**2) @ V.T
    Sigma = (Sigma + Sigma.T) / 2
    p = rng.normal(size=(12, 3))
    t, f = np.meshgrid(np.linspace(0, 2 * np.pi, 1201), np.linspace(-np.pi / 2, np.pi / 2, 601))
    sphere = np.stack([np.cos(f) * np.cos(t), np.cos(f) * np.sin(t), np.sin(f)], -1).reshape(-1, 3)
    boundary = (semi * sphere) @ V.T
    nearest = np.array([np.linalg.norm(boundary - q, axis=1).min() for q in p])
    inside = np.einsum("ki,ij,kj->k", p, np.linalg.inv(Sigma), p) < 1
    found = exact_distances(p, 0 * p, np.tile(Sigma, (12, 1, 1)), np.ones(12), 0.0)
    np.testing.assert_allclose(found, np.where(inside, -nearest, nearest), atol=2e-4)


@pytest.mark.parametrize("long", [1.0, 1e3, 1e6])
def test_distances_to_needles(long):
    """Far thinner than any fan of even directions could resolve: a segment along the x-axis."""
    Sigma = np.diag([long**2, 0.0])
    p = np.array([[0.3, 0.2], [long + 0.3, 0.0], [0.0, -2.0], [0.5, 0.0]])
    wanted = [0.2, 0.3, 2.0, 0.0]
    found = exact_distances(p, 0 * p, np.tile(Sigma, (4, 1, 1)), np.ones(4), 0.0)
    np.testing.assert_allclose(found, wanted, atol=1e-9 * long)
