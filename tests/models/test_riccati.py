"""The Riccati equation's terminal weight: without active constraints the MPC is the LQR."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scp_mpc import (
    MPC,
    CircularReference,
    DoubleIntegrator,
    InvalidArgumentError,
    LinearModel,
    Problem,
    Settings,
    ShapeError,
)
from scp_mpc.control.preview import Preview
from scp_mpc.models.riccati import lqr_gain, lqr_weight, terminal_weight

FREE = {"u_min": -1e6, "u_max": 1e6, "max_obstacles": 0}
PATHS = [Settings(), Settings(solver="piqp")]
PLANE = DoubleIntegrator(0.2)


def drawn_model(rng, kind):
    """A double integrator, or a general stabilisable pair with some unstable modes."""
    if kind != "general":
        return DoubleIntegrator(rng.uniform(0.05, 0.5), dim=kind)
    A = rng.normal(size=(5, 5))
    A *= rng.uniform(0.5, 1.1) / np.abs(np.linalg.eigvals(A)).max()
    return LinearModel(A=A, B=rng.normal(size=(5, 3)), dt=0.1, position=[0, 3])


def drawn_problem(rng, kind, horizon, Qf):
    model = drawn_model(rng, kind)
    roots = rng.normal(size=(2, 6, 6))[:, : model.nx, : model.nx]
    Q, S = (root @ root.T + 0.1 * np.eye(model.nx) for root in roots)
    R = np.diag(rng.uniform(0.01, 1.0, model.nu))
    Qf = S if Qf == "any" else Qf
    return Problem(model=model, horizon=horizon, Q=Q, R=R, Qf=Qf, **FREE)


def backwards(problem, x_ref):
    """Dynamic programming, one stage at a time: u_i = -K_i e_i - k_i, cost to go e'Se + 2q'e."""
    A, B, Q, R = problem.model.A, problem.model.B, problem.Q, problem.R
    S, q, laws = problem.Qf, np.zeros(problem.model.nx), []
    for i in reversed(range(problem.horizon)):
        w = A @ x_ref[i] - x_ref[i + 1]
        M = np.linalg.inv(R + B.T @ S @ B)
        K, k = M @ B.T @ S @ A, M @ B.T @ (S @ w + q)
        laws.append((K, k))
        q = (A - B @ K).T @ (S @ w + q)
        S = Q + A.T @ S @ (A - B @ K)
    return laws[::-1]


def close(found, wanted):
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-9 * max(1, np.abs(wanted).max()))


cases = st.tuples(st.integers(0, 2**32 - 1), st.sampled_from([2, 3, "general"]))


@settings(max_examples=25, deadline=None)
@given(cases, st.integers(1, 20), st.sampled_from(PATHS))
def test_without_constraints_the_mpc_is_the_lqr_at_any_horizon(case, horizon, how):
    rng = np.random.default_rng(case[0])
    problem = drawn_problem(rng, case[1], horizon, "lqr")
    model = problem.model
    K = lqr_gain(model.A, model.B, problem.Q, problem.R)
    x, x_ref = rng.normal(size=model.nx), np.empty((horizon + 1, model.nx))
    x_ref[0] = rng.normal(size=model.nx)
    for i in range(horizon):  # a reference that needs no input
        x_ref[i + 1] = model.A @ x_ref[i]
    plan = MPC(problem, how).step(x, x_ref)
    assert plan.ok
    for i in range(horizon):
        close(plan.U[i], -K @ (x - x_ref[i]))
        x = model.step(x, plan.U[i])


@settings(max_examples=25, deadline=None)
@given(cases, st.integers(1, 15), st.sampled_from(["any", "lqr", None]), st.sampled_from(PATHS))
def test_dynamic_programming_finds_the_same_plan(case, horizon, Qf, how):
    rng = np.random.default_rng(case[0])
    problem = drawn_problem(rng, case[1], horizon, Qf)
    x, x_ref = rng.normal(size=problem.model.nx), rng.normal(size=(horizon + 1, problem.model.nx))
    x_ref[0] = x  # row 0 is not weighted
    plan = MPC(problem, how).step(x, x_ref)
    for i, (K, k) in enumerate(backwards(problem, x_ref)):
        close(plan.U[i], -K @ (x - x_ref[i]) - k)
        x = problem.model.step(x, plan.U[i])
    close(plan.X[-1], x)


@settings(max_examples=20, deadline=None)
@given(cases, st.integers(1, 8), st.integers(1, 12), st.sampled_from(PATHS))
def test_a_folded_reference_plans_as_the_long_one(case, horizon, rows, how):
    """Any reference: N stages about the folded one begin the plan of N + L stages."""
    rng = np.random.default_rng(case[0])
    short = drawn_problem(rng, case[1], horizon, "lqr")
    model = short.model
    weights = {"Q": short.Q, "R": short.R, "Qf": "lqr"}
    long = Problem(model=model, horizon=horizon + rows, **weights, **FREE)
    x_ref = rng.normal(size=(horizon + rows + 1, model.nx))
    x = rng.normal(size=model.nx)
    wanted = MPC(long, how).step(x, x_ref)
    folded = Preview(short, rows).fold(x_ref)
    np.testing.assert_array_equal(folded[:-1], x_ref[:horizon])
    close(MPC(short, how).step(x, folded).U, wanted.U[:horizon])


def test_a_circle_needs_the_fold():
    """Its rows beyond the horizon need inputs: the terminal weight alone does not know."""
    weights = {"Q": [0.2, 0.05, 0.2, 0.05], "R": [0.001, 0.001], "Qf": "lqr"}
    long, short = (Problem(model=PLANE, horizon=N, **weights, **FREE) for N in (200, 8))
    x_ref = CircularReference().states(0.0, 200, 0.2)
    x = x_ref[0] + [0.5, 0.0, -0.5, 1.0]
    wanted = MPC(long).step(x, x_ref).u0
    assert np.abs(MPC(short).step(x, x_ref[:9]).u0 - wanted).max() > 1e-3
    close(MPC(short).step(x, Preview(short, 80).fold(x_ref[:89])).u0, wanted)


def test_the_cost_of_the_plan_is_that_of_going_on_for_ever():
    problem = Problem(model=PLANE, horizon=3, Q=[1, 0, 1, 0], R=[0.1, 0.1], Qf="lqr", **FREE)
    K = lqr_gain(PLANE.A, PLANE.B, problem.Q, problem.R)
    x = start = np.array([1.0, -2.0, 0.5, 3.0])
    total = 0.0
    for _ in range(400):
        u = -K @ x
        x = PLANE.step(x, u)
        total += x @ problem.Q @ x + u @ problem.R @ u
    assert MPC(problem).step(start, np.zeros(4)).cost == pytest.approx(total, rel=1e-12)
    assert start @ problem.Qf @ start == pytest.approx(total + start @ problem.Q @ start)


GOOD = {"A": PLANE.A, "B": PLANE.B, "Q": [1, 1, 1, 1], "R": [1, 1]}
TURN = [[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]]
BAD = {
    "singular R": ({"R": [1, 0]}, "R: smallest eigenvalue 0"),
    "no R": ({"R": [0, 0]}, "R: smallest eigenvalue 0"),
    "idle axis": ({"B": PLANE.B * [1, 0]}, "A: no input reaches its mode 1,"),
    "unstable": ({"A": np.diag([0.5, 1.5, 0.5, 0.5]), "B": np.eye(4)[:, [0, 2]]}, "its mode 1.5"),
    "free position": ({"Q": [0, 1, 0, 1]}, "Q: puts no weight on the mode 1 "),
    "free swing": (
        {"A": TURN, "B": [[1], [0]], "Q": [0, 0], "R": [1]},
        "Q: .*0.955336[+-]0.29",
    ),
    "shape of Q": ({"Q": [1, 1]}, "Q: shape"),
    "shape of R": ({"R": [1]}, "R: shape"),
    "rows of B": ({"B": np.eye(3)}, "B: shape"),
    "A not square": ({"A": np.zeros((4, 3))}, "A: shape"),
    "NaN": ({"A": np.full((4, 4), np.nan)}, "A: nan at index"),
    "indefinite Q": ({"Q": [1, -1, 1, 1]}, "Q: matrix 0 is not positive"),
}


@pytest.mark.parametrize(("changes", "message"), BAD.values(), ids=BAD)
@pytest.mark.parametrize("function", [lqr_weight, lqr_gain])
def test_what_has_no_solution_is_refused(function, changes, message):
    function(**GOOD)
    with pytest.raises(InvalidArgumentError, match=message):
        function(**{**GOOD, **changes})


def test_problem_refuses_what_has_no_solution():
    with pytest.raises(InvalidArgumentError, match="R: smallest eigenvalue 0"):
        Problem(model=PLANE, horizon=3, Q=[1] * 4, R=[0, 0], Qf="lqr", **FREE)
    with pytest.raises(InvalidArgumentError, match="Qf"):
        Problem(model=PLANE, horizon=3, Q=[1] * 4, R=[1, 1], Qf="LQR", **FREE)


def test_other_models_are_told_what_to_pass():
    with pytest.raises(InvalidArgumentError, match=r"Qf: .*lqr_weight\(A, B, Q, R\)"):
        terminal_weight("a unicycle", np.eye(4), np.eye(2))


def test_weights_are_frozen_and_symmetric():
    S = lqr_weight(**GOOD)
    np.testing.assert_array_equal(S, S.T)
    with pytest.raises(ValueError, match="read-only"):
        S[0, 0] = 1.0


def test_previews_refuse_another_weight_and_length():
    weights = {"Q": [1] * 4, "R": [1, 1]}
    with pytest.raises(InvalidArgumentError, match="problem: Qf is not"):
        Preview(Problem(model=PLANE, horizon=3, **weights, **FREE), 5)
    problem = Problem(model=PLANE, horizon=3, **weights, Qf="lqr", **FREE)
    with pytest.raises(InvalidArgumentError, match="rows: 0 is less than 1"):
        Preview(problem, 0)
    with pytest.raises(ShapeError, match="x_ref"):
        Preview(problem, 5).fold(np.zeros((8, 4)))
