"""Predictions of all obstacles as arrays: the same as one by one, in checks and in plans."""

from dataclasses import replace

import numpy as np
import pytest

from scp_mpc import (
    MPC,
    CovarianceError,
    DoubleIntegrator,
    InvalidArgumentError,
    ObstaclePrediction,
    ObstaclePredictions,
    Polytope,
    Problem,
    Settings,
)
from scp_mpc.scp.step import Step

N, J = 8, 3
BOX = Polytope.box([1.0, 0.5])


def arrays(d=2, seed=0):
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(J, 1, d)) + np.arange(N + 1)[:, None] * 0.1
    factors = 0.1 * rng.normal(size=(J, N + 1, d, d))
    return means, factors @ factors.swapaxes(-2, -1), rng.uniform(0.0, 0.5, J)


def one_by_one(means, covariances, radii, **more):
    given = zip(means, covariances, radii, strict=True)
    return [ObstaclePrediction(*each, **more) for each in given]


@pytest.mark.parametrize("d", [2, 3])
def test_it_is_a_sequence_of_predictions(d):
    given = arrays(d)
    names, shapes = ("a", None, 7), (None, None, None) if d == 3 else (None, BOX, None)
    all_ = ObstaclePredictions(*given, stamp=1.5, names=names, shapes=shapes, dt=0.2)
    each = one_by_one(*given, stamp=1.5, dt=0.2)
    each = [replace(o, name=n, shape=s) for o, n, s in zip(each, names, shapes, strict=True)]
    assert len(all_) == J
    for found, wanted in zip(all_, each, strict=True):
        for name in ("means", "covariances", "largest_std"):
            assert np.array_equal(getattr(found, name), getattr(wanted, name))
            assert not getattr(found, name).flags.writeable
        for name in ("radius", "stamp", "name", "shape", "dt"):
            assert getattr(found, name) == getattr(wanted, name)
    assert all_[-1] is all_[J - 1]
    assert all_[1:] == (all_[1], all_[2])
    with pytest.raises(IndexError):
        all_[J]


def test_one_covariance_and_one_radius_serve_all():
    means = arrays()[0]
    all_ = ObstaclePredictions(means, np.eye(2), 0.3)
    assert np.array_equal(all_.covariances, np.tile(np.eye(2), (J, N + 1, 1, 1)))
    assert all_.radii.tolist() == [0.3] * J


def test_arguments_are_copied():
    given = arrays()
    before = [array.copy() for array in given]
    all_ = ObstaclePredictions(*given)
    for array in given:
        array += 1.0
    assert np.array_equal(all_.means, before[0])
    assert np.array_equal(all_.covariances, before[1])
    assert np.array_equal(all_.radii, before[2])


def spoilt(name, place, value):
    parts = dict(zip(("means", "covariances", "radii"), arrays(), strict=True))
    parts[name][place] = value
    return parts


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (spoilt("means", (2, 3, 1), np.nan), r"means: nan at index \(2, 3, 1\) is not finite"),
        (spoilt("covariances", (1, 0, 0, 0), np.inf), r"covariances: inf at index \(1, 0, 0, 0\)"),
        (spoilt("covariances", (1, 2, 0, 1), 9.0), r"covariances: matrix 11 is not symmetric"),
        (spoilt("covariances", (1, 2, 0, 0), -1.0), r"matrix 11 is not positive semi-definite"),
        (spoilt("radii", 1, -0.5), r"radii: -0.5 m is negative"),
        (spoilt("radii", 1, np.nan), r"radii: nan at index \(1,\)"),
        ({"means": np.zeros((N + 1, 2))}, r"means: shape \(9, 2\)"),
        ({"means": np.zeros((J, 1, 2))}, r"means: 1 row\(s\)"),
        ({"means": "there"}, "means: not an array"),
        ({"radii": np.zeros(J + 1)}, r"radii: shape \(4,\)"),
        ({"covariances": np.zeros((N + 1, 2, 2))}, r"covariances: shape \(9, 2, 2\)"),
        ({"names": "ab"}, "names: 2 for 3 obstacles"),
        ({"names": ("a", [], "b")}, r"names\[1\]: \[\] is not hashable"),
        ({"shapes": (BOX,)}, "shapes: 1 for 3 obstacles"),
        ({"shapes": (None, "box", None)}, r"shapes\[1\]: 'box' is not a Polytope"),
        ({"dt": 0.0}, "dt: 0.0 s is not positive"),
        ({"stamp": np.nan}, "stamp: nan"),
    ],
)
def test_what_cannot_be_meant_is_refused(change, message):
    parts = dict(zip(("means", "covariances", "radii"), arrays(), strict=True))
    with pytest.raises(InvalidArgumentError, match=message):
        ObstaclePredictions(**(parts | change))


