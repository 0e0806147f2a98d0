"""Misuse: a typed error that names the argument and the number, and no trace of the call."""

import pickle

import numpy as np
import pytest
from driving import N, drive, good, same
from instances import S_REF, instance, obstacle, problem

from scp_mpc import (
    MPC,
    SCP,
    BoundsError,
    CovarianceError,
    InvalidArgumentError,
    Margin,
    NotFiniteError,
    ObstaclePrediction,
    QPSettings,
    Settings,
    ShapeError,
    Trajectory,
    Unicycle,
)
from scp_mpc.qp.others import installed, known

NAN, INF = np.nan, np.inf


ONE = obstacle(N, (1.0, 0.0))


BAD_STEPS = [
    ({"x0": np.ma.masked_array(np.zeros(4), [0, 1, 0, 0])}, InvalidArgumentError, "masked"),
    ({"x0": [1e200, 0, 0, 0]}, BoundsError, "1e\\+200"),
    ({"obstacles": None}, InvalidArgumentError, "obstacles"),
    ({"obstacles": ONE}, InvalidArgumentError, "obstacles"),
    ({"x0": np.zeros(3)}, ShapeError, "x0"),
    ({"x0": np.zeros((4, 1))}, ShapeError, "x0"),
    ({"x0": [0, 0, NAN, 0]}, NotFiniteError, "x0"),
    ({"x0": [0, INF, 0, 0]}, NotFiniteError, "x0"),
    ({"x0": "somewhere"}, InvalidArgumentError, "x0"),
    ({"x0": [1j, 0, 0, 0]}, InvalidArgumentError, "x0"),
    ({"x0": None}, InvalidArgumentError, "x0"),
    ({"x_ref": np.zeros((N, 4))}, ShapeError, "x_ref"),
    ({"x_ref": np.zeros((N + 1, 2))}, ShapeError, "x_ref"),
    ({"x_ref": np.full((N + 1, 4), NAN)}, NotFiniteError, "x_ref"),
    ({"obstacles": [obstacle(N + 1, (1, 0))]}, ShapeError, "obstacles"),
    ({"obstacles": [np.zeros((N + 1, 2))]}, InvalidArgumentError, "obstacles"),
]


@pytest.fixture(scope="module")
def undisturbed():
    """The plans of a drive without bad steps."""
    return drive(MPC(problem(N)), 9)


@pytest.mark.parametrize(("change", "error", "message"), BAD_STEPS)
def test_a_bad_step_is_refused_and_leaves_no_trace(undisturbed, change, error, message):
    mpc = MPC(problem(N))

    def interrupt(k):
        if k % 3 == 1:
            with pytest.raises(error, match=message):
                mpc.step(**{**good(), **change})

    assert same(undisturbed, drive(mpc, 9, interrupt))


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ((np.zeros((5, 2)), np.eye(3), 0.2), ShapeError, "covariances"),
        ((np.zeros((5, 2)), np.zeros((4, 2, 2)), 0.2), ShapeError, "covariances"),
        ((np.zeros((5, 4)), np.eye(4), 0.2), ShapeError, "means"),
        ((np.zeros((1, 2)), np.eye(2), 0.2), ShapeError, "1 row"),
        ((np.full((5, 2), NAN), np.eye(2), 0.2), NotFiniteError, "means"),
        ((np.zeros((5, 2)), [[INF, 0], [0, 1]], 0.2), NotFiniteError, "covariances"),
        ((np.zeros((5, 2)), [[1.0, 0.5], [0.4, 1.0]], 0.2), CovarianceError, "not symmetric"),
        # The report's own velocity covariance: determinant -1e-4.
        ((np.zeros((5, 2)), [[0.08, 0.05], [0.05, 0.03]], 0.2), CovarianceError, "-0.00"),
        ((np.zeros((5, 2)), np.eye(2), -0.1), BoundsError, "-0.1 m"),
        ((np.zeros((5, 2)), np.eye(2), NAN), NotFiniteError, "radius"),
    ],
)
def test_bad_predictions_are_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        ObstaclePrediction(*arguments)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"horizon": 0}, BoundsError, "horizon"),
        ({"horizon": 2.5}, InvalidArgumentError, "horizon"),
        ({"horizon": True}, InvalidArgumentError, "horizon"),
        ({"margin": 2.4}, InvalidArgumentError, r"Margin\(reference=2.4, lower=2.4\)"),
        ({"model": Unicycle(0.2), "R": [1.0, 0.0]}, InvalidArgumentError, "R: is singular"),
        ({"inflation": []}, InvalidArgumentError, "inflation"),
        ({"max_obstacles": 0.0}, InvalidArgumentError, "max_obstacles"),
        ({"Q": [1.0, 1.0]}, ShapeError, "Q"),
        ({"Q": [1.0, -1.0, 1.0, 1.0]}, CovarianceError, "-1"),
        ({"R": [[1.0, 2.0], [0.0, 1.0]]}, CovarianceError, "R"),
        ({"u_min": 3.0, "u_max": -3.0}, BoundsError, "3.0 exceeds u_max = -3.0"),
        ({"u_min": [0.0, NAN]}, NotFiniteError, "u_min"),
        ({"robot_radius": -0.15}, BoundsError, "-0.15"),
        ({"inflation": "square"}, InvalidArgumentError, "square"),
        ({"max_obstacles": -1}, BoundsError, "-1"),
        ({"slack_weight": 0.0}, BoundsError, "slack_weight"),
        ({"model": "car"}, InvalidArgumentError, "car"),
    ],
)
def test_bad_problems_are_refused(changes, error, message):
    with pytest.raises(error, match=message):
        problem(**{"horizon": N, **changes})


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"lower": 3.0, "upper": 2.0}, "margin.lower"),
        ({"lower": -1.0}, "margin.lower"),
        ({"reference": 11.0}, "11.0"),
        ({"weight": 0.0}, "weight"),
        ({"upper": NAN}, "margin.upper"),
    ],
)
def test_bad_margins_are_refused(values, message):
    with pytest.raises(InvalidArgumentError, match=message):
        Margin(**values)


