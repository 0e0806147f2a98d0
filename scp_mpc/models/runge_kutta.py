"""Continuous dynamics x' = g(x, u) by the classical Runge-Kutta method, derivatives included.

Notation:
    z = (x, u)          state and held input together, n = nx + nu
    h                   time of one step, a share of dt / substeps
    k_i = g(x_i, u)     slopes, i = 1..4, at x_i = x + c_i h k_(i-1) with c = (0, 1/2, 1/2, 1)
    x + h sum b_i k_i   the state after, with b = (1, 2, 2, 1) / 6
    W_i (n, n)          derivative of (x_i, u) with respect to z
    y (nx,)             costates: weights of the entries of the state after
    m_i (nx,)           costates of k_i

The derivatives are those of the formulas above, not of the flow that they approximate, so A and B
agree with `advance` to rounding errors. For the curvature the chain rule runs backwards through
the slopes and leaves a sum of four sandwiches,

    sum_i W_i' (sum_k m_ik Hessian of g_k at (x_i, u)) W_i .

Source: Hairer, Norsett and Wanner, Solving Ordinary Differential Equations I, II.1.
"""

import math
from abc import abstractmethod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray
from scp_mpc.models.differences import differences
from scp_mpc.models.model import Linearisation, Model, joined

_NODES = (0.0, 0.5, 0.5, 1.0)
_WEIGHTS = (1 / 6, 1 / 3, 1 / 3, 1 / 6)


