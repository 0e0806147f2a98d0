"""The chart of a nonlinear robot about a plan, against differences of the rolled-out problem."""

import numpy as np
import pytest
from machines import KINDS, ride

from scp_mpc.solver.active_set import ActiveSetSolver, CondensedProgram
from scp_mpc.solver.curvature import bent_program, newton_step, summed
from scp_mpc.solver.sampling import Sampling
from scp_mpc.solver.step_data import StepData
from scp_mpc.solver.varying import Varying
from scp_mpc.trajectory import rollout

LONG = {"discs": (-0.3, 0.1, 0.5)}
CASES = [
    ("unicycle", 1, {}),
    ("unicycle", 4, LONG),
    ("bicycle", 4, LONG | {"du_min": -0.5, "du_max": 0.5}),
    ("planar quadrotor", 4, {}),
    ("quadrotor", 1, {}),
]
H = 1e-6


class Bench:
    """A control step, its condensation, and a plan in its middle."""

    def __init__(self, name, instants, changes, horizon=5):
        case = ride(name, KINDS[0], horizon, 0, **changes)
        self.problem, self.model = case.problem, case.problem.model
        sampling = Sampling.of(self.problem, instants)
        self.step = StepData.read(
            self.problem,
            case.x0,
            case.x_ref,
            case.obstacles,
            None,
            sampling,
            self.model.idle if "du_min" in changes else None,
        )
        self.varying = Varying(self.problem, sampling)
        self.varying.begin(self.step)
        self.rng = np.random.default_rng(3)
        self.inputs = self.model.idle + 0.4 * self.rng.normal(size=self.varying.layout.shape)
        self.s = np.array([self.problem.size.reference])

    def walked(self, inputs):
        return rollout(self.model.step, self.step.x0, inputs).states

    def outputs(self, inputs):
        rolled = self.varying.rolled(inputs)
        layout = self.varying.layout
        return layout.outputs(self.step, rolled.positions, self.s, inputs, rolled.deviations)

    def cost(self, inputs):
        return self.problem.cost(self.walked(inputs), inputs, self.s, self.step.x_ref)


@pytest.fixture(params=CASES, ids=lambda case: f"{case[0]}-{case[1]}")
def bench(request):
    return Bench(*request.param)


def test_outputs_follow_from_walking(bench):
    model, states = bench.model, bench.walked(bench.inputs)
    K = bench.varying.sampling.instants
    points = []
    for i, u in enumerate(bench.inputs):
        for k in range(1, K + 1):
            x = model.advance(states[i], u, k / K)
            for disc in bench.problem.discs:
                p = x[model.position].copy()
                if model.heading is not None:
                    p += disc * np.array([np.cos(x[model.heading]), np.sin(x[model.heading])])
                points.append(p)
    rolled = bench.varying.rolled(bench.inputs)
    np.testing.assert_allclose(rolled.positions + bench.step.track[1:], points, atol=1e-11)
    np.testing.assert_allclose(rolled.deviations, states[1:] - bench.step.x_ref[1:], atol=1e-11)
    y, layout = bench.outputs(bench.inputs), bench.varying.layout
    before = np.concatenate([[model.idle], bench.inputs[:-1]])
    if bench.problem.limits_rates:
        np.testing.assert_allclose(y[layout.du], (bench.inputs - before).ravel())
    bounded = rolled.deviations[:, bench.problem.bounded_states]
    np.testing.assert_allclose(y[layout.z], bounded.ravel())


@pytest.mark.parametrize("spread", [1e-3, 1e2])
def test_a_guess_does_not_change_where_inputs_lead(bench, spread):
    truth = bench.varying.rolled(bench.inputs)
    guess = truth.deviations + spread * bench.rng.normal(size=truth.deviations.shape)
    rolled = bench.varying.rolled(bench.inputs, guess)
    np.testing.assert_allclose(rolled.deviations, truth.deviations, atol=1e-10)
    np.testing.assert_allclose(rolled.motion.A[1:], truth.motion.A[1:], atol=1e-8)


def test_chart_is_the_derivative(bench):
    rolled = bench.varying.rolled(bench.inputs)
    chart = bench.varying.chart(rolled, bench.s)
    y = bench.outputs(bench.inputs)
    np.testing.assert_allclose(chart.y(chart.here), y, atol=1e-9)
    np.testing.assert_allclose(chart.boxed, chart.response[bench.varying.layout.boxed])
    assert chart.least + chart.here @ chart.here / 2 == pytest.approx(bench.cost(bench.inputs))
    for _ in range(3):
        v = bench.rng.normal(size=len(chart.here))
        v /= np.linalg.norm(v)
        move = H * (chart.back @ v).reshape(bench.inputs.shape)
        ahead, behind = bench.inputs + move, bench.inputs - move
        slope = (bench.outputs(ahead) - bench.outputs(behind)) / (2 * H)
        np.testing.assert_allclose(chart.response @ v, slope, atol=1e-6)
        fall = (bench.cost(ahead) - bench.cost(behind)) / (2 * H)
        assert chart.here @ v == pytest.approx(fall, abs=1e-5)
        there = bench.varying.rolled(ahead).deviations
        np.testing.assert_allclose(chart.guess(chart.here + H * v), there, atol=1e-10)


