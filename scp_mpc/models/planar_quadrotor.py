"""The planar quadrotor: two rotors in a vertical plane.

Notation:
    x = [p1, p2, phi, v1, v2, omega]    position across and up [m], tilt [rad], velocity [m/s],
                                        tilt rate [rad/s]
    u = [T, alpha]                      thrust per mass [m/s^2], angular acceleration [rad/s^2]
    g                                   gravity [m/s^2]
"""

import math
from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np

from scp_mpc.arrays import FloatArray, as_count, as_number, frozen
from scp_mpc.errors import BoundsError
from scp_mpc.models.model import as_period, indices
from scp_mpc.models.runge_kutta import ComponentModel

_PLAIN = SimpleNamespace(
    **{name: getattr(math, name) for name in ("sin", "cos", "atan2", "hypot")}, fmin=min, fmax=max
)


class HoveringModel(ComponentModel):
    """How a robot comes to hover, written once for numbers and for expressions."""

    @abstractmethod
    def stop(self, x: Any, lib: Any) -> tuple[Any, ...]:
        """Return the nu entries of `stopping_input`; `lib` has functions for entries like x's."""

    def stopping_input(self, x: FloatArray) -> FloatArray:
        """Return the input (nu,) that, asked again after each interval, brings it to hover."""
        return np.array(self.stop(np.asarray(x).tolist(), _PLAIN))


@dataclass(frozen=True, eq=False)
class PlanarQuadrotor(HoveringModel):
    """p' = v, v' = T (sin phi, cos phi) - (0, g), phi' = omega, omega' = alpha.

        x = [p1, p2, phi, v1, v2, omega]    position across and up [m], tilt [rad], velocity [m/s],
                                            tilt rate [rad/s]
        u = [T, alpha]                      thrust per mass [m/s^2], angular acceleration [rad/s^2]

    A positive tilt leans towards +p1. The tilt is no heading: the robot moves where it likes.

    Args:
        dt: Sampling time [s].
        gravity: g [m/s^2].
        substeps: Runge-Kutta steps per interval.

    Raises:
        BoundsError: dt or the gravity is not positive, or there is no step.
    """

    dt: float
    gravity: float = 9.81
    substeps: int = 1

    nx = 6
    nu = 2
    position = indices(0, 1)
    velocity = indices(3, 4)

    def __post_init__(self) -> None:
        """Check the numbers."""
        object.__setattr__(self, "dt", as_period(self.dt))
        object.__setattr__(self, "gravity", as_gravity(self.gravity))
        object.__setattr__(self, "substeps", as_count("substeps", self.substeps))

    @cached_property
    def equilibrium_input(self) -> FloatArray:
        """Hover: thrust against gravity."""
        return frozen(np.array([self.gravity, 0.0]))

    def rates(self, x: Any, u: Any, lib: Any) -> tuple[Any, ...]:
        """Return the six rates of change."""
        _, _, phi, v1, v2, omega = x
        thrust, alpha = u
        return v1, v2, omega, thrust * lib.sin(phi), thrust * lib.cos(phi) - self.gravity, alpha

    def jacobians(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Return dg/dz (..., 6, 8) at states (..., 6) and inputs (..., 2)."""
        c, s = np.cos(states[..., 2]), np.sin(states[..., 2])
        slopes = np.zeros((*c.shape, 6, 8))
        slopes[..., 0, 3] = slopes[..., 1, 4] = slopes[..., 2, 5] = slopes[..., 5, 7] = 1.0
        slopes[..., 3, 2] = inputs[..., 0] * c
        slopes[..., 4, 2] = -inputs[..., 0] * s
        slopes[..., 3, 6], slopes[..., 4, 6] = s, c
        return slopes

    def hessian(self, states: FloatArray, inputs: FloatArray, weights: FloatArray) -> FloatArray:
        """Return sum_k m_k (Hessian of g_k in z), (..., 8, 8), for weights m (..., 6)."""
        c, s = np.cos(states[..., 2]), np.sin(states[..., 2])
        m3, m4 = weights[..., 3], weights[..., 4]
        bent = np.zeros((*c.shape, 8, 8))
        bent[..., 2, 2] = -inputs[..., 0] * (m3 * s + m4 * c)
        bent[..., 2, 6] = bent[..., 6, 2] = m3 * c - m4 * s
        return bent

    def stop(self, x: Any, lib: Any) -> tuple[Any, ...]:
        """Return thrust that slows the speed down, and what tilts towards it.

        Within twelve intervals, at half of gravity at most; the tilt twice critically damped.
        """
        g, k = self.gravity, 0.5 / self.dt
        _, _, phi, v1, v2, omega = x
        across, up = (lib.fmin(lib.fmax(-v * k / 6, -g / 2), g / 2) for v in (v1, v2))
        wanted = lib.atan2(across, g + up)
        thrust = lib.fmax(across * lib.sin(phi) + (g + up) * lib.cos(phi), 0.0)
        return thrust, k * k * (wanted - phi) - 2 * k * omega

    def state(self, position: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return states (..., 6) there, level, with velocities (..., 2)."""
        zero = np.zeros((*np.shape(position)[:-1], 1))
        return np.concatenate([position, zero, velocity, zero], axis=-1)


def as_gravity(gravity: object) -> float:
    """Return g [m/s^2].

    Raises:
        BoundsError: It is not positive: nothing would hold the robot's tilt to its motion.
    """
    number = as_number("gravity", gravity)
    if number <= 0:
        raise BoundsError("gravity", f"{number} m/s^2 is not positive")
    return number
