"""Interacting multiple models: each track moves by one of several motions, and switches.

Notation:
    n, M                number of tracks and of motions
    w   (n, M)          probability of each motion
    m   (n, M, nx)      mean given the motion       P   (n, M, nx, nx)  covariance given the motion
    pi  (M,)            shares of the motions       tau                 dwell_time [s]
    Pi  (M, M)          Pi_ij: probability of going on with motion j after motion i

Motions change like a Markov chain in continuous time: with rate 1/tau a motion is drawn anew,
by the shares pi (the same one again among them). Over any interval T,

    Pi(T) = e^(-T/tau) I + (1 - e^(-T/tau)) 1 pi',      Pi(S) Pi(T) = Pi(S + T).

One cycle (Blom and Bar-Shalom, 1988):

    mix      c_j = sum_i w_i Pi_ij,     the states given "j from now on" are a mixture over i,
             replaced by the Gaussian with the same mean and covariance
    predict  each by its own motion
    correct  each by the same measurement;  w_j ~ c_j times its likelihood

Without a measurement, mean and covariance of the mixture are exact, not approximate: they only
depend on mean and covariance given each motion.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from scp_mpc.arrays import BoolArray, FloatArray, IntArray
from scp_mpc.tracking.kalman import Gaussians, corrected, predicted
from scp_mpc.tracking.motion import Motion

_LEAST = 1e-12  # probability that no motion falls below: it must be able to come back


class Beliefs(NamedTuple):
    """What is known of n tracks: probabilities (n, M) and Gaussians (n, M, ...) per motion."""

    weights: FloatArray
    states: Gaussians

    def moments(self) -> Gaussians:
        """Mean (n, nx) and covariance (n, nx, nx) of each track over all motions."""
        m, P = _merged(self.weights[:, None], self.states)
        return Gaussians(m[:, 0], P[:, 0])

    def at(self, index: IntArray | BoolArray) -> "Beliefs":
        """Some of the tracks, in that order."""
        return Beliefs(self.weights[index], Gaussians(*(a[index] for a in self.states)))

    def replaced(self, index: IntArray, others: "Beliefs") -> "Beliefs":
        """These tracks, but others at some places."""
        w, m, P = self.weights.copy(), *(a.copy() for a in self.states)
        w[index], m[index], P[index] = others.weights, *others.states
        return Beliefs(w, Gaussians(m, P))

    def joined(self, others: "Beliefs") -> "Beliefs":
        """These tracks, then the others."""
        m, P = (np.concatenate(pair) for pair in zip(self.states, others.states, strict=True))
        return Beliefs(np.concatenate([self.weights, others.weights]), Gaussians(m, P))


class MotionBank:
    """A set of motions between which obstacles switch.

    Args:
        motions: At least one.
        dwell_time: tau [s].
        dim: Dimension d of the workspace.
    """

    def __init__(self, motions: Sequence[Motion], dwell_time: float, dim: int) -> None:
        """Normalise the shares."""
        self.motions, self.dwell_time, self.dim = tuple(motions), dwell_time, dim
        weights = np.array([motion.weight for motion in motions], dtype=np.float64)
        self.shares: FloatArray = weights / weights.sum()
        self._last: tuple[float, tuple[FloatArray, FloatArray, FloatArray]] | None = None

    def transition(self, dt: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return F (M, nx, nx), Q (M, nx, nx) and Pi (M, M) over `dt` seconds."""
        if self._last is None or self._last[0] != dt:
            F, Q = zip(*(motion.transition(dt, self.dim) for motion in self.motions), strict=True)
            stay = np.exp(-dt / self.dwell_time)
            Pi = stay * np.eye(len(F)) + (1 - stay) * self.shares
            self._last = dt, (np.array(F), np.array(Q), Pi)
        return self._last[1]

    def begin(self, positions: FloatArray, noise: FloatArray, speed: float) -> Beliefs:
        """Tracks of which nothing is known but one measured position.

        Args:
            positions: (n, d) [m].
            noise: (n, d, d) [m^2].
            speed: Standard deviation of each component of the velocity [m/s].
        """
        (n, d), M = positions.shape, len(self.motions)
        m, P = np.zeros((n, M, 2 * d)), np.zeros((n, M, 2 * d, 2 * d))
        m[..., :d] = positions[:, None]
        P[..., :d, :d] = noise[:, None]
        P[..., d:, d:] = speed**2 * np.eye(d)
        return Beliefs(np.tile(self.shares, (n, 1)), Gaussians(m, P))

    def predict(self, beliefs: Beliefs, dt: float) -> Beliefs:
        """Mix, and move on by `dt` seconds."""
        F, Q, Pi = self.transition(dt)
        joint = beliefs.weights[:, :, None] * Pi
        c = joint.sum(axis=1)
        shares = np.swapaxes(joint / c[:, None], 1, 2)
        return Beliefs(c, predicted(_merged(shares, beliefs.states), F, Q))

    def correct(self, beliefs: Beliefs, measured: FloatArray, noise: FloatArray) -> Beliefs:
        """Take in one measured position (n, d) per track, with its error's covariance."""
        states, log = corrected(beliefs.states, measured[:, None], noise[:, None])
        w = beliefs.weights * np.exp(log - log.max(axis=1, keepdims=True))
        w = np.maximum(w / w.sum(axis=1, keepdims=True), _LEAST)
        return Beliefs(w / w.sum(axis=1, keepdims=True), states)


def _merged(shares: FloatArray, states: Gaussians) -> Gaussians:
    """Mean and covariance of mixtures: shares (n, K, M) of states (n, M, ...) give (n, K, ...)."""
    (n, K, M), (m, P) = shares.shape, states
    nx = m.shape[-1]
    means = shares @ m
    within = (shares @ P.reshape(n, M, nx * nx)).reshape(n, K, nx, nx)
    apart = m[:, None] - means[:, :, None]
    between = np.swapaxes(apart * shares[..., None], -2, -1) @ apart
    return Gaussians(means, within + between)
