"""Robots: the report's matrices, and misuse."""

import numpy as np
import pytest

from scp_mpc import BoundsError, DoubleIntegrator, InvalidArgumentError, LinearModel, ShapeError


def test_double_integrator_is_the_reports():
    model = DoubleIntegrator(dt=0.2)
    np.testing.assert_allclose(
        model.A, [[1, 0.2, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.2], [0, 0, 0, 1]], rtol=1e-15
    )
    np.testing.assert_allclose(model.B, [[0.02, 0], [0.2, 0], [0, 0.02], [0, 0.2]], rtol=1e-15)
    assert model.position.tolist() == [0, 2]
    assert (model.nx, model.nu, model.dim, model.dt) == (4, 2, 2, 0.2)


@pytest.mark.parametrize("dim", [2, 3])
def test_double_integrator_follows_the_parabola(dim):
    model, a = DoubleIntegrator(dt=0.1, dim=dim), np.arange(1.0, dim + 1)
    x = model.state(np.zeros(dim), np.ones(dim))
    for _ in range(7):
        x = model.step(x, a)
    np.testing.assert_allclose(x[model.position], 0.7 + a * 0.7**2 / 2)


def test_state_interleaves_position_and_velocity():
    state = DoubleIntegrator(0.2).state(np.array([[1.0, 2.0]]), np.array([[3.0, 4.0]]))
    np.testing.assert_array_equal(state, [[1, 3, 2, 4]])


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"A": np.zeros((2, 3))}, ShapeError),
        ({"B": np.zeros((3, 1))}, ShapeError),
        ({"dt": 0.0}, BoundsError),
        ({"position": [0]}, InvalidArgumentError),
        ({"position": [0, 0]}, InvalidArgumentError),
        ({"position": [0, 9]}, InvalidArgumentError),
        ({"position": [0.9, 2.9]}, InvalidArgumentError),
        ({"position": [False, True]}, InvalidArgumentError),
        ({"position": None}, InvalidArgumentError),
        ({"B": np.zeros((4, 0))}, ShapeError),
        ({"dt": np.nan}, InvalidArgumentError),
    ],
)
def test_bad_models_are_refused(changes, error):
    good = {"A": np.eye(4), "B": np.zeros((4, 2)), "dt": 0.1, "position": [0, 2]}
    LinearModel(**good)
    with pytest.raises(error):
        LinearModel(**{**good, **changes})


def test_bad_dimension_is_refused():
    with pytest.raises(InvalidArgumentError, match="4"):
        DoubleIntegrator(0.2, dim=4)


def test_matrices_are_frozen():
    with pytest.raises(ValueError, match="read-only"):
        DoubleIntegrator(0.2).A[0, 0] = 2.0
