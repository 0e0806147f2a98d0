"""Models from functions, and misuse of every model."""

import numpy as np
import pytest
from models import DT, OWN, PLANE, discrete, draw, unicycle_rates, unicycle_slopes

from scp_mpc.errors import (
    BoundsError,
    InvalidArgumentError,
    JacobianError,
    NotFiniteError,
    ShapeError,
)
from scp_mpc.models import (
    FunctionModel,
    KinematicBicycle,
    LinearModel,
    PlanarQuadrotor,
    Quadrotor,
    Unicycle,
)

POINTS = (np.full((3, 4), 0.4), np.full((3, 2), -0.3))


def wrong(x, u):
    """Slopes with one sign turned."""
    by_x, by_u = unicycle_slopes(x, u)
    by_x[1, 2] *= -1
    return by_x, by_u


@pytest.mark.parametrize("jacobians", [unicycle_slopes, "central", "complex"])
def test_a_function_comes_near_the_closed_form(jacobians):
    model = FunctionModel(unicycle_rates, jacobians, substeps=8, check=POINTS, **PLANE)
    exact = Unicycle(DT)
    x, u = draw(exact, np.random.default_rng(2), (4,))
    found, expected = model.linearise(x, u), exact.linearise(x, u)
    for part in ("after", "A", "B"):
        np.testing.assert_allclose(getattr(found, part), getattr(expected, part), atol=1e-7)


def test_a_discrete_function_is_its_step():
    model = FunctionModel(discrete, "complex", discrete=True, vectorised=True, **PLANE)
    x, u = draw(model, np.random.default_rng(2))
    np.testing.assert_allclose(model.step(x, u), discrete(x, u), atol=1e-15)
    half = model.advance(x, u, 0.5)
    np.testing.assert_allclose(half, (x + discrete(x, u)) / 2, atol=1e-15)


def test_own_stopping_input_state_and_equilibrium_are_used():
    model = FunctionModel(
        unicycle_rates,
        unicycle_slopes,
        stopping_input=lambda x: [-x[3], 0.0],
        state=lambda p, v: np.concatenate([p, v], axis=-1),
        equilibrium_input=[0.5, 0.0],
        **PLANE,
    )
    np.testing.assert_array_equal(model.stopping_input(np.full(4, 2.0)), [-2, 0])
    np.testing.assert_array_equal(model.state(np.ones((3, 2)), np.zeros((3, 2)))[1], [1, 1, 0, 0])
    np.testing.assert_array_equal(model.equilibrium_input, [0.5, 0.0])
    bad = FunctionModel(unicycle_rates, unicycle_slopes, stopping_input=lambda _: [1.0], **PLANE)
    with pytest.raises(ShapeError, match="stopping_input"):
        bad.stopping_input(np.zeros(4))


def test_a_wrong_jacobian_is_named():
    with pytest.raises(JacobianError, match=r"A\[1, 2\]") as caught:
        FunctionModel(unicycle_rates, wrong, check=POINTS, **PLANE)
    given, found = [float(word) for word in str(caught.value).split() if word[-1].isdigit()]
    assert given == pytest.approx(-found, rel=0.2)
    FunctionModel(unicycle_rates, wrong, **PLANE)


@pytest.mark.parametrize("matrix", ["A", "B"])
@pytest.mark.parametrize("name", OWN)
def test_check_sees_every_entry(name, matrix, monkeypatch):
    """A small error in any one entry is found, at a state of one's own."""
    model = OWN[name]
    x, u = draw(model, np.random.default_rng(8))
    exact = model.linearise(x, u)
    row, column = 2, getattr(exact, matrix).shape[-1] - 1
    getattr(exact, matrix)[row, column] += 1e-4
    monkeypatch.setattr(type(model), "linearise", lambda *_: exact)
    with pytest.raises(JacobianError) as caught:
        model.check(x, u)
    assert caught.value.argument == f"{matrix}[{row}, {column}]"


