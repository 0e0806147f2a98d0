"""Condensing: the program with its dynamics eliminated, against walking and differences."""

import numpy as np
import pytest
from instances import KINDS, S_REF, instance, obstacle, problem, straight_reference
from nonlinear_cases import KINDS as RIDES
from nonlinear_cases import ride

from scp_mpc import SCP, DoubleIntegrator, FunctionModel, LinearModel, Settings, Status, Trajectory
from scp_mpc.scp.condensing import Condenser
from scp_mpc.scp.layout import Layout
from scp_mpc.scp.nodes import Nodes
from scp_mpc.scp.step import Step
from scp_mpc.trajectory import rollout

LONG = {"discs": (-0.3, 0.1, 0.5)}
RATES = {"du_min": -0.5, "du_max": 0.5}
CASES = [
    ("linear", 1, {}),
    ("linear", 4, RATES | {"x_max": [np.inf, 1.9, 0.3, np.inf]}),
    ("unicycle", 1, {}),
    ("unicycle", 4, LONG),
    ("bicycle", 4, LONG | RATES),
    ("planar quadrotor", 4, {}),
    ("quadrotor", 1, {}),
    ("function", 3, {}),
]
H = 1e-6


class Bench:
    """A control step, its condensation, and a plan in its middle."""

    def __init__(self, name, instants, changes, horizon=5):
        changes = {**changes, "nodes_per_interval": instants}
        if name == "linear":
            case = instance("ahead", 8, "exact", S_REF, 0)
            self.problem = problem(horizon, **changes)
            x_ref = straight_reference(horizon)
            obstacles = [obstacle(horizon, (1.0, 0.2))]
        else:
            case = ride(name, RIDES[0], horizon, 0, **changes)
            self.problem, x_ref, obstacles = case.problem, case.x_ref, case.obstacles
        self.model, self.nodes = self.problem.model, Nodes.of(self.problem)
        last = self.model.equilibrium_input if self.problem.limits_rates else None
        self.step = Step.read(
            self.problem, case.x0, x_ref, obstacles, nodes=self.nodes, u_last=last
        )
        self.layout = Layout(self.problem, self.nodes)
        self.condenser = Condenser(self.problem, self.nodes, self.layout)
        self.condenser.begin(self.step)
        self.rng = np.random.default_rng(3)
        self.inputs = self.model.equilibrium_input + 0.4 * self.rng.normal(size=self.layout.shape)
        self.s = np.full(self.problem.max_obstacles, self.problem.size.reference)

    def walked(self, inputs):
        return rollout(self.model.step, self.step.x0, inputs).states

    def outputs(self, inputs, s=None):
        rolled, s = self.condenser.rolled(inputs), self.s if s is None else s
        return self.layout.outputs(self.step, rolled.positions, s, inputs, rolled.deviations)

    def cost(self, inputs, s=None):
        s = self.s if s is None else s
        return self.problem.cost(self.walked(inputs), inputs, s, self.step.x_ref)


@pytest.fixture(params=CASES, ids=lambda case: f"{case[0]}-{case[1]}")
def bench(request):
    return Bench(*request.param)


def test_outputs_follow_from_walking(bench):
    model, states = bench.model, bench.walked(bench.inputs)
    K, points = bench.nodes.instants, []
    for i, u in enumerate(bench.inputs):
        for k in range(1, K + 1):
            x = model.advance(states[i], u, k / K)
            for disc in bench.problem.discs:
                p = x[model.position].copy()
                if model.heading is not None:
                    p += disc * np.array([np.cos(x[model.heading]), np.sin(x[model.heading])])
                points.append(p)
    rolled = bench.condenser.rolled(bench.inputs)
    np.testing.assert_allclose(rolled.positions + bench.step.here, points, atol=1e-11)
    np.testing.assert_allclose(rolled.deviations, states[1:] - bench.step.x_ref[1:], atol=1e-11)
    y, layout = bench.outputs(bench.inputs), bench.layout
    before = np.concatenate([[model.equilibrium_input], bench.inputs[:-1]])
    if bench.problem.limits_rates:
        np.testing.assert_allclose(y[layout.du], (bench.inputs - before).ravel())
    bounded = rolled.deviations[:, bench.problem.bounded_states]
    np.testing.assert_allclose(y[layout.z], bounded.ravel())


@pytest.mark.parametrize("spread", [1e-3, 1e2])
def test_a_guess_does_not_change_where_inputs_lead(bench, spread):
    truth = bench.condenser.rolled(bench.inputs)
    guess = truth.deviations + spread * bench.rng.normal(size=truth.deviations.shape)
    rolled = bench.condenser.rolled(bench.inputs, guess)
    np.testing.assert_allclose(rolled.deviations, truth.deviations, atol=1e-10)
    np.testing.assert_allclose(rolled.along.A[1:], truth.along.A[1:], atol=1e-8)