class ContinuousModel(Model):
    """x' = g(x, u), in `substeps` Runge-Kutta steps per interval with the input held."""

    substeps: int

    @abstractmethod
    def derivative(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Return g (..., nx) at states (..., nx) and inputs (..., nu)."""

    @abstractmethod
    def jacobians(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Return dg/dz (..., nx, nx+nu) at states (..., nx) and inputs (..., nu)."""

    def hessian(self, states: FloatArray, inputs: FloatArray, weights: FloatArray) -> FloatArray:
        """Return sum_k m_k (Hessian of g_k in z), (..., n, n), for weights m (..., nx).

        Here from central differences of `jacobians`.
        """

        def gradients(z: FloatArray) -> FloatArray:
            both = self.jacobians(z[..., : self.nx], z[..., self.nx :])
            return (weights[..., None, :] @ both)[..., 0, :]

        bent = differences(gradients, joined(states, inputs))
        return 0.5 * (bent + np.swapaxes(bent, -2, -1))

    def advance(
        self, states: FloatArray, inputs: FloatArray, fraction: ArrayLike = 1.0
    ) -> FloatArray:
        """Return the states (..., nx) after a share of an interval with the input held."""
        return self._march(*self._broadcast(states, inputs, fraction))[1]

    def linearise(
        self, states: FloatArray, inputs: FloatArray, fraction: ArrayLike = 1.0
    ) -> Linearisation:
        """Return `advance` with its exact derivatives; arguments as there."""
        x, u, h = self._broadcast(states, inputs, fraction)
        points, after = self._march(x, u, h)
        slopes = self.jacobians(points, np.broadcast_to(u, (len(points), *u.shape)))
        both = self._chain(slopes, h[..., None])[1]
        return Linearisation(after, both[..., : self.nx], both[..., self.nx :])

    def curvature(
        self,
        states: FloatArray,
        inputs: FloatArray,
        costates: FloatArray,
        fraction: ArrayLike = 1.0,
    ) -> FloatArray:
        """Return sum_k y_k (Hessian of f_k in z), (..., n, n), exactly."""
        x, u, h = self._broadcast(states, inputs, fraction)
        y = np.broadcast_to(costates, x.shape)
        weighed = y.any(axis=-1)  # of the nodes within an interval obstacles push few
        if weighed.all():
            return self._curvature(x, u, h, y)
        bent = np.zeros((*weighed.shape, (n := self.nx + self.nu), n))
        h = np.broadcast_to(h, (*weighed.shape, 1))
        if weighed.any():
            bent[weighed] = self._curvature(*(part[weighed] for part in (x, u, h, y)))
        return bent

    def _curvature(
        self, x: FloatArray, u: FloatArray, h: FloatArray, costates: FloatArray
    ) -> FloatArray:
        points, _ = self._march(x, u, h)
        inputs = np.broadcast_to(u, (len(points), *u.shape))
        slopes = self.jacobians(points, inputs)
        W, _ = self._chain(slopes, h[..., None])
        m, y = np.empty_like(points), costates
        for first in range(len(points) - 4, -1, -4):
            total, after, share = y, y, 0.0
            for i in (3, 2, 1, 0):
                m[first + i] = (_WEIGHTS[i] * h) * y + (share * h) * after
                by_x = slopes[first + i, ..., : self.nx]
                after, share = (m[first + i, ..., None, :] @ by_x)[..., 0, :], _NODES[i]
                total = total + after
            y = total
        bent = self.hessian(points, inputs, m)
        return (np.swapaxes(W, -2, -1) @ (bent @ W)).sum(axis=0)

    def _broadcast(
        self, states: FloatArray, inputs: FloatArray, fraction: ArrayLike
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """States and inputs with the same leading axes, and h (..., 1)."""
        h = np.asarray(fraction, dtype=np.float64)[..., None] * (self.dt / self.substeps)
        states, inputs = np.asarray(states, np.float64), np.asarray(inputs, np.float64)
        lead = states.shape[:-1]
        if inputs.shape[:-1] != lead or h.ndim > 1:
            lead = np.broadcast_shapes(lead, inputs.shape[:-1], h.shape[:-1])
            states = np.broadcast_to(states, (*lead, states.shape[-1]))
            inputs = np.broadcast_to(inputs, (*lead, inputs.shape[-1]))
        return states, inputs, h

    def _march(self, x: FloatArray, u: FloatArray, h: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points x_i (4 substeps, ..., nx) and the state after."""
        points = np.empty((4 * self.substeps, *x.shape))
        half, sixth = 0.5 * h, h / 6
        for first in range(0, len(points), 4):
            points[first] = x
            k1 = self.derivative(x, u)
            points[first + 1] = x2 = x + half * k1
            k2 = self.derivative(x2, u)
            points[first + 2] = x3 = x + half * k2
            k3 = self.derivative(x3, u)
            points[first + 3] = x4 = x + h * k3
            x = x + sixth * (k1 + 2.0 * (k2 + k3) + self.derivative(x4, u))
        return points, x

    def _chain(self, slopes: FloatArray, h: FloatArray) -> tuple[FloatArray, FloatArray]:
        """W (4 substeps, ..., n, n), and the derivative (..., nx, n) of the state after."""
        nx, n = self.nx, self.nx + self.nu
        W = np.zeros((*slopes.shape[:-2], n, n))
        W.reshape(-1, n * n)[:, :: n + 1] = 1.0
        both = W[0, ..., :nx, :]
        for first in range(0, len(slopes), 4):
            start, total, k = both, both, slopes[0]
            for i in range(4):
                if i:
                    W[first + i, ..., :nx, :] = start + (_NODES[i] * h) * k
                elif first:
                    W[first, ..., :nx, :] = start
                if first + i:
                    k = slopes[first + i] @ W[first + i]
                total = total + (_WEIGHTS[i] * h) * k
            both = total
        return W, both


class ComponentModel(ContinuousModel):
    """Dynamics written once for the entries of state and input, be they numbers or arrays."""

    @abstractmethod
    def rates(self, x: Any, u: Any, lib: Any) -> tuple[Any, ...]:
        """Return the nx entries of g; `lib` has sin, cos and tan for these entries."""

    def derivative(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Return g (..., nx) at states (..., nx) and inputs (..., nu)."""
        x = [states[..., i] for i in range(self.nx)]
        u = [inputs[..., i] for i in range(self.nu)]
        entries = self.rates(x, u, np)
        slopes = np.empty(states.shape)
        for i, entry in enumerate(entries):
            slopes[..., i] = entry
        return slopes

    def _next(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state (nx,), in plain numbers: for one state they are the quicker."""
        now, held = x.tolist(), u.tolist()
        h = self.dt / self.substeps
        half, sixth = 0.5 * h, h / 6
        for _ in range(self.substeps):
            k1 = self.rates(now, held, math)
            k2 = self.rates([a + half * k for a, k in zip(now, k1, strict=True)], held, math)
            k3 = self.rates([a + half * k for a, k in zip(now, k2, strict=True)], held, math)
            k4 = self.rates([a + h * k for a, k in zip(now, k3, strict=True)], held, math)
            slopes = zip(now, k1, k2, k3, k4, strict=True)
            now = [x + sixth * (a + 2.0 * (b + c) + d) for x, a, b, c, d in slopes]
        return np.array(now)
