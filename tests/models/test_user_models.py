"""Models as users write them: what is found out about them, and what is found wrong."""

import math

import numpy as np
import pytest
from models import DT, MODELS, PLANE, discrete, unicycle_rates, unicycle_slopes
from user_models import ROBOTS, UTM, UserRobot, draw_robot

from scp_mpc.errors import InvalidArgumentError, JacobianError, NotFiniteError, ShapeError
from scp_mpc.models import FunctionModel, KinematicBicycle, Model
from scp_mpc.models.differences import differences, second_differences

SMALL = {key: value for key, value in PLANE.items() if key != "heading"}


def build(robot):
    """Its model, checked about the origin of its map."""
    return FunctionModel(robot.function, robot.jacobians, check=robot.about, **robot.arguments)


def test_wrong_entries_are_found_and_right_models_kept():
    """Units of m, mm and km, dt from 0.01 to 1 s, coordinates of a map; one entry wrong."""
    rng = np.random.default_rng(7)
    for _ in range(25):
        robot = draw_robot(rng, wrong=True)
        with pytest.raises(JacobianError) as caught:
            build(robot)
        row, column, _ = robot.wrong
        nx = robot.sizes[0]
        assert caught.value.argument == (
            f"A[{row}, {column}]" if column < nx else f"B[{row}, {column - nx}]"
        )
        build(draw_robot(rng))


@pytest.mark.slow
def test_a_thousand_wrong_entries_and_a_thousand_right_models():
    rng, missed = np.random.default_rng(0), 0
    for _ in range(1000):
        try:
            build(draw_robot(rng, wrong=True))
            missed += 1
        except JacobianError:
            pass
        build(draw_robot(rng))
    assert missed <= 10


def test_check_needs_no_point():
    """A wrong sign that does not show at zero."""

    def wrong(x, u):
        by_x, by_u = unicycle_slopes(x, u)
        by_x[1, 2] *= -1
        return by_x, by_u

    with pytest.raises(JacobianError, match=r"A\[1, 2\]"):
        FunctionModel(unicycle_rates, wrong, check=True, **PLANE)
    FunctionModel(unicycle_rates, unicycle_slopes, check=True, **PLANE)


def test_a_model_may_be_defined_in_a_part_of_the_plane():
    def rates(x, u):
        return np.array([x[2], x[3], u[0] - np.sqrt(x[2]), u[1] / x[3]])

    def slopes(x, u):
        by_x, by_u = np.zeros((4, 4)), np.zeros((4, 2))
        by_x[0, 2] = by_x[1, 3] = by_u[2, 0] = 1.0
        by_x[2, 2], by_u[3, 1], by_x[3, 3] = -0.5 / np.sqrt(x[2]), 1 / x[3], -u[1] / x[3] ** 2
        return by_x, by_u

    def wrong(x, u):
        by_x, by_u = slopes(x, u)
        by_x[2, 2] *= 1.01
        return by_x, by_u

    about = np.ones(4), np.ones(2)
    with np.errstate(all="ignore"):
        FunctionModel(rates, slopes, check=about, **SMALL)
        with pytest.raises(JacobianError, match=r"A\[2, 2\]"):
            FunctionModel(rates, wrong, check=about, **SMALL)
        with pytest.raises(NotFiniteError):
            FunctionModel(rates, slopes, check=True, **SMALL)


def test_second_derivatives_are_checked():
    class Wrong(KinematicBicycle):
        def hessian(self, states, inputs, weights):
            bent = super().hessian(states, inputs, weights)
            bent[..., 2, 3] *= 1.01
            bent[..., 3, 2] *= 1.01
            return bent

    KinematicBicycle(DT, 2.5).check()
    with pytest.raises(JacobianError, match="curvature"):
        Wrong(DT, 2.5).check()


@pytest.mark.parametrize("name", MODELS)
def test_every_model_stands_its_check(name):
    MODELS[name].check()


def columns(x, u):
    _px, _py, theta, v = x
    return [v * np.cos(theta), v * np.sin(theta), u[1], u[0]]


def constant(x, u):
    return [x[3], 0.0, u[1], u[0]]


def scalars(x, u):
    return np.array([x[3] * math.cos(x[2]), x[3] * math.sin(x[2]), u[1], u[0]])


def branching(x, u):
    return np.array([x[3], x[2] if x[3] > 0 else 0.0, u[1], u[0]])


def norms(x, u):
    """Right for many points at once in shape alone."""
    return np.array([x[3], x[2], u[1], u[0]]) / max(1.0, 0.01 * np.linalg.norm(x))


def rows(x, u):
    return np.concatenate([x[..., 2:], u - 0.3 * x[..., 2:]], axis=-1)


@pytest.mark.parametrize(
    ("function", "layout"),
    [
        (unicycle_rates, "rows"),
        (rows, "rows"),
        (columns, "columns"),
        (constant, "columns"),
        (scalars, "single"),
        (branching, "single"),
        (norms, "single"),
    ],
)
def test_plain_functions_are_called_with_many_points_where_they_allow_it(function, layout):
    model, loop = (FunctionModel(function, vectorised=v, **SMALL) for v in (None, False))
    assert (model._function.layout, loop._function.layout) == (layout, "single")
    rng = np.random.default_rng(1)
    x, u = 3 * rng.normal(size=(2, 9, 4)), rng.normal(size=(9, 2))
    for fraction in (0.5, 1.0):
        many, one = model.linearise(x, u, fraction), loop.linearise(x, u, fraction)
        for part in ("after", "A", "B"):
            np.testing.assert_allclose(getattr(many, part), getattr(one, part), atol=1e-8)