def test_a_good_guess_needs_no_walk(bench, monkeypatch):
    guess = bench.condenser.rolled(bench.inputs).deviations
    guess += 1e-4 * bench.rng.normal(size=guess.shape)
    monkeypatch.setattr(type(bench.model), "step", None)
    bench.condenser.rolled(bench.inputs, guess)


def test_tracking_is_the_least_costly_way_back_to_a_plan(bench):
    """At its inputs the gradient of what tracking costs has gone, but for second order."""
    away = 1e-4 * bench.rng.normal(size=bench.model.nx)
    plan = rollout(bench.model.step, bench.step.x0 + away, bench.inputs).states
    inputs, deviations = bench.condenser.tracking(plan, bench.inputs)

    def cost(inputs):
        e, push = bench.walked(inputs)[1:] - plan[1:], inputs - bench.inputs
        weights = [bench.problem.Q] * (len(e) - 1) + [bench.problem.Qf]
        effort = np.einsum("ni,ij,nj->", push, bench.problem.R, push)
        return effort + sum(d @ Q @ d for d, Q in zip(e, weights, strict=True))

    def slope(inputs):
        moves = H * np.eye(inputs.size).reshape(-1, *inputs.shape)
        return np.array([cost(inputs + move) - cost(inputs - move) for move in moves]) / (2 * H)

    assert np.abs(slope(inputs)).max() < 0.01 * np.abs(slope(bench.inputs)).max()
    there = bench.walked(inputs)[1:] - bench.step.x_ref[1:]
    np.testing.assert_allclose(deviations, there, atol=1e-5)
    none = bench.condenser.tracking(bench.walked(bench.inputs), bench.inputs)[0]
    np.testing.assert_allclose(none, bench.inputs, atol=1e-9)


def test_sensitivities_are_derivatives(bench):
    rolled = bench.condenser.rolled(bench.inputs)
    condensed = bench.condenser.condensed(rolled, bench.s)
    by, y = condensed.by, bench.outputs(bench.inputs)
    np.testing.assert_allclose(condensed.y(condensed.here), y, atol=1e-9)
    np.testing.assert_allclose(by.bounded, by.S[bench.layout.boxed])
    n = len(by.unbox)
    np.testing.assert_allclose(by.unbox @ by.bounded[:n], np.eye(n), atol=1e-9)
    at_least = condensed.least + condensed.here @ condensed.here / 2
    assert at_least == pytest.approx(bench.cost(bench.inputs))
    for _ in range(3):
        v = bench.rng.normal(size=len(condensed.here))
        v /= np.linalg.norm(v)
        move = H * (by.inverse.T @ v[: bench.inputs.size]).reshape(bench.inputs.shape)
        ahead, behind = bench.inputs + move, bench.inputs - move
        slope = (bench.outputs(ahead) - bench.outputs(behind)) / (2 * H)
        np.testing.assert_allclose(by.S @ v, slope, atol=1e-6)
        fall = (bench.cost(ahead) - bench.cost(behind)) / (2 * H)
        assert condensed.here @ v == pytest.approx(fall, abs=1e-5)
        there = bench.condenser.rolled(ahead).deviations
        np.testing.assert_allclose(condensed.deviations(condensed.here + H * v), there, atol=1e-10)


def test_costates_are_the_adjoint_and_pull_the_transpose(bench):
    rolled = bench.condenser.rolled(bench.inputs)
    along, rng = rolled.along, bench.rng
    pushed, forces = (rng.normal(size=rolled.deviations.shape) for _ in range(2))
    e = np.zeros_like(pushed)
    for i, push in enumerate(pushed):
        e[i] = push + (along.A[i] @ e[i - 1] if i else 0.0)
    np.testing.assert_allclose(along.roll(pushed), e, atol=1e-10)
    both = np.vdot(along.costates(forces), pushed)
    assert both == pytest.approx(np.vdot(forces, along.roll(pushed)))
    phi = rng.normal(size=rolled.positions.size)
    on_e, on_u = along.pull(phi)
    total = along.thrust(along.costates(on_e)) + (0.0 if on_u is None else on_u)
    u = rng.normal(size=bench.inputs.shape)
    ahead, behind = (bench.condenser.rolled(bench.inputs + k * H * u) for k in (1, -1))
    slope = phi @ (ahead.positions - behind.positions).ravel() / (2 * H)
    assert np.vdot(total, u) == pytest.approx(slope, abs=1e-5)
    w = forces
    gradient = along.thrust(along.costates(w))
    change = np.vdot(w, ahead.deviations - behind.deviations) / (2 * H)
    assert np.vdot(gradient, u) == pytest.approx(change, abs=1e-5)


