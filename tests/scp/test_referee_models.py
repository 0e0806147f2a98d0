"""The referee of the models: its dynamics are theirs, and it agrees with the other referee."""

from types import SimpleNamespace

import casadi
import numpy as np
import pytest
from instances import DT, instance, obstacle, rotated
from models import OWN, draw
from referee import Referee

from benchmarks.peers.referee import ModelReferee, symbolic
from scp_mpc import SCP, Containment, DoubleIntegrator, ObstaclePrediction, Problem, Settings
from scp_mpc.models import Unicycle
from scp_mpc.trajectory import rollout


@pytest.mark.parametrize("name", OWN)
def test_its_dynamics_are_the_models(name):
    model = OWN[name]
    x, u = casadi.SX.sym("x", model.nx), casadi.SX.sym("u", model.nu)
    after = symbolic(model)(x, u)
    both = casadi.horzcat(casadi.jacobian(after, x), casadi.jacobian(after, u))
    y = casadi.SX.sym("y", model.nx)
    bent = casadi.hessian(casadi.dot(y, after), casadi.vertcat(x, u))[0]
    evaluate = casadi.Function("f", [x, u, y], [after, both, bent])
    rng = np.random.default_rng(4)
    for _ in range(5):
        x, u = draw(model, rng)
        y = rng.normal(size=model.nx)
        after, both, bent = (np.array(value) for value in evaluate(x, u, y))
        there = model.linearise(x, u)
        np.testing.assert_allclose(there.after, after.ravel(), atol=1e-12)
        np.testing.assert_allclose(np.hstack([there.A, there.B]), both, atol=1e-11)
        np.testing.assert_allclose(model.curvature(x, u, y), bent, atol=1e-10)


@pytest.mark.parametrize("kind", ["beside", "crossing", "elongated"])
def test_both_referees_agree(kind):
    step = instance(kind, 8, "exact", 5.991**0.5, 1)
    plan = SCP(step.problem, Settings()).solve(step.x0, step.x_ref, step.obstacles)
    given = (step.problem, step.x0, step.x_ref)
    other = Referee(*given, step.obstacles[0]).solve(plan.X, plan.U, float(plan.s[0]), near=True)
    verdict = ModelReferee(*given, step.obstacles).solve(plan.X, plan.U, near=True)
    assert verdict.ok
    assert other.ok
    assert verdict.cost == pytest.approx(other.cost, abs=1e-6)
    np.testing.assert_allclose(verdict.X, other.X, atol=1e-4)


@pytest.mark.parametrize("inflation", ["exact", "axes"])
def test_a_referee_may_be_taken_to_another_step(inflation):
    here, there = (instance(kind, 8, inflation, 0.5, 1) for kind in ("elongated", "crossing"))
    plan = SCP(there.problem, Settings()).solve(there.x0, there.x_ref, there.obstacles)

    def given(step, one):
        return step.x0, step.x_ref, (step.obstacles[0] if one else step.obstacles)

    for kind in (Referee, ModelReferee) if inflation == "exact" else (Referee,):
        one = kind is Referee
        first = kind(here.problem, *given(here, one))
        new = kind(there.problem, *given(there, one))
        moved = first.at(*given(there, one))
        assert moved.kkt(plan) == pytest.approx(new.kkt(plan), abs=1e-12)
        assert first.kkt(plan)["violation"] > 1e-2  # and it stays where it is
        assert first.kkt(plan)["defect"] > 1e-2


def test_it_judges_several_obstacles():
    step = instance("beside", 8, "exact", 5.991**0.5, 1)
    problem = Problem(**{**vars(step.problem), "max_obstacles": 2})
    slanted = rotated((0.2, 0.1), 1.0)
    obstacles = [obstacle(8, (1.6, 0.75)), obstacle(8, (2.2, -0.75), covariance=slanted)]
    plan = SCP(problem, Settings()).solve(step.x0, step.x_ref, obstacles)
    verdict = ModelReferee(problem, step.x0, step.x_ref, obstacles).solve(plan.X, plan.U, near=True)
    alone = ModelReferee(problem, step.x0, step.x_ref, obstacles[:1])
    assert verdict.ok
    assert verdict.cost == pytest.approx(plan.cost, abs=1e-5)
    assert verdict.cost > alone.solve(plan.X, plan.U, near=True).cost + 1e-3