@pytest.mark.parametrize("d", [2, 3])
def test_covariances_are_judged_as_one_by_one(d):
    """The quick look at minors refuses nothing and accepts nothing that eigenvalues would not."""
    rng, judged = np.random.default_rng(d), []
    for _ in range(2000):
        values = rng.choice([0.0, 1.0, -1e-8, 1e-8, -1e-10, 1e-12, 3.0], d)
        turn = np.linalg.qr(rng.normal(size=(d, d)))[0] if rng.random() < 0.7 else np.eye(d)
        Sigma = rng.choice([1e-6, 1.0, 1e6]) * (turn * values) @ turn.T
        if rng.random() < 0.8:
            Sigma = (Sigma + Sigma.T) / 2
        Sigma[0, 1] += rng.choice([0.0, 0.0, 0.0, 1e-7]) * np.abs(Sigma).max()
        means = np.zeros((1, 2, d))
        verdicts = []
        for make in (
            lambda Sigma=Sigma, means=means: ObstaclePrediction(means[0], Sigma, 0.1),
            lambda Sigma=Sigma, means=means: ObstaclePredictions(means, Sigma, 0.1),
        ):
            try:
                make()
                verdicts.append(True)
            except CovarianceError:
                verdicts.append(False)
        assert verdicts[0] == verdicts[1], Sigma
        judged.append(verdicts[0])
    assert 0.2 < np.mean(judged) < 0.8


def problem(max_obstacles=J, **more):
    weights = {"Q": [1.0, 0.1, 1.0, 0.1], "R": [0.1, 0.1]}
    limits = {"u_min": -3.0, "u_max": 3.0, "robot_radius": 0.2, "max_obstacles": max_obstacles}
    return Problem(DoubleIntegrator(dt=0.2), horizon=N, **weights, **limits, **more)


def scene():
    means = np.array([[[1.0, 0.1], [2.0, -0.4], [0.5, 2.0]][j] for j in range(J)])
    means = means[:, None] + np.arange(N + 1)[:, None] * [-0.05, 0.01]
    growth = 0.01 + 0.002 * np.arange(N + 1)
    return means, np.tile(growth[:, None, None] * np.eye(2), (J, 1, 1, 1)), np.full(J, 0.2)


@pytest.mark.parametrize("more", [{}, {"growth_time": 0.6}, {"nodes_per_interval": 3}])
def test_a_step_reads_the_same_from_arrays(more):
    shapes = (None, BOX, None)
    each = [replace(o, shape=s) for o, s in zip(one_by_one(*scene()), shapes, strict=True)]
    all_ = ObstaclePredictions(*scene(), shapes=shapes)
    state = np.zeros(4), np.zeros(4)
    steps = [Step.read(problem(**more), *state, obstacles) for obstacles in (each, all_)]
    for name in ("means", "radii", "covariances", "largest_stds", "drift", "contact"):
        found, wanted = (getattr(step, name) for step in steps)
        assert np.array_equal(found, wanted)
    assert np.array_equal(steps[0].shapes.kind, steps[1].shapes.kind)


@pytest.mark.parametrize("slots", [J, J - 1])
@pytest.mark.parametrize("told", ["nothing", "stamps", "names"])
def test_a_controller_makes_the_same_plans(slots, told):
    case = problem(max_obstacles=slots)
    controllers = [MPC(case, Settings(deadline=None)) for _ in range(2)]
    x = np.array([0.0, 0.8, 0.0, 0.0])
    for k in range(3):
        stamp = 0.2 * k if told == "stamps" else None
        names = ("a", "b", "c") if told == "names" else None
        whole = ObstaclePredictions(*scene(), stamp, names)
        each = one_by_one(*scene(), stamp=stamp)
        if names:
            each = [replace(o, name=name) for o, name in zip(each, names, strict=True)]
        plans = [
            mpc.step(x, [4.0, 0.0, 0.0, 0.0], obstacles)
            for mpc, obstacles in zip(controllers, (each, whole), strict=True)
        ]
        assert np.array_equal(plans[0].U, plans[1].U)
        assert plans[0].iterate.touches
        assert plans[0].left_out == plans[1].left_out == J - slots
        x = case.model.step(x, plans[0].u0)
    assert [o.name for o in controllers[1].obstacles] == [o.name for o in controllers[0].obstacles]


def test_other_horizons_and_intervals_are_refused():
    for given, message in (
        (ObstaclePredictions(np.zeros((1, 4, 2)), np.eye(2), 0.1), r"\(1, 4, 2\) is not \(any, 9"),
        (ObstaclePredictions(np.zeros((1, 9, 2)), np.eye(2), 0.1, dt=0.1), "0.1 s apart"),
    ):
        with pytest.raises(InvalidArgumentError, match=message):
            MPC(problem()).step(np.zeros(4), np.zeros(4), given)
