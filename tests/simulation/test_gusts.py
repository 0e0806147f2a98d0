"""What disturbs the robot in simulation: gusts, pushes, actuators."""

import numpy as np
import pytest

from scp_mpc import BoundsError, DoubleIntegrator, ShapeError
from scp_mpc.simulation import (
    SCENARIOS,
    ActuatorLag,
    ConstantPush,
    CorrelatedDisturbance,
    DrydenGust,
)


def pushes(disturbance, steps, model=None, seed=0, inputs=None):
    model = DoubleIntegrator(0.2) if model is None else model
    push = disturbance.begin(model, np.random.default_rng(seed))
    inputs = np.zeros((steps, model.nu)) if inputs is None else inputs
    return np.array([push(u) for u in inputs])


def gusts_of(gust, steps, dt, dim=2, seed=0):
    """Gust velocities (steps, d) [m/s], read off the velocities."""
    model = DoubleIntegrator(dt, dim)
    return pushes(gust, steps, model, seed)[:, 1::2] / (dt * gust.drag)


def drydens(lag, T):
    """Correlation over so many seconds: the transforms of the spectra, along and across."""
    return np.exp(-lag / T) * np.array([1.0, 1 - lag / T[1] / 2, 1 - lag / T[2] / 2])


@pytest.mark.parametrize("dt", [0.05, 0.2, 1.0])
def test_filters_have_drydens_correlation_whatever_the_time_step(dt):
    gust = DrydenGust(np.array([1.5, 0.8, 0.6]), np.array([10.0, 8.0, 4.0]), airspeed=5.0)
    for steps in (0, 1, 3):
        found = []
        for axis in range(3):
            F, noise, root, h = gust._filter(axis, dt)
            settled = root @ root.T
            np.testing.assert_allclose(F @ settled @ F.T + noise @ noise.T, settled, atol=1e-12)
            found.append(h @ np.linalg.matrix_power(F, steps) @ settled @ h / gust.sigma[axis] ** 2)
        expected = drydens(steps * dt, gust.length / gust.airspeed)
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_gusts_are_what_the_filters_say():
    gust = DrydenGust(np.array([1.5, 0.8, 0.6]), np.array([10.0, 8.0, 4.0]), airspeed=5.0)
    v = gusts_of(gust, 20_000, 1.0, dim=3)
    for lag in (0, 1):
        found = (v[lag:] * v[: len(v) - lag]).mean(axis=0) / gust.sigma**2
        expected = drydens(float(lag), gust.length / gust.airspeed)
        np.testing.assert_allclose(found, expected, atol=0.06)
    np.testing.assert_allclose(np.corrcoef(v.T), np.eye(3), atol=0.05)


def test_gusts_start_as_they_go_on():
    gust = DrydenGust(np.array([1.0, 2.0]), np.array([30.0, 30.0]))
    first = np.array([gusts_of(gust, 1, 0.2, seed=seed)[0] for seed in range(400)])
    np.testing.assert_allclose(first.std(axis=0), [1.0, 2.0], rtol=0.12)


def test_low_altitude_is_the_standards():
    """At 20 feet: L_w = 20 ft, L_u = 20 / (0.177 + 0.01646)^1.2 = 143.6 ft."""
    gust = DrydenGust.low_altitude(20 * 0.3048, wind=10.0, airspeed=5.0, dim=3)
    np.testing.assert_allclose(gust.length / 0.3048, [143.6, 143.6, 20.0], rtol=1e-3)
    np.testing.assert_allclose(gust.sigma, [1.9293, 1.9293, 1.0], rtol=1e-3)
    assert len(DrydenGust.low_altitude(50.0, 8.0, 5.0).sigma) == 2
    for altitude in (1.0, 400.0):
        with pytest.raises(BoundsError):
            DrydenGust.low_altitude(altitude, 8.0, 5.0)


def test_a_lag_is_the_fine_simulation_of_its_equation():
    model, rng = DoubleIntegrator(0.2), np.random.default_rng(0)
    U, tau, pieces = rng.uniform(-3, 3, (12, 2)), 0.15, 4000
    pushed = pushes(ActuatorLag(tau), 12, inputs=U)
    a = np.zeros(2)
    for u, push in zip(U, pushed, strict=True):
        mean = np.zeros(2)
        for _ in range(pieces):
            slope = (u - a) / tau
            mean += (a + slope * 0.2 / pieces / 2) / pieces
            a = a + slope * 0.2 / pieces
        np.testing.assert_allclose(push, model.B @ (mean - u), atol=2e-4)
    # A slow one has hardly moved at first, a fast one is hardly seen.
    np.testing.assert_allclose(pushes(ActuatorLag(1e6), 1, inputs=U)[0], -model.B @ U[0], atol=1e-5)
    assert np.abs(pushes(ActuatorLag(1e-6), 12, inputs=U)).max() < 1e-4


def test_a_constant_push_is_an_input_that_never_changes():
    model = DoubleIntegrator(0.2, dim=3)
    pushed = pushes(ConstantPush((0.4, -0.1, 0.2)), 5, model)
    np.testing.assert_allclose(pushed, np.tile(model.B @ [0.4, -0.1, 0.2], (5, 1)))
    with pytest.raises(ShapeError):
        pushes(ConstantPush((0.4,)), 1)


@pytest.mark.parametrize(
    "disturbance",
    [CorrelatedDisturbance(), DrydenGust.low_altitude(10.0, 8.0, 5.0), ActuatorLag(0.1)],
    ids=lambda d: type(d).__name__,
)
def test_runs_are_independent_and_reproducible(disturbance):
    u = np.random.default_rng(1).uniform(-1, 1, (20, 2))
    first, again = (pushes(disturbance, 20, inputs=u) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    if not isinstance(disturbance, ActuatorLag):
        assert np.abs(pushes(disturbance, 20, seed=1) - first).max() > 0.01


def test_the_closed_loop_adds_what_the_disturbance_says():
    scenario = SCENARIOS["scenario-3"]
    run = scenario.run(steps=6, seed=4)
    model, wind = run.problem.model, scenario.disturbance.samples(scenario.generator(4))
    for x, u, after in zip(run.states, run.inputs, run.states[1:], strict=False):
        np.testing.assert_array_equal(after, model.step(x, u) + next(wind))


@pytest.mark.parametrize(
    ("make", "error"),
    [
        (lambda: DrydenGust(np.array([1.0, -1.0]), np.ones(2)), BoundsError),
        (lambda: DrydenGust(np.ones(2), np.ones(3)), ShapeError),
        (lambda: DrydenGust(np.ones(2), np.ones(2), airspeed=0.0), BoundsError),
        (lambda: DrydenGust(np.ones(4), np.ones(4)), ShapeError),
        (lambda: ActuatorLag(0.0), BoundsError),
    ],
)
def test_misuse_is_refused(make, error):
    with pytest.raises(error):
        make()
    with pytest.raises(ShapeError, match="sigma"):
        pushes(DrydenGust(np.ones(3), np.ones(3)), 1)