def test_curvature_is_the_second_difference(bench):
    """Of forces' x + phi' p: what condensing leaves out of the Hessian."""
    if bench.condenser.linear:
        pytest.skip("nothing bends")
    rolled, shape = bench.condenser.rolled(bench.inputs), bench.inputs.shape
    forces = bench.rng.normal(size=rolled.deviations.shape)
    phi = bench.rng.normal(size=rolled.positions.size)
    nu = rolled.along.costates(forces + rolled.along.pull(phi)[0])
    states = bench.walked(bench.inputs)
    stages, sway = bench.nodes.curvature(states, bench.inputs, nu, phi)
    G = rolled.along.response.reshape(len(states) - 1, -1, *shape)

    def bent(move):
        """Second derivative along a change of the inputs."""
        e = np.einsum("ixjk,jk->ix", G, move)
        before = np.concatenate([np.zeros((1, e.shape[1])), e[:-1]])
        both = np.concatenate([before, move], axis=1)
        total = np.einsum("ia,iab,ib->", both, stages, both)
        return total + (0 if sway is None else sway @ e[:, bench.model.heading] ** 2)

    def pushed(inputs):
        walked = bench.walked(inputs)
        return np.vdot(forces, walked[1:]) + phi @ bench.nodes.positions(walked, inputs).ravel()

    h, largest = 1e-3, 0.0
    for _ in range(3):
        move = bench.rng.normal(size=shape)
        move /= np.linalg.norm(move)
        ahead, here, behind = (pushed(bench.inputs + k * h * move) for k in (1, 0, -1))
        expected = (ahead - 2 * here + behind) / h**2
        largest = max(largest, abs(expected))
        assert bent(move) == pytest.approx(expected, abs=1e-4 * max(1.0, largest))
    assert largest > 1e-4


# A linear robot is the case in which nothing changes


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
    nodes = Nodes.of(case)
    layout = Layout(case, nodes)
    condenser = Condenser(case, nodes, layout)
    x0, ref = rng.normal(size=model.nx), rng.normal(size=(N + 1, model.nx))
    condenser.begin(Step.read(case, x0, ref, []))
    somewhere = condenser.rolled(rng.normal(size=(N, model.nu)))
    condensed = condenser.condensed(somewhere, rng.uniform(0.5, 3.0, M))

    def cost(v):
        y = condensed.y(v)
        path = rollout(model.step, x0, y[layout.u].reshape(N, model.nu))
        p = y[layout.p].reshape(N, model.dim) + x0[model.position]
        np.testing.assert_allclose(path.states[1:, model.position], p, atol=1e-9)
        e = condensed.deviations(v)
        np.testing.assert_allclose(e, path.states[1:] - ref[1:], atol=1e-9)
        return case.cost(path.states, path.inputs, y[layout.s], ref)

    assert layout.moving == (M if case.margin.lower < case.margin.reference else 0)
    if not layout.moving:  # then they stay where they are said to be
        condensed = condenser.condensed(somewhere, np.full(M, S_REF))
    free = cost(np.zeros(layout.variables))
    assert condensed.least == pytest.approx(free, rel=1e-9)
    for _ in range(5):
        v = rng.normal(size=layout.variables)
        assert cost(v) - free == pytest.approx(v @ v / 2, rel=1e-7)


def test_a_linear_robot_is_condensed_once_and_is_the_same_about_any_plan():
    bench = Bench(*CASES[1])
    ends = [
        bench.condenser.condensed(bench.condenser.rolled(inputs), bench.s)
        for inputs in (bench.inputs, 0 * bench.inputs)
    ]
    assert ends[0].by is ends[1].by
    np.testing.assert_allclose(ends[0].y_free, ends[1].y_free, atol=1e-9)
    assert ends[0].least == pytest.approx(ends[1].least)


