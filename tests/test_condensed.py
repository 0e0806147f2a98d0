"""The condensed problem: the sparse one with its dynamics eliminated, and nothing else."""

import numpy as np
import pytest
from instances import KINDS, S_REF, instance, obstacle, problem, straight_reference

from scp_mpc import SCP, DoubleIntegrator, LinearModel, QPSettings, Settings, Status, Trajectory
from scp_mpc.solver.condensed import Condensed
from scp_mpc.solver.layout import Layout
from scp_mpc.solver.sampling import LinearSampling
from scp_mpc.solver.step_data import StepData
from scp_mpc.trajectory import rollout

SPARSE = Settings(
    multi_start=False, condense=False, qp=QPSettings(accuracy=1e-9), max_iterations=300
)


def spaces():
    """A planar and a spatial problem; the latter with full weights and sizes that move."""
    rng = np.random.default_rng(0)
    G = rng.normal(size=(6, 6))
    return [
        problem(7),
        problem(
            6,
            "exact",
            0.5,
            2,
            model=DoubleIntegrator(0.1, dim=3),
            Q=G @ G.T,
            Qf=np.diag(rng.uniform(1, 2, 6)),
            R=[0.1, 0.2, 0.3],
        ),
    ]


@pytest.mark.parametrize("case", spaces(), ids=["plane", "space"])
def test_every_v_obeys_the_dynamics_and_costs_half_its_square_more(case):
    rng = np.random.default_rng(1)
    model, N, M = case.model, case.horizon, case.max_obstacles
    c, y = Condensed(case), Layout(case, LinearSampling(model, N, 1))
    x0, ref = rng.normal(size=model.nx), rng.normal(size=(N + 1, model.nx))
    c.begin(StepData.read(case, x0, ref, []))
    chart = c.chart()

    def cost(v):
        outputs = chart.y(v)
        path = rollout(model.step, x0, outputs[y.u].reshape(N, model.nu))
        p = outputs[y.p].reshape(N, model.dim) + ref[1:, model.position]
        np.testing.assert_allclose(path.states[1:, model.position], p, atol=1e-9)
        e = c.rolled(path.inputs).deviations
        np.testing.assert_allclose(e, path.states[1:] - ref[1:], atol=1e-9)
        return case.cost(path.states, path.inputs, outputs[y.s], ref)

    assert y.moving == (M if case.margin.lower < case.margin.reference else 0)
    free = cost(np.zeros(y.variables))
    assert chart.least == pytest.approx(free, rel=1e-9)
    for _ in range(5):
        v = rng.normal(size=y.variables)
        assert cost(v) - free == pytest.approx(v @ v / 2, rel=1e-7)


def test_costates_are_the_adjoint_of_the_rollout():
    """d (w'e) / d u = B' nu where D' nu = w, by finite differences of the rollout."""
    rng = np.random.default_rng(2)
    case = problem(6)
    c = Condensed(case)
    c.begin(StepData.read(case, rng.normal(size=4), rng.normal(size=(7, 4)), []))
    w, u = rng.normal(size=(6, 4)), rng.normal(size=(6, 2))
    motion = c.rolled(u).motion
    gradient = motion.thrust(motion.costates(w))
    for i, k in np.ndindex(6, 2):
        step = np.zeros((6, 2))
        step[i, k] = 1.0
        e = [c.rolled(u + sign * step).deviations for sign in (1, -1)]
        change = np.vdot(w, e[0] - e[1]) / 2
        assert gradient[i, k] == pytest.approx(change, abs=1e-9)


def test_without_an_input_weight_there_may_be_no_condensed_problem():
    """A second input that does nothing and costs nothing: the sparse way still has an answer."""
    model = DoubleIntegrator(0.2)
    B = np.column_stack([model.B, np.zeros(4)])
    idle = LinearModel(model.A, B, 0.2, model.position)
    case = problem(8, model=idle, R=[0.001, 0.001, 0.0])
    solver = SCP(case)
    assert not solver._resolution.coarse.condenses
    plan = solver.solve(np.zeros(4), straight_reference(8), [obstacle(8, (1.5, 0.1))])
    assert plan.ok


@pytest.mark.parametrize("inflation", ["exact", "axes"])
@pytest.mark.parametrize("s_min", [S_REF, 0.5])
@pytest.mark.parametrize("kind", KINDS)
def test_the_condensed_and_the_sparse_descent_end_in_plans_of_equal_standing(
    kind, s_min, inflation
):
    """From the end of one the other does not move: same plan, same forces."""
    case = instance(kind, 20, inflation, s_min, 0)
    fast = SCP(case.problem, Settings(multi_start=False))
    guess = Trajectory(case.x_ref, np.zeros((20, 2)))
    plan = fast.solve(case.x0, case.x_ref, case.obstacles, guess)
    assert set(plan.qps) <= {"kkt", "daqp"}
    slow = SCP(case.problem, SPARSE).solve(case.x0, case.x_ref, case.obstacles, plan.iterate)
    assert plan.status is slow.status is Status.CONVERGED
    assert slow.cost == pytest.approx(plan.cost, rel=1e-6)
    np.testing.assert_allclose(slow.X, plan.X, atol=2e-3)
    for name in ("obstacles", "inputs", "margin", "dynamics"):
        mine, theirs = getattr(plan.multipliers, name), getattr(slow.multipliers, name)
        np.testing.assert_allclose(mine, theirs, atol=1e-3 * (1 + np.abs(theirs).max()))


def unstable(horizon, max_obstacles):
    A = np.array([[1.6, 0.2], [0.0, 1.5]])
    model = LinearModel(np.kron(np.eye(2), A), np.kron(np.eye(2), [[0.02], [0.2]]), 0.2, [0, 2])
    changes = {"Q": [1.0, 0.1] * 2, "R": [0.1, 0.1], "u_min": -50.0, "u_max": 50.0}
    return problem(horizon, max_obstacles=max_obstacles, model=model, **changes)


@pytest.mark.parametrize("horizon", [30, 80])
@pytest.mark.parametrize("max_obstacles", [0, 1])
def test_a_plant_too_unstable_to_roll_out_is_left_to_the_sparse_program(horizon, max_obstacles):
    """At 1.6^30 the roll-out does not certify any more, at 1.6^80 there is no condensed problem."""
    case = unstable(horizon, max_obstacles)
    assert SCP(case)._resolution.coarse.condenses == (horizon == 30)
    plan = SCP(case).solve(np.array([0.1, 0.0, 0.1, 0.0]), np.zeros(4))
    assert set(plan.qps) & {"osqp", "piqp"}
    assert np.isfinite(plan.u0).all()


def test_a_candidates_merit_is_the_cost_of_its_first_program():
    """Far from the reference, where the plan without constraints is dear already."""
    case, ref = problem(20), straight_reference(20)
    x0 = ref[0] + [-1.0, 0.5, 0.4, -0.5]
    blocking = [obstacle(20, (3.0, 0.1), (0.5, 0.0))]
    plan = SCP(case).solve(x0, ref, blocking)
    free = SCP(case).solve(x0, ref)
    merits = [candidate.merit for candidate in plan.candidates]
    assert free.cost > 0.5
    # The best way's first program is a little above where its descent ends; none is below free.
    assert plan.cost * (1 - 1e-9) <= min(merits) < 1.5 * plan.cost
    assert min(merits) >= free.cost