def test_curvature_is_the_second_difference(bench):
    """Of forces' x + phi' p: what the chart's Gauss-Newton Hessian I leaves out is W."""
    rolled = bench.varying.rolled(bench.inputs)
    chart = bench.varying.chart(rolled, bench.s)
    forces = bench.rng.normal(size=rolled.deviations.shape)
    sampling = bench.varying.sampling
    phi = bench.rng.normal(size=rolled.positions.size)
    nu = rolled.motion.costates(forces + rolled.motion.pull(phi)[0])
    states = bench.walked(bench.inputs)
    bends = sampling.curvature(states, bench.inputs, nu, phi)
    W = chart.curvature(*bends, bench.model.heading)
    np.testing.assert_allclose(W, W.T, atol=1e-9)

    def pushed(inputs):
        walked = bench.walked(inputs)
        return np.vdot(forces, walked[1:]) + phi @ sampling.positions(walked, inputs).ravel()

    h = 1e-3
    for _ in range(3):
        v = bench.rng.normal(size=len(chart.here))
        v /= np.linalg.norm(v)
        move = h * (chart.back @ v).reshape(bench.inputs.shape)
        ahead, here, behind = (pushed(bench.inputs + k * move) for k in (1, 0, -1))
        bent = (ahead - 2 * here + behind) / h**2
        assert v @ W @ v == pytest.approx(bent, abs=1e-4 * max(1.0, np.abs(W).max()))
    assert np.abs(W).max() > 1e-3


def test_costates_are_the_adjoint_and_pull_the_transpose(bench):
    rolled = bench.varying.rolled(bench.inputs)
    motion, rng = rolled.motion, bench.rng
    pushed, forces = (rng.normal(size=rolled.deviations.shape) for _ in range(2))
    e = np.zeros_like(pushed)
    for i, push in enumerate(pushed):
        e[i] = push + (motion.A[i] @ e[i - 1] if i else 0.0)
    np.testing.assert_allclose(motion.roll(pushed), e, atol=1e-10)
    both = np.vdot(motion.costates(forces), pushed)
    assert both == pytest.approx(np.vdot(forces, motion.roll(pushed)))
    phi = rng.normal(size=rolled.positions.size)
    on_e, on_u = motion.pull(phi)
    total = motion.thrust(motion.costates(on_e)) + (0.0 if on_u is None else on_u)
    u = rng.normal(size=bench.inputs.shape)
    ahead, behind = (bench.varying.rolled(bench.inputs + k * H * u).positions for k in (1, -1))
    slope = phi @ (ahead - behind).ravel() / (2 * H)
    assert np.vdot(total, u) == pytest.approx(slope, abs=1e-5)


def program(rng, n=8, k=3):
    A = rng.normal(size=(k, n))
    p = CondensedProgram(np.eye(n), np.full(n, -1e3), np.full(n, 1e3), A, np.ones(k))
    guess = np.concatenate([np.zeros(n, int), -np.ones(k, int)])
    return p, ActiveSetSolver(n).solve(p, guess)


@pytest.mark.parametrize("seed", range(4))
def test_newton_step_solves_the_kkt_system(seed):
    rng = np.random.default_rng(seed)
    _, held = program(rng)
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


@pytest.mark.parametrize("shift", [0.0, -0.9, -3.0])
def test_bent_program_has_the_bent_hessian(shift):
    rng = np.random.default_rng(5)
    p, _ = program(rng)
    W, here = rng.normal(size=(8, 8)), rng.normal(size=8)
    W = 0.1 * (W + W.T) + shift * np.eye(8)
    bent, centre, root = bent_program(p, here, W)
    values, vectors = np.linalg.eigh(np.eye(8) + W)
    if values[0] <= 0:
        values = np.maximum(np.abs(values), 0.1)
    hessian = vectors * values @ vectors.T
    np.testing.assert_allclose(root.T @ hessian @ root, np.eye(8), atol=1e-9)
    np.testing.assert_allclose(hessian @ (centre - here), -here, atol=1e-9)
    w = rng.normal(size=8)
    v = centre + root @ w
    np.testing.assert_allclose(bent.A @ w - bent.b, p.A @ v - p.b, atol=1e-9)
    np.testing.assert_allclose(bent.F @ w - bent.lower, p.F @ v - p.lower, atol=1e-9)
    np.testing.assert_allclose(bent.upper - bent.F @ w, p.upper - p.F @ v, atol=1e-9)


def test_a_good_guess_needs_no_walk(bench, monkeypatch):
    guess = bench.varying.rolled(bench.inputs).deviations
    guess += 1e-4 * bench.rng.normal(size=guess.shape)
    monkeypatch.setattr(type(bench.model), "step", None)
    bench.varying.rolled(bench.inputs, guess)