@pytest.mark.parametrize("instants", [1, 3])
def test_a_function_that_is_linear_has_the_same_sensitivities(instants):
    linear = DoubleIntegrator(0.2)

    def rates(x, u):
        return np.stack([x[..., 1], u[..., 0], x[..., 3], u[..., 1]], axis=-1)

    twin = FunctionModel(rates, "complex", nx=4, nu=2, dt=0.2, position=[0, 2], vectorised=True)
    changes = RATES | {"x_max": [np.inf, 1.9, 0.3, np.inf], "nodes_per_interval": instants}
    rng, found = np.random.default_rng(0), []
    inputs, s = rng.normal(size=(6, 2)), np.array([1.7])
    for model in (linear, twin):
        case = problem(6, "exact", 0.5, model=model, **changes)
        nodes = Nodes.of(case)
        condenser = Condenser(case, nodes, Layout(case, nodes))
        ref = straight_reference(6)
        condenser.begin(Step.read(case, ref[0] + 0.1, ref, [], u_last=np.zeros(2)))
        assert condenser.linear == (model is linear)
        found.append(condenser.condensed(condenser.rolled(inputs), s))
    mine, theirs = found
    for name in ("y_free", "here"):
        np.testing.assert_allclose(getattr(mine, name), getattr(theirs, name), atol=1e-9)
    for name in ("G", "weighed", "inverse", "S", "bounded", "unbox"):
        a, b = getattr(mine.by, name), getattr(theirs.by, name)
        np.testing.assert_allclose(a, b, atol=1e-9 * max(1.0, np.abs(a).max()), err_msg=name)
    assert mine.least == pytest.approx(theirs.least)


def test_without_an_input_weight_there_may_be_no_unique_input():
    """A second input that does nothing and costs nothing: there is an answer all the same."""
    model = DoubleIntegrator(0.2)
    B = np.column_stack([model.B, np.zeros(4)])
    idle = LinearModel(model.A, B, 0.2, model.position)
    ref, there = straight_reference(8), [obstacle(8, (1.5, 0.1))]
    plan = SCP(problem(8, model=idle, R=[0.001, 0.001, 0.0])).solve(np.zeros(4), ref, there)
    assert plan.ok
    other = SCP(problem(8)).solve(np.zeros(4), ref, there)
    assert plan.cost == pytest.approx(other.cost, rel=1e-6)


def unstable(horizon, max_obstacles):
    A = np.array([[1.6, 0.2], [0.0, 1.5]])
    model = LinearModel(np.kron(np.eye(2), A), np.kron(np.eye(2), [[0.02], [0.2]]), 0.2, [0, 2])
    changes = {"Q": [1.0, 0.1] * 2, "R": [0.1, 0.1], "u_min": -50.0, "u_max": 50.0}
    return problem(horizon, max_obstacles=max_obstacles, model=model, **changes)


@pytest.mark.parametrize("horizon", [30, 80])
@pytest.mark.parametrize("max_obstacles", [0, 1])
def test_a_plant_too_unstable_to_roll_out_is_survived(horizon, max_obstacles):
    """At 1.6^30 the roll-out hardly certifies any more, at 1.6^80 there is nothing to condense."""
    case = unstable(horizon, max_obstacles)
    plan = SCP(case).solve(np.array([0.1, 0.0, 0.1, 0.0]), np.zeros(4))
    assert np.isfinite(plan.u0).all()
    assert (np.abs(plan.u0) <= 50.0).all()
    assert not plan.status.certified or plan.kkt.worst <= 1e-6


# The whole solver


@pytest.mark.parametrize("inflation", ["exact", "axes"])
@pytest.mark.parametrize("s_min", [S_REF, 0.5])
@pytest.mark.parametrize("kind", KINDS)
def test_from_the_end_of_one_solver_another_does_not_move(kind, s_min, inflation):
    """Same plan, same forces."""
    case = instance(kind, 20, inflation, s_min, 0)
    guess = Trajectory(case.x_ref, np.zeros((20, 2)))
    given = case.x0, case.x_ref, case.obstacles
    plan = SCP(case.problem, Settings(multi_start=False)).solve(*given, guess)
    other = Settings(multi_start=False, solver="piqp", max_iterations=300)
    again = SCP(case.problem, other).solve(*given, plan.iterate)
    assert plan.status is again.status is Status.CONVERGED
    assert again.cost == pytest.approx(plan.cost, rel=1e-6)
    np.testing.assert_allclose(again.X, plan.X, atol=2e-3)
    for name in ("obstacles", "inputs", "margin", "dynamics"):
        mine, theirs = getattr(plan.multipliers, name), getattr(again.multipliers, name)
        np.testing.assert_allclose(mine, theirs, atol=1e-3 * (1 + np.abs(theirs).max()))


def test_a_candidates_merit_bounds_the_cost_of_its_first_program():
    """Far from the reference, where the plan without constraints is dear already."""
    case, ref = problem(20), straight_reference(20)
    x0 = ref[0] + [-1.0, 0.5, 0.4, -0.5]
    blocking = [obstacle(20, (3.0, 0.1), (0.5, 0.0))]
    plan = SCP(case).solve(x0, ref, blocking)
    free = SCP(case).solve(x0, ref)
    merits = [candidate.merit for candidate in plan.candidates]
    assert free.cost > 0.5
    # The best way's first program is a little above where its descent ends; none is below free.
    assert free.cost * (1 - 1e-9) <= min(merits) < 1.5 * plan.cost
