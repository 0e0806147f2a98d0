"""Robots given by CasADi: against the same robots in closed form, and misuse."""

import copy
import pickle
import sys

import casadi as ca
import numpy as np
import pytest
from models import DT, OWN, draw

from scp_mpc.errors import InvalidArgumentError, MissingExtraError, ShapeError
from scp_mpc.models import CasadiModel, FunctionModel, Model

GIVEN = {"dt": DT, "position": [0, 1], "heading": 2}
X, U = ca.SX.sym("x", 5), ca.SX.sym("u", 2)
RATES = ca.vertcat(*OWN["bicycle, middle"].rates(ca.vertsplit(X), ca.vertsplit(U), ca))


def not_scalar():
    """The same of MX, with a tangent that Newton's method finds: no operations on scalars."""
    x, u, y, p = (ca.MX.sym("s", size) for size in (5, 2, 1, 1))
    tangent = ca.rootfinder("tan", "newton", {"x": y, "p": p, "g": y - ca.tan(p)})
    omega = x[3] * tangent(0.0, x[4]) / 2.5
    side, c, s = 1.25 * omega, ca.cos(x[2]), ca.sin(x[2])
    rates = ca.vertcat(x[3] * c - side * s, x[3] * s + side * c, omega, u)
    return ca.Function("g", [x, u], [rates])


@pytest.fixture(
    params=[
        lambda: CasadiModel(RATES, X, U, substeps=2, **GIVEN),
        lambda: CasadiModel(ca.Function("g", [X, U], [RATES]), substeps=2, **GIVEN),
        lambda: CasadiModel(not_scalar(), substeps=2, **GIVEN),
    ],
    ids=["expression", "function", "not scalar"],
)
def model(request):
    return request.param()


def test_it_is_the_robot_in_closed_form(model):
    own, rng = OWN["bicycle, middle"], np.random.default_rng(3)
    x, u = draw(own, rng, (3, 4))
    y = rng.normal(size=(3, 4, 5))
    for fraction in (1.0, np.array([0.25, 0.5, 1.0])[:, None]):
        found, expected = model.linearise(x, u, fraction), own.linearise(x, u, fraction)
        for part in ("after", "A", "B"):
            np.testing.assert_allclose(getattr(found, part), getattr(expected, part), atol=1e-12)
        np.testing.assert_allclose(
            model.curvature(x, u, y, fraction), own.curvature(x, u, y, fraction), atol=1e-11
        )
    np.testing.assert_allclose(model.step(x[0, 0], u[0, 0]), own.step(x[0, 0], u[0, 0]), atol=1e-13)
    assert (model.nx, model.nu) == (5, 2)
    model.check(x, u)
    model.check()


def test_a_discrete_one_has_the_second_derivatives_of_its_step():
    model = CasadiModel(X + DT * RATES, X, U, discrete=True, **GIVEN)
    rng = np.random.default_rng(4)
    x, u = draw(model, rng, (7,))
    y = rng.normal(size=(7, 5))
    np.testing.assert_allclose(
        model.curvature(x, u, y, 0.5), Model.curvature(model, x, u, y, 0.5), atol=1e-7
    )
    model.check(x, u)


@pytest.mark.parametrize("twin", [copy.deepcopy, lambda model: pickle.loads(pickle.dumps(model))])
def test_copies_are_the_same(model, twin):
    x, u = draw(model, np.random.default_rng(5), (4,))
    np.testing.assert_array_equal(twin(model).linearise(x, u).A, model.linearise(x, u).A)


@pytest.mark.parametrize(
    ("arguments", "error", "says"),
    [
        ((RATES,), InvalidArgumentError, "symbols"),
        ((RATES, X), InvalidArgumentError, "symbols"),
        ((RATES * ca.SX.sym("mass"), X, U), InvalidArgumentError, "symbols"),
        ((RATES[:3], X, U), ShapeError, r"\(3, 1\)"),
        ((RATES.T, X, U), ShapeError, r"\(1, 5\)"),
        ((ca.Function("g", [X, U], [RATES]), X, U), InvalidArgumentError, "not with a function"),
        ((ca.Function("g", [X], [X]),), InvalidArgumentError, "takes 1 arguments"),
        ((ca.Function("g", [U, X], [RATES], ["u", "x"], ["r"]),), InvalidArgumentError, "u, x"),
        ((ca.Function("g", [U, X], [RATES]),), ShapeError, r"\(2, 1\), \(5, 1\)"),
        ((lambda x, _: x,), InvalidArgumentError, "nothing of CasADi"),
    ],
)
def test_misuse_is_refused(arguments, error, says):
    with pytest.raises(error, match=says):
        CasadiModel(*arguments, **GIVEN)


def test_without_casadi_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(MissingExtraError, match=r"scp-mpc\[casadi\]"):
        CasadiModel(RATES, X, U, **GIVEN)


def test_a_function_model_points_to_it():
    with pytest.raises(InvalidArgumentError, match="CasadiModel"):
        FunctionModel(ca.Function("g", [X, U], [RATES]), nx=5, nu=2, dt=DT, position=[0, 1])
