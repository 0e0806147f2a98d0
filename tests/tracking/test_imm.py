"""The filter bank against slow and obvious ones: one track at a time, all histories of motions."""

from itertools import pairwise, product

import numpy as np
import pytest

from scp_mpc.tracking import Motion
from scp_mpc.tracking.imm import Beliefs, MotionBank
from scp_mpc.tracking.kalman import Gaussians
from scp_mpc.tracking.prediction import HorizonPredictor

MOTIONS = (Motion(0.05), Motion(0.4, weight=0.3), Motion(0.1, 0.6, weight=0.2))
NOISE = 0.1**2 * np.eye(2)


def beliefs(count, motions, seed=0, dim=2):
    """Arbitrary ones, at arbitrary places far from the origin."""
    rng = np.random.default_rng(seed)
    w = rng.uniform(0.1, 1.0, (count, motions))
    m = rng.normal(0, 2, (count, motions, 2 * dim))
    m[..., :dim] += rng.normal(0, 1000, (count, 1, dim))
    root = rng.normal(0, 0.4, (count, motions, 2 * dim, 2 * dim))
    P = root @ np.swapaxes(root, -2, -1)
    return Beliefs(w / w.sum(axis=1, keepdims=True), Gaussians(m, P))


def mixture(weights, means, covariances):
    """Mean and covariance of a mixture, by definition."""
    mean = sum(w * m for w, m in zip(weights, means, strict=True))
    spread = [P + np.outer(m - mean, m - mean) for m, P in zip(means, covariances, strict=True)]
    return mean, sum(w * S for w, S in zip(weights, spread, strict=True))


def slow_cycle(bank, w, m, P, z, dt):
    """One cycle of one track as in the paper, with loops."""
    F, Q, Pi = bank.transition(dt)
    count = len(w)
    new_w, new_m, new_P = np.zeros(count), [], []
    for j in range(count):
        c = sum(Pi[i, j] * w[i] for i in range(count))
        mean, cov = mixture([Pi[i, j] * w[i] / c for i in range(count)], m, P)
        mean, cov = F[j] @ mean, F[j] @ cov @ F[j].T + Q[j]
        S = cov[:2, :2] + NOISE
        K = cov[:, :2] @ np.linalg.inv(S)
        e = z - mean[:2]
        density = np.exp(-e @ np.linalg.inv(S) @ e / 2) / np.sqrt(np.linalg.det(2 * np.pi * S))
        new_w[j] = c * density
        new_m.append(mean + K @ e)
        new_P.append(cov - K @ S @ K.T)
    return new_w / new_w.sum(), np.array(new_m), np.array(new_P)


def test_a_cycle_is_that_of_the_paper():
    bank = MotionBank(MOTIONS, 1.5, 2)
    b = beliefs(4, 3)
    z = b.moments().means[:, :2] + np.random.default_rng(1).normal(0, 0.5, (4, 2))
    after = bank.correct(bank.predict(b, 0.37), z, np.tile(NOISE, (4, 1, 1)))
    for k in range(4):
        w, m, P = slow_cycle(bank, b.weights[k], *(a[k] for a in b.states), z[k], 0.37)
        assert np.allclose(after.weights[k], w, atol=1e-9)
        assert np.allclose(after.states.means[k], m, rtol=0, atol=1e-9)
        assert np.allclose(after.states.covariances[k], P, rtol=0, atol=1e-9)


def test_switching_over_two_intervals_is_that_over_their_sum():
    bank = MotionBank(MOTIONS, 1.5, 2)
    (_, _, first), (_, _, then), (_, _, whole) = (bank.transition(t) for t in (0.3, 0.9, 1.2))
    assert np.allclose(first @ then, whole, atol=1e-15)
    assert np.allclose(whole.sum(axis=1), 1)
    assert np.allclose(bank.shares @ whole, bank.shares)


def test_prediction_is_exact_over_all_histories():
    """Mean and covariance after four steps, from every one of the 3^5 sequences of motions."""
    bank, steps, dt = MotionBank(MOTIONS, 1.0, 2), 4, 0.3
    b = beliefs(1, 3)
    means, covariances = HorizonPredictor(bank, steps, dt).positions(b)
    F, Q, Pi = bank.transition(dt)
    weights, ends, spreads = [], [], []
    for history in product(range(3), repeat=steps + 1):
        w, m, P = b.weights[0, history[0]], *(a[0, history[0]] for a in b.states)
        for i, j in pairwise(history):
            w, m, P = w * Pi[i, j], F[j] @ m, F[j] @ P @ F[j].T + Q[j]
        weights.append(w)
        ends.append(m)
        spreads.append(P)
    mean, cov = mixture(weights, ends, spreads)
    assert np.allclose(means[0, -1], mean[:2], rtol=0, atol=1e-9)
    assert np.allclose(covariances[0, -1], cov[:2, :2], rtol=0, atol=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_foresight_is_the_bank_stage_by_stage(dim):
    motions = MOTIONS if dim == 2 else MOTIONS[:2]
    bank, b = MotionBank(motions, 1.0, dim), beliefs(5, len(motions), dim=dim)
    means, covariances = HorizonPredictor(bank, 12, 0.2).positions(b)
    assert means.shape == (5, 13, dim)
    for i in range(13):
        mean, cov = b.moments()
        assert np.allclose(means[:, i], mean[:, :dim], rtol=0, atol=1e-9)
        assert np.allclose(covariances[:, i], cov[:, :dim, :dim], rtol=0, atol=1e-9)
        b = bank.predict(b, 0.2)


def test_a_motion_that_was_ruled_out_comes_back():
    bank = MotionBank(MOTIONS[:2], 1.0, 2)
    b = bank.begin(np.zeros((1, 2)), NOISE[None], 1.0)
    for k in range(1, 60):
        b = bank.correct(bank.predict(b, 0.2), np.array([[0.2 * k, 0.0]]), NOISE[None])
    quiet = b.weights[0, 0]
    for k in range(6):
        z = np.array([[11.8 - 0.2 * k, 0.5 * k]])
        b = bank.correct(bank.predict(b, 0.2), z, NOISE[None])
    assert quiet > 0.85
    assert b.weights[0, 1] > 0.5


def test_absurd_measurements_leave_finite_numbers():
    bank = MotionBank(MOTIONS, 1.0, 2)
    b = bank.begin(np.zeros((1, 2)), NOISE[None], 1.0)
    b = bank.correct(bank.predict(b, 0.2), np.array([[1e9, -1e9]]), NOISE[None])
    assert np.isfinite(b.weights).all()
    assert np.isclose(b.weights.sum(), 1)
    assert np.isfinite(b.states.covariances).all()
