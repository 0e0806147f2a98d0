"""Models: discretisation, derivatives, and what the solver asks of every robot."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from models import DT, MODELS, OWN, draw, unicycle_rates
from scipy.integrate import solve_ivp
from scipy.special import spherical_jn

from scp_mpc.models import (
    DoubleIntegrator,
    KinematicBicycle,
    Model,
    PlanarQuadrotor,
    Quadrotor,
    Unicycle,
)
from scp_mpc.models.bessel import bessel, bessel_pair

every = pytest.mark.parametrize("name", MODELS)
seeds = st.integers(0, 2**32 - 1)


def flow(rates, x, u, time):
    """The state after a time, by an integrator of high order."""
    solution = solve_ivp(
        lambda _, x: rates(x, u), (0, time), x, method="DOP853", rtol=1e-12, atol=1e-13
    )
    return solution.y[:, -1]


@pytest.mark.parametrize("omega", [0.0, 1e-12, -1e-6, 1e-3, 0.3, -2.0, 9.0, -40.0])
def test_the_unicycle_is_exact(omega):
    x, u = np.array([1.0, -2.0, 0.7, -1.5]), np.array([-2.0, omega])
    expected = flow(unicycle_rates, x, u, DT)
    model = Unicycle(DT)
    np.testing.assert_allclose(model.advance(x, u), expected, atol=1e-10)
    np.testing.assert_allclose(model.step(x, u), expected, atol=1e-10)
    model.check(x, u)
    y = np.array([0.3, -1.2, 2.0, 0.5])
    bent = Model.curvature(model, x, u, y)
    np.testing.assert_allclose(model.curvature(x, u, y), bent, atol=1e-7)


@pytest.mark.parametrize("which", [lambda dt, n: KinematicBicycle(dt, 2.5, 1.2, n),
                                   lambda dt, n: PlanarQuadrotor(dt, substeps=n),
                                   lambda dt, n: Quadrotor(dt, substeps=n)])  # fmt: skip
def test_runge_kutta_is_of_fourth_order(which):
    coarse, fine = which(0.4, 2), which(0.4, 4)
    x, u = draw(coarse, np.random.default_rng(3))
    u[0] += 1.0
    expected = flow(coarse.derivative, x, u, 0.4)
    errors = [np.abs(model.advance(x, u) - expected).max() for model in (coarse, fine)]
    assert errors[0] < 1e-3
    assert 3.5 < np.log2(errors[0] / errors[1]) < 5.5


def test_bessel_functions_are_scipys():
    mu = np.concatenate([np.linspace(-40, 40, 999), [0.0], np.geomspace(1e-12, 2, 300)])
    for n, found in enumerate(bessel(mu.reshape(2, -1))):
        expected = np.where(mu < 0, (-1) ** n, 1) * spherical_jn(n, np.abs(mu))
        np.testing.assert_allclose(found.ravel(), expected, rtol=0, atol=1e-13)
    pairs = np.array([bessel_pair(value) for value in mu])
    np.testing.assert_allclose(pairs.T, bessel(mu)[:2], rtol=0, atol=1e-13)


@every
@settings(max_examples=20, deadline=None)
@given(seed=seeds)
def test_derivatives_are_those_of_differences(name, seed):
    model, rng = MODELS[name], np.random.default_rng(seed)
    x, u = draw(model, rng, (3,))
    model.check(x, u)
    there = model.linearise(x, u)
    np.testing.assert_array_equal(there.after, model.advance(x, u))


@every
@settings(max_examples=10, deadline=None)
@given(seed=seeds)
def test_derivatives_within_an_interval(name, seed):
    model, rng = MODELS[name], np.random.default_rng(seed)
    x, u = draw(model, rng)
    fraction = float(rng.choice([0.1, 0.5, 0.85]))
    dx, du = (rng.normal(size=n) for n in (model.nx, model.nu))
    there, h = model.linearise(x, u, fraction), 1e-5
    ahead = model.advance(x + h * dx, u + h * du, fraction)
    behind = model.advance(x - h * dx, u - h * du, fraction)
    np.testing.assert_allclose(there.A @ dx + there.B @ du, (ahead - behind) / (2 * h), atol=1e-7)


@every
@settings(max_examples=10, deadline=None)
@given(seed=seeds)
def test_curvature_is_that_of_differences(name, seed):
    model, rng = MODELS[name], np.random.default_rng(seed)
    x, u = draw(model, rng, (2, 3))
    y = rng.normal(size=x.shape)
    found = model.curvature(x, u, y)
    np.testing.assert_allclose(found, np.swapaxes(found, -2, -1), atol=1e-13)
    tolerance = 1e-3 if "central" in name else 1e-6
    np.testing.assert_allclose(found, Model.curvature(model, x, u, y), atol=tolerance)
    alone = model.curvature(x[1, 2], u[1, 2], y[1, 2])
    np.testing.assert_allclose(found[1, 2], alone, atol=tolerance)


@every
def test_batched_is_one_by_one(name):
    model, rng = MODELS[name], np.random.default_rng(5)
    x, u = draw(model, rng, (7,))
    before = x.copy(), u.copy()
    fractions = np.array([0.25, 0.5, 1.0])[:, None]
    batch = model.linearise(x, u, fractions)
    assert batch.A.shape == (3, 7, model.nx, model.nx)
    assert batch.B.shape == (3, 7, model.nx, model.nu)
    np.testing.assert_allclose(batch.after, model.advance(x, u, fractions), atol=1e-14)
    for i in range(7):
        np.testing.assert_allclose(model.step(x[i], u[i]), model.advance(x, u)[i], atol=1e-13)
        for j, fraction in enumerate(fractions.ravel()):
            alone = model.linearise(x[i], u[i], float(fraction))
            for part in ("after", "A", "B"):
                np.testing.assert_allclose(
                    getattr(alone, part), getattr(batch, part)[j, i], atol=1e-12
                )
    np.testing.assert_allclose(batch.after[2], model.advance(x, u), atol=1e-14)
    np.testing.assert_array_equal(x, before[0])
    np.testing.assert_array_equal(u, before[1])
    one = model.linearise(x, u[0]).after
    np.testing.assert_allclose(one[3], model.step(x[3], u[0]), atol=1e-13)


@pytest.mark.parametrize(("name", "tolerance"), [
    ("double integrator", 1e-13), ("unicycle", 1e-13), ("bicycle", 1e-5),
    ("planar quadrotor", 1e-4), ("quadrotor", 1e-4)])  # fmt: skip
def test_shares_of_an_interval_compose(name, tolerance):
    model = MODELS[name]
    x, u = draw(model, np.random.default_rng(1), (5,))
    parts = model.advance(model.advance(x, u, 0.25), u, 0.75)
    np.testing.assert_allclose(parts, model.advance(x, u), atol=tolerance)
    np.testing.assert_allclose(model.advance(x, u, 0.0), x, atol=1e-14)


@every
@settings(max_examples=10, deadline=None)
@given(seed=seeds)
def test_the_brake_brings_the_position_to_rest(name, seed):
    model = MODELS[name]
    x, _ = draw(model, np.random.default_rng(seed))
    slow = "quadrotor" in name
    for _ in range(200 if slow else 1):
        x = model.step(x, model.stopping_input(x))
    drift = model.step(x, model.equilibrium_input) - x
    np.testing.assert_allclose(drift[model.position], 0.0, atol=1e-4 if slow else 1e-8)


@every
@settings(max_examples=10, deadline=None)
@given(seed=seeds)
def test_states_stand_there_and_move_so(name, seed):
    model, rng = MODELS[name], np.random.default_rng(seed)
    position, velocity = rng.uniform(-2, 2, (2, 3, 6, model.dim))
    states = model.state(position, velocity)
    assert states.shape == (3, 6, model.nx)
    np.testing.assert_array_equal(states[..., model.position], position)
    ahead = model.advance(states, model.equilibrium_input, 1e-5)[..., model.position]
    moved = (ahead - position) / (1e-5 * DT)
    np.testing.assert_allclose(moved, velocity, atol=1e-4)
    alone = model.state(position[0, 0], velocity[0, 0])
    moved = (
        model.advance(alone, model.equilibrium_input, 1e-5)[model.position] - position[0, 0]
    ) / (1e-5 * DT)
    np.testing.assert_allclose(moved, velocity[0, 0], atol=1e-4)


@pytest.mark.parametrize("name", ["unicycle", "bicycle", "function"])
def test_headings_do_not_jump_and_stay_without_speed(name):
    model = MODELS[name]
    assert model.heading == 2
    angle = np.linspace(0, 9, 30)
    velocity = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    theta = model.state(np.zeros((30, 2)), velocity)[:, 2]
    np.testing.assert_allclose(theta, angle, atol=1e-12)
    velocity[[0, 1, 7, 8, 29]] = 0.0
    theta = model.state(np.zeros((30, 2)), velocity)[:, 2]
    expected = angle.copy()
    expected[:2], expected[7:9], expected[29] = angle[2], angle[6], angle[28]
    np.testing.assert_allclose(theta, expected, atol=1e-12)
    still = model.state(np.ones((5, 2)), np.zeros((5, 2)))
    np.testing.assert_array_equal(still[:, 2:], 0.0)


@pytest.mark.parametrize("rear", [0.0, 1.25])
def test_the_bicycle_drives_the_circle_of_its_reference(rear):
    model = KinematicBicycle(DT, 2.5, rear=rear, substeps=8)
    angle = 0.3 * DT * np.arange(20)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    states = model.state(8 * ring, 2.4 * np.stack([-ring[:, 1], ring[:, 0]], axis=-1))
    np.testing.assert_allclose(
        model.advance(states[:-1], model.equilibrium_input), states[1:], atol=1e-8
    )


@pytest.mark.parametrize("name", OWN)
def test_only_planar_robots_with_a_nose_have_a_heading(name):
    model = MODELS[name]
    assert model.heading == (None if "quadrotor" in name else 2)
    assert not model.equilibrium_input.flags.writeable
    assert not model.position.flags.writeable
    still = np.zeros(model.nx)
    np.testing.assert_allclose(model.step(still, model.equilibrium_input), still, atol=1e-15)


@pytest.mark.parametrize(("name", "start", "share"), [
    ("planar quadrotor", 3, 12), ("quadrotor", 3, 10)])  # fmt: skip
def test_a_brake_thrusts_by_what_its_axis_has_of_the_wanted_force(name, start, share):
    model = MODELS[name]
    x, _ = draw(model, np.random.default_rng(9))
    x[start : start + model.dim] *= 0.5
    still = np.zeros(model.nu)
    one = np.eye(model.nu)[0]
    velocity = slice(start, start + model.dim)
    axis = (model.derivative(x, one) - model.derivative(x, still))[velocity]
    force = -x[velocity] / (share * DT) - model.derivative(x, still)[velocity]
    assert model.stopping_input(x)[0] == pytest.approx(axis @ force)
    far = x.copy()
    far[velocity] = 50.0
    assert np.isfinite(model.stopping_input(far)).all()
    if name == "quadrotor":
        assert model.derivative(x, model.stopping_input(x))[8] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(
    "model", [DoubleIntegrator, Unicycle, KinematicBicycle, PlanarQuadrotor, Quadrotor]
)
def test_a_robot_says_which_state_and_input_is_which(model):
    assert re.search(r"^ +x = \[.*\] .*\[m\]", model.__doc__, flags=re.MULTILINE)
    assert re.search(r"^ +u = \[.*\] ", model.__doc__, flags=re.MULTILINE)
