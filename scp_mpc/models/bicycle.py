"""The kinematic bicycle: a car that does not slip.

Notation:
    x = [p1, p2, theta, v, delta]   position [m], heading [rad], speed of the rear axle [m/s],
                                    steering angle [rad]
    u = [a, sigma]                  acceleration [m/s^2], steering rate [rad/s]
    L                               wheelbase [m]
    l                               from the rear axle forward to the position [m]
    omega = v tan(delta) / L        turn rate [rad/s]
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from scp_mpc.arrays import FloatArray, as_count, as_number
from scp_mpc.errors import BoundsError
from scp_mpc.models.model import as_period, courses, indices
from scp_mpc.models.runge_kutta import ComponentModel


@dataclass(frozen=True, eq=False)
class KinematicBicycle(ComponentModel):
    """A car whose wheels roll where they point.

        p' = v (cos, sin)(theta) + l omega (-sin, cos)(theta)
        theta' = omega,  v' = a,  delta' = sigma

        x = [p1, p2, theta, v, delta]   position [m], heading [rad], speed [m/s], steering [rad]
        u = [a, sigma]                  acceleration [m/s^2], steering rate [rad/s]

    The position is the point of the car's axis `rear` ahead of the rear axle, and v the speed of
    that axle: so the rolling needs no slip angle, wherever the point is. Put it in the middle of
    the disc that stands for the car. Singular at delta = +-pi/2 only: bound it.

    Args:
        dt: Sampling time [s].
        wheelbase: L [m].
        rear: l [m], 0 for the rear axle, L/2 for the middle.
        substeps: Runge-Kutta steps per interval.

    Raises:
        BoundsError: dt or the wheelbase is not positive, or there is no step.
    """

    dt: float
    wheelbase: float
    rear: float = 0.0
    substeps: int = 1

    nx = 5
    nu = 2
    heading = 2
    position = indices(0, 1)
    velocity = indices(3)

    def __post_init__(self) -> None:
        """Check the numbers."""
        object.__setattr__(self, "dt", as_period(self.dt))
        object.__setattr__(self, "wheelbase", as_number("wheelbase", self.wheelbase))
        object.__setattr__(self, "rear", as_number("rear", self.rear))
        object.__setattr__(self, "substeps", as_count("substeps", self.substeps))
        if self.wheelbase <= 0:
            raise BoundsError("wheelbase", f"{self.wheelbase} m is not positive")

    def rates(self, x: Any, u: Any, lib: Any) -> tuple[Any, ...]:
        """Return the five rates of change."""
        _, _, theta, v, delta = x
        c, s = lib.cos(theta), lib.sin(theta)
        omega = v * lib.tan(delta) / self.wheelbase
        side = self.rear * omega
        return v * c - side * s, v * s + side * c, omega, u[0], u[1]

    def jacobians(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Return dg/dz (..., 5, 7) at states (..., 5) and inputs (..., 2)."""
        c, s, v, bend, rise = self._parts(states)
        slopes = np.zeros((*inputs.shape[:-1], 5, 7))
        by_delta = v * rise
        side = self.rear * v * bend
        slopes[..., 0, 2] = -(v * s + side * c)
        slopes[..., 1, 2] = v * c - side * s
        for column, turning, ahead in ((3, bend, 1.0), (4, by_delta, 0.0)):
            side = self.rear * turning
            slopes[..., 0, column] = ahead * c - side * s
            slopes[..., 1, column] = ahead * s + side * c
            slopes[..., 2, column] = turning
        slopes[..., 3, 5] = slopes[..., 4, 6] = 1.0
        return slopes

    def hessian(self, states: FloatArray, inputs: FloatArray, weights: FloatArray) -> FloatArray:
        """Return sum_k m_k (Hessian of g_k in z), (..., 7, 7), for weights m (..., 5)."""
        c, s, v, bend, rise = self._parts(states)
        ahead = weights[..., 0] * c + weights[..., 1] * s
        aside = weights[..., 1] * c - weights[..., 0] * s
        turning = weights[..., 2] + self.rear * aside
        bent = np.zeros((*inputs.shape[:-1], 7, 7))
        bent[..., 2, 2] = -v * (ahead + self.rear * bend * aside)
        bent[..., 2, 3] = bent[..., 3, 2] = aside - self.rear * bend * ahead
        bent[..., 2, 4] = bent[..., 4, 2] = -self.rear * v * rise * ahead
        bent[..., 3, 4] = bent[..., 4, 3] = turning * rise
        bent[..., 4, 4] = turning * v * (2.0 * self.wheelbase * bend * rise)
        return bent

    def stopping_input(self, x: FloatArray) -> FloatArray:
        """Return the input (2,) that stops it within one interval, the wheel held."""
        return np.array([-x[3] / self.dt, 0.0])

    def state(self, position: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return states (..., 5) at positions (..., 2) with velocities (..., 2).

        The steering is that of the circle through neighbouring samples, at a single one straight.
        """
        course = courses(velocity)
        speed = np.linalg.norm(velocity, axis=-1)
        turning = np.zeros_like(course)
        if course.ndim and course.shape[-1] > 1:
            turning = np.gradient(course, self.dt, axis=-1)
        # the sideways part of the speed is l omega; beyond what a circle allows it is cut off
        limit = 0.9 * speed / max(abs(self.rear), 1e-9)
        turning = np.clip(turning, -limit, limit)
        side = self.rear * turning
        v = np.sqrt(speed**2 - side**2)
        delta = np.where(v > 0, np.arctan2(self.wheelbase * turning, v), 0.0)
        moving = np.stack([course - np.arctan2(side, v), v, delta], axis=-1)
        return np.concatenate([position, moving], axis=-1)

    def _parts(self, states: FloatArray) -> tuple[FloatArray, ...]:
        """Cosine and sine of theta, v, tan(delta) / L and its derivative."""
        tangent = np.tan(states[..., 4])
        c, s = np.cos(states[..., 2]), np.sin(states[..., 2])
        rise = (1.0 + tangent**2) / self.wheelbase
        return c, s, states[..., 3], tangent / self.wheelbase, rise