@pytest.mark.parametrize(
    "values",
    [
        {"tolerance": 0.0},
        {"tolerance": NAN},
        {"max_iterations": 0},
        {"max_iterations": True},
        {"multi_start_interval": -2},
        {"multi_start": "no"},
        {"history": 1},
        {"solver": None},
        {"max_candidates": 0},
        {"deadline": 0.0},
        {"staleness": None},
        {"qp": None},
    ],
)
def test_bad_settings_are_refused(values):
    with pytest.raises(InvalidArgumentError):
        Settings(**values)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"rescue": "piqp"}, "rescue: 'piqp'"),
        ({"rho": 10.0}, "qp.rho: 10.0 is not a tuple"),
        ({"rho": ()}, "qp.rho"),
        ({"rho": (10.0, 0.0)}, "qp.rho: 0.0"),
        ({"rho": (NAN,)}, "qp.rho: nan"),
        ({"sigma": 0.0}, "qp.sigma: 0.0"),
        ({"sigma": -1e-6}, "qp.sigma: -1e-06"),
        ({"alpha": 0.0}, "qp.alpha"),
        ({"alpha": 2.0}, "qp.alpha: 2.0 is not below 2"),
        ({"iterations": 10, "repairs": 1}, "qp.iterations: 10 is not a tuple"),
        ({"iterations": (), "repairs": ()}, "qp.iterations"),
        ({"iterations": (0,), "repairs": (1,)}, "qp.iterations"),
        ({"iterations": (1.5,), "repairs": (1,)}, "qp.iterations"),
        ({"iterations": (10,), "repairs": (-1,)}, "qp.repairs"),
        ({"iterations": (10, 10), "repairs": (1,)}, "qp.repairs: 1 entries, but 2"),
    ],
)
def test_bad_qp_settings_are_refused(values, message):
    with pytest.raises(InvalidArgumentError, match=message):
        QPSettings(**values)


def test_solvers_that_are_not_there_are_refused_and_those_that_are_named():
    missing = sorted(set(known()) - set(installed()))[0]
    for name, message in (
        ("simplex", "solver: 'simplex' is none of osqp, piqp"),
        (missing, f"solver: '{missing}' is not installed: pip install 'qpsolvers.{missing}.'"),
    ):
        for owner in (SCP, MPC):
            with pytest.raises(InvalidArgumentError, match=message):
                owner(problem(N), Settings(solver=name))


def test_settings_of_the_wrong_kind_are_refused():
    with pytest.raises(InvalidArgumentError, match="settings"):
        MPC(problem(N), QPSettings())


def test_a_bad_guess_is_refused():
    case = instance("ahead", N, "exact", S_REF, 0)
    solver = SCP(case.problem)
    arguments = (case.x0, case.x_ref, case.obstacles)
    for guess, error in (
        (Trajectory(np.zeros((4, 4)), np.zeros((3, 2))), ShapeError),
        ("straight on", InvalidArgumentError),
    ):
        with pytest.raises(error, match="guess"):
            solver.solve(*arguments, guess)
    with pytest.raises(ShapeError, match="states"):
        Trajectory(np.zeros((4, 4)), np.zeros((4, 2)))
    with pytest.raises(NotFiniteError, match="inputs"):
        Trajectory(np.zeros((4, 4)), np.full((3, 2), NAN))


def test_errors_survive_the_way_out_of_a_process():
    error = ShapeError("x0", "shape (3,) is not (4,)")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is ShapeError
    assert str(again) == str(error) == "x0: shape (3,) is not (4,)"
    assert again.argument == "x0"