def test_jacobians_are_called_with_many_points_too():
    def slopes(x, _):
        zero, one = 0 * x[0], 1 + 0 * x[0]
        c, s, v = np.cos(x[2]), np.sin(x[2]), x[3]
        return (
            np.array([[zero, zero, -v * s, c], [zero, zero, v * c, s], [zero] * 4, [zero] * 4]),
            np.array([[zero, zero], [zero, zero], [zero, one], [one, zero]]),
        )

    model = FunctionModel(columns, slopes, check=True, **SMALL)
    assert model._jacobians.layout == "columns"
    rng = np.random.default_rng(2)
    x, u = rng.normal(size=(3, 4)), rng.normal(size=(3, 2))
    one = [np.concatenate(unicycle_slopes(*point), axis=1) for point in zip(x, u, strict=True)]
    np.testing.assert_allclose(model.jacobians(x, u), one)
    assert FunctionModel(columns, unicycle_slopes, **SMALL)._jacobians.layout == "single"


def test_a_function_cannot_write_to_what_it_is_given():
    def careless(x, u):
        x[2] = 0.0
        return unicycle_rates(x, u)

    with pytest.raises(InvalidArgumentError, match="read-only"):
        FunctionModel(careless, **SMALL)


@pytest.mark.parametrize(
    ("function", "nu", "says"),
    [
        (lambda u, x: unicycle_rates(x, u), 2, "takes"),
        (lambda a, b: unicycle_rates(b, a), 2, "IndexError"),
        (lambda a, b: b[:4] + 0 * a[1], 4, "no input changes anything"),  # x' = u, swapped
    ],
)
def test_swapped_arguments_are_refused(function, nu, says):
    def swapped(a, b):
        return function(b, a) if nu == 4 else function(a, b)

    given = function if nu == 2 else swapped
    with pytest.raises(InvalidArgumentError, match=says):
        FunctionModel(given, **{**SMALL, "nu": nu})


def test_lists_are_taken_like_arrays_and_other_shapes_refused():
    for model in MODELS.values():
        x, u = [0.1] * model.nx, [0.2] * model.nu
        np.testing.assert_array_equal(model.step(x, u), model.step(np.array(x), np.array(u)))
        np.testing.assert_array_equal(
            model.linearise(x, u).A, model.linearise(np.array(x), np.array(u)).A
        )
        np.testing.assert_array_equal(model.stopping_input(x), model.stopping_input(np.array(x)))
        one = [1.0] * model.dim
        np.testing.assert_array_equal(
            model.state(one, one), model.state(np.array(one), np.array(one))
        )
        with pytest.raises(ShapeError, match="x"):
            model.step(x[1:], u)
        with pytest.raises(ShapeError, match="u"):
            model.step(x, [u])


@pytest.mark.parametrize("unit", [1.0, 1e3, 1e-3])
@pytest.mark.parametrize("name", ROBOTS)
def test_differences_are_as_good_on_a_map_as_at_its_origin(name, unit):
    """First and second ones, of a discrete robot; less so where places differ."""
    models = []
    for origin in ((0.0, 0.0), tuple(np.array(UTM) * unit)):
        robot = UserRobot(name, 0.1, True, unit, origin)
        models.append((FunctionModel(robot.function, "central", **robot.arguments), robot))
    (near, here), (far, there) = models
    rng = np.random.default_rng(3)
    x = rng.normal(size=(5, here.sizes[0])) * here.scales[0]
    x = np.round(x * 2**8) / 2**8
    u, y = rng.normal(size=(5, here.sizes[1])) * here.scales[1], rng.normal(size=x.shape)
    found, expected = far.linearise(x + there.about[0], u), near.linearise(x, u)
    tolerance = 1e-2 if name == "terrain" else 1e-8
    for part in ("A", "B"):
        np.testing.assert_allclose(
            getattr(found, part), getattr(expected, part), atol=tolerance, rtol=1e-8
        )
    if name != "terrain":
        bent = near.curvature(x, u, y)
        np.testing.assert_allclose(
            far.curvature(x + there.about[0], u, y), bent, atol=1e-5 * np.abs(bent).max()
        )


def test_differences_of_polynomials():
    rng = np.random.default_rng(4)
    H = rng.normal(size=(5, 5))
    H = H + H.T
    z = rng.normal(size=(3, 2, 5)) * [1.0, 1e-3, 1e3, 1e2, 1.0]

    def values(z):
        return np.stack([(z @ H * z).sum(axis=-1) / 2, z[..., 0] * z[..., 1]], axis=-1)

    size = np.abs(values(z)).max()
    slopes = differences(values, z)
    np.testing.assert_allclose(slopes[..., 0, :], z @ H, atol=1e-9 * size)
    np.testing.assert_allclose(slopes[..., 1, 0], z[..., 1], atol=1e-9 * size)
    bent = second_differences(lambda z: values(z)[..., 0], z, np.full((3, 2, 1), size))
    np.testing.assert_allclose(bent, np.broadcast_to(H, bent.shape), atol=1e-3)


def test_the_discrete_model_has_the_curvature_of_its_step():
    model = FunctionModel(discrete, "complex", discrete=True, **PLANE)
    rng = np.random.default_rng(5)
    x, u, y = rng.normal(size=(4, 4)), rng.normal(size=(4, 2)), rng.normal(size=(4, 4))
    np.testing.assert_allclose(
        model.curvature(x, u, y, 0.5), Model.curvature(model, x, u, y, 0.5), atol=1e-6
    )