def test_it_judges_in_space():
    model, N = DoubleIntegrator(DT, 3), 8
    problem = Problem(
        model,
        horizon=N,
        Q=[0.2, 0.05] * 3,
        R=[0.001] * 3,
        u_min=-3.0,
        u_max=3.0,
        robot_radius=0.15,
        margin=Containment(0.95),
        nodes_per_interval=1,
    )
    way = np.stack([2 * DT * np.arange(N + 1), np.zeros(N + 1), np.zeros(N + 1)], axis=-1)
    x_ref = model.state(way, np.broadcast_to([2.0, 0.0, 0.0], way.shape))
    Sigma = np.diag([0.03, 0.02, 0.01]) + 0.005
    mean, Sigmas = np.tile([1.9, 0.1, 0.2], (N + 1, 1)), np.tile(Sigma, (N + 1, 1, 1))
    obstacles = [ObstaclePrediction(mean, Sigmas, 0.2)]
    plan = SCP(problem, Settings()).solve(x_ref[0], x_ref, obstacles)
    verdict = ModelReferee(problem, x_ref[0], x_ref, obstacles).solve(plan.X, plan.U, near=True)
    assert verdict.ok
    assert np.abs(plan.X[:, 2:]).max() > 0.1
    assert verdict.cost == pytest.approx(plan.cost, abs=1e-5)


def test_it_keeps_bounds_of_states_and_of_differences():
    """A unicycle around an obstacle, through the referee alone."""
    model, N = Unicycle(DT), 12
    problem = SimpleNamespace(
        model=model,
        horizon=N,
        Q=np.diag([1.0, 1.0, 0.01, 0.1]),
        Qf=np.diag([2.0, 2.0, 0.01, 0.1]),
        R=0.01 * np.eye(2),
        u_min=np.array([-3.0, -2.0]),
        u_max=np.array([3.0, 2.0]),
        robot_radius=0.15,
    )
    way = np.stack([DT * np.arange(N + 1), np.zeros(N + 1)], axis=-1)
    x_ref = model.state(way, np.broadcast_to([1.0, 0.0], way.shape))
    guess = rollout(model.step, x_ref[0], np.tile([0.0, 0.2], (N, 1)))
    inputs = problem, x_ref[0], x_ref, [obstacle(N, (1.3, -0.05))]
    free = ModelReferee(*inputs, size=2.0).solve(guess.states, guess.inputs, near=False)
    assert free.ok
    found = rollout(model.step, x_ref[0], free.U)
    np.testing.assert_allclose(found.states, free.X, atol=1e-7)
    error = free.X[1:] - x_ref[1:]
    cost = sum(e @ problem.Q @ e for e in error[:-1]) + error[-1] @ problem.Qf @ error[-1]
    assert free.cost == pytest.approx(cost + 0.01 * (free.U**2).sum(), rel=1e-9)
    bounds = {"x_max": [np.inf, np.inf, np.inf, 1.05], "du_min": -0.6, "du_max": 0.6}
    held = ModelReferee(*inputs, size=2.0, u_before=np.zeros(2), **bounds)
    held = held.solve(free.X, free.U, near=False)
    assert held.ok
    changes = np.diff(held.U, axis=0, prepend=0.0)
    assert np.abs(changes).max() <= 0.6 + 1e-7
    assert held.X[1:, 3].max() <= 1.05 + 1e-7
    assert np.abs(np.diff(free.U, axis=0, prepend=0.0)).max() > 0.7
    assert held.cost > free.cost