def test_a_complex_step_through_abs_is_refused():
    def rates(x, u):
        return unicycle_rates(x, u) + np.abs(x + 1.0)

    with pytest.raises(JacobianError):
        FunctionModel(rates, "complex", **PLANE)


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"function": lambda x, _: x[:3]}, ShapeError),
        ({"function": lambda x, _: x[:3], "vectorised": True}, ShapeError),
        ({"function": lambda x, _: x / 0.0 * np.nan}, NotFiniteError),
        ({"function": lambda *_: np.array(["a"] * 4)}, InvalidArgumentError),
        ({"function": None}, InvalidArgumentError),
        ({"jacobians": lambda *_: np.eye(4)}, InvalidArgumentError),
        ({"jacobians": lambda *_: (np.eye(4), np.eye(4))}, ShapeError),
        ({"jacobians": lambda *_: (np.eye(4), np.zeros((3, 2)))}, ShapeError),
        ({"jacobians": lambda *_: (np.eye(4) * np.nan, np.zeros((4, 2)))}, NotFiniteError),
        ({"jacobians": "exact"}, InvalidArgumentError),
        ({"dt": 0.0}, BoundsError),
        ({"nx": 0}, BoundsError),
        ({"nu": 2.0}, InvalidArgumentError),
        ({"substeps": 0}, BoundsError),
        ({"position": [0, 4]}, InvalidArgumentError),
        ({"heading": 4}, InvalidArgumentError),
        ({"heading": -1}, BoundsError),
        ({"equilibrium_input": [0.0]}, ShapeError),
        ({"stopping_input": 3.0}, InvalidArgumentError),
        ({"check": (np.zeros(3), np.zeros(2))}, ShapeError),
        ({"check": (np.full(4, np.inf), np.zeros(2))}, NotFiniteError),
    ],
)
def test_bad_functions_are_refused(changes, error):
    good = {"function": unicycle_rates, "jacobians": unicycle_slopes, **PLANE}
    FunctionModel(**good)
    with pytest.raises(error), np.errstate(all="ignore"):
        FunctionModel(**{**good, **changes})


@pytest.mark.parametrize(
    ("build", "error"),
    [
        (lambda: Unicycle(0.0), BoundsError),
        (lambda: Unicycle(np.nan), NotFiniteError),
        (lambda: Unicycle("0.1"), InvalidArgumentError),
        (lambda: KinematicBicycle(0.1, -2.5), BoundsError),
        (lambda: KinematicBicycle(-0.1, 2.5), BoundsError),
        (lambda: KinematicBicycle(0.1, 2.5, rear=np.inf), NotFiniteError),
        (lambda: KinematicBicycle(0.1, 2.5, substeps=0), BoundsError),
        (lambda: PlanarQuadrotor(0.1, gravity=0.0), BoundsError),
        (lambda: Quadrotor(0.1, gravity=-9.81), BoundsError),
        (lambda: Quadrotor(0.1, substeps=1.5), InvalidArgumentError),
        (lambda: Unicycle(0.1).check(np.full(4, np.nan), np.zeros(2)), NotFiniteError),
        (lambda: Unicycle(0.1).check(np.zeros(3), np.zeros(2)), ShapeError),
        (lambda: Unicycle(0.1).check(np.zeros(4), np.zeros(1)), ShapeError),
    ],
)
def test_bad_arguments_are_refused(build, error):
    with pytest.raises(error):
        build()


def test_a_linear_model_moves_and_stops_as_it_says():
    """A general one, of which nobody said which entries are the velocity."""
    dt = 0.1
    A = np.eye(4) + np.array([[0, 0, dt, 0], [0, 0, 0, dt], [0, 0, -dt, 0], [0, 0, 0, -2 * dt]])
    model = LinearModel(A, np.vstack([np.zeros((2, 2)), dt * np.eye(2)]), dt, [0, 1])
    x = model.state(np.array([1.0, 2.0]), np.array([3.0, -1.0]))
    np.testing.assert_allclose(x, [1, 2, 3, -1])
    np.testing.assert_allclose(model.advance(x, model.equilibrium_input)[:2], [1.3, 1.9])
    A = A - np.diag([0.02, 0.0, 0.0, 0.0])  # a position that leaks
    model = LinearModel(A, model.B, dt, [0, 1])
    x = model.state(np.array([1.0, 2.0]), np.array([3.0, -1.0]))
    np.testing.assert_allclose(model.advance(x, model.equilibrium_input)[:2], [1.3, 1.9])
    fractions = np.array([0.3, 1.0, 0.0])
    states = model.advance(x, np.ones(2), fractions)
    for fraction, state in zip(fractions, states, strict=True):
        C, D = model.between(float(fraction))
        np.testing.assert_allclose(C @ x + D @ np.ones(2), state[:2], atol=1e-14)
    model.check(x, np.ones(2))
