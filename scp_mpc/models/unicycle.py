"""The unicycle: a robot with two driven wheels, or anything that goes where its nose points.

Notation:
    x = [p1, p2, theta, v]      position [m], heading [rad], speed [m/s]
    u = [a, omega]              acceleration [m/s^2], turn rate [rad/s]
    h                           time advanced [s]
    mu = omega h / 2            half the angle turned
    alpha = a h / 2             half the speed gained
    j_n                         spherical Bessel functions
    p1 + i p2                   the plane, in complex numbers
"""

from cmath import rect
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scp_mpc.arrays import FloatArray
from scp_mpc.models.bessel import bessel, bessel_pair
from scp_mpc.models.model import Linearisation, Model, as_period, courses, indices

ComplexArray = NDArray[np.complex128]
_IDENTITY = np.eye(4, 6)


@dataclass(frozen=True, eq=False)
class Unicycle(Model):
    """p' = v (cos theta, sin theta), theta' = omega, v' = a, integrated exactly for held inputs.

        x = [p1, p2, theta, v]      position [m], heading [rad], speed [m/s]
        u = [a, omega]              acceleration [m/s^2], turn rate [rad/s]

    With the angle halfway, theta + mu, and the mean speed, v + alpha, the way is

        h exp(i (theta + mu)) (  (v + alpha) j_0(mu) + i alpha j_1(mu)  )

    at any turn rate, zero included. A negative speed is reversing.

    Args:
        dt: Sampling time [s].

    Raises:
        BoundsError: dt is not positive.
    """

    dt: float

    nx = 4
    nu = 2
    heading = 2
    position = indices(0, 1)
    velocity = indices(3)

    def __post_init__(self) -> None:
        """Check dt."""
        object.__setattr__(self, "dt", as_period(self.dt))

    def advance(
        self, states: FloatArray, inputs: FloatArray, fraction: ArrayLike = 1.0
    ) -> FloatArray:
        """Return the states (..., 4) after a share of an interval with the input held."""
        return _Arc(states, inputs, self._time(fraction)).after()

    def _next(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state (4,)."""
        p1, p2, theta, v = x.tolist()
        a, omega = u.tolist()
        h = self.dt
        alpha, mu = 0.5 * h * a, 0.5 * h * omega
        j0, j1 = bessel_pair(mu)
        way = rect(h, theta + mu) * complex((v + alpha) * j0, alpha * j1)
        return np.array([p1 + way.real, p2 + way.imag, theta + h * omega, v + h * a])

    def linearise(
        self, states: FloatArray, inputs: FloatArray, fraction: ArrayLike = 1.0
    ) -> Linearisation:
        """Return `advance` with its exact derivatives; arguments as there."""
        arc = _Arc(states, inputs, self._time(fraction))
        after = arc.after()
        both = np.zeros((*after.shape, 6))
        both[...] = _IDENTITY
        for column, slope in enumerate(arc.slopes(), start=2):
            both[..., 0, column], both[..., 1, column] = slope.real, slope.imag
        both[..., 2, 5] = both[..., 3, 4] = arc.h
        return Linearisation(after, both[..., :4], both[..., 4:])

    def curvature(
        self,
        states: FloatArray,
        inputs: FloatArray,
        costates: FloatArray,
        fraction: ArrayLike = 1.0,
    ) -> FloatArray:
        """Return sum_k y_k (Hessian of f_k in (x, u)), (..., 6, 6), after that share of dt."""
        arc = _Arc(states, inputs, self._time(fraction))
        y = np.asarray(costates)
        dual = y[..., 0] - 1j * y[..., 1]
        bent = np.zeros((*np.broadcast_shapes(arc.way.shape, dual.shape), 6, 6))
        for (row, column), entry in arc.hessian().items():
            bent[..., row, column] = bent[..., column, row] = (dual * entry).real
        return bent

    def stopping_input(self, x: FloatArray) -> FloatArray:
        """Return the input (2,) that stops it within one interval, straight on."""
        return np.array([-x[3] / self.dt, 0.0])

    def state(self, position: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return states (..., 4) at positions (..., 2) heading the way of velocities (..., 2)."""
        speed = np.linalg.norm(velocity, axis=-1)
        moving = np.stack([courses(velocity), speed], axis=-1)
        return np.concatenate([position, moving], axis=-1)

    def _time(self, fraction: ArrayLike) -> float | FloatArray:
        return self.dt * (fraction if isinstance(fraction, float) else np.asarray(fraction))


class _Arc:
    """The way (...) as complex numbers, and its derivatives."""

    def __init__(self, states: FloatArray, inputs: FloatArray, h: Any) -> None:
        """Evaluate from states (..., 4) with inputs (..., 2) held for times h (...)."""
        states, inputs = np.asarray(states, np.float64), np.asarray(inputs, np.float64)
        self.states, self.inputs, self.h, self.half = states, inputs, h, 0.5 * h
        mu = self.half * inputs[..., 1]
        self.alpha = self.half * inputs[..., 0]
        self.speed = states[..., 3] + self.alpha
        self.j = bessel(mu)
        self.turned = h * np.exp(1j * (states[..., 2] + mu))
        self.way = self.turned * self.mixed(*self.j[:2])

    def mixed(self, j0: FloatArray, j1: FloatArray) -> ComplexArray:
        """Weigh both functions, or their derivatives, by the mean speed and half the gain."""
        return self.speed * j0 + 1j * (self.alpha * j1)

    def after(self) -> FloatArray:
        """States (..., 4) at its end."""
        after = np.empty((*self.way.shape, 4))
        after[..., :2] = self.states[..., :2]
        after[..., 0] += self.way.real
        after[..., 1] += self.way.imag
        after[..., 2] = self.states[..., 2] + self.h * self.inputs[..., 1]
        after[..., 3] = self.speed + self.alpha
        return after

    def slopes(self) -> tuple[ComplexArray, ComplexArray, ComplexArray, ComplexArray]:
        """Derivatives of the way with respect to theta, v, a and omega."""
        j0, j1, j2, _ = self.j
        half = self.half * self.turned
        by_theta = 1j * self.way
        by_omega = self.half * by_theta + half * self.mixed(-j1, (j0 - 2.0 * j2) / 3.0)
        return by_theta, self.turned * j0, half * (j0 + 1j * j1), by_omega

    def hessian(self) -> dict[tuple[int, int], ComplexArray]:
        """Second derivatives that are not zero, by pairs of indices within (x, u)."""
        _, by_v, by_a, by_omega = self.slopes()
        j0, j1, j2, j3 = self.j
        half = self.half * self.turned
        bend = self.mixed((2.0 * j2 - j0) / 3.0, (2.0 * j3 - 3.0 * j1) / 5.0)
        turning = 1j * by_a
        return {
            (2, 2): -self.way,
            (2, 3): 1j * by_v,
            (2, 4): turning,
            (2, 5): 1j * by_omega,
            (3, 5): turning,
            (4, 5): self.half * half * (1j / 3.0 * (4.0 * j0 - 2.0 * j2) - 2.0 * j1),
            (5, 5): self.half * (2j * by_omega + self.half * self.way + half * bend),
        }
