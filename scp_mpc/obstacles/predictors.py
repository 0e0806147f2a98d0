"""Predictors: from where an obstacle is and how it moves to Gaussians along the horizon.

Notation:
    mu      (N+1, d)        mean positions          mu_v    (N+1, d)      mean velocities
    Sigma   (N+1, d, d)     position covariances    Sigma_v (N+1, d, d)   velocity covariances
    omega                   turn rate of the mean velocity [rad/s]
"""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from scp_mpc.arrays import FloatArray
from scp_mpc.obstacles.prediction import ObstaclePrediction

# The report's numbers (III.B).
_POSITION_COVARIANCE = ((0.5, 0.3), (0.3, 0.2))  # [m^2]
_VELOCITY_COVARIANCE = ((0.3, 0.1), (0.1, 0.1))  # [m^2/s^2]
_FUTURE_VELOCITY_COVARIANCE = ((0.08, 0.05), (0.05, 0.03))  # [m^2/s^2], indefinite as printed


class Predictor(Protocol):
    """Predicts one obstacle from its measured position and velocity."""

    def predict(
        self, position: FloatArray, velocity: FloatArray, radius: float, horizon: int, dt: float
    ) -> ObstaclePrediction:
        """Return the prediction over `horizon` intervals of `dt` seconds."""
        ...


@dataclass(frozen=True, eq=False)
class ReportPredictor:
    """The report's predictor: equations (10), (11a) and (11b).

    mu_{i}    = mu_{i-1}    + dt/2   (mu_v_i    + mu_v_{i-1})           (11a)
    Sigma_{i} = Sigma_{i-1} + dt^2/4 (Sigma_v_i + Sigma_v_{i-1})        (11b)

    The mean velocity turns with `turn_rate`, so that (11a) follows the circle. (11b) adds the
    velocity errors as if they were independent from one step to the next. The velocity
    covariance Sigma_v_i = (1 + 0.1 i) [[.08, .05], [.05, .03]] for i >= 1 is used as printed: it
    is indefinite, but the position covariance that follows from it is positive definite.
    """

    turn_rate: float = 0.12
    position_covariance: FloatArray = field(default_factory=lambda: np.array(_POSITION_COVARIANCE))
    velocity_covariance: FloatArray = field(default_factory=lambda: np.array(_VELOCITY_COVARIANCE))

    def predict(
        self, position: FloatArray, velocity: FloatArray, radius: float, horizon: int, dt: float
    ) -> ObstaclePrediction:
        """Predict a planar obstacle; see the class."""
        i = np.arange(horizon + 1)
        mu_v = _turned(velocity, self.turn_rate * dt * i)
        growth = (1 + 0.1 * i)[:, None, None]
        Sigma_v = growth * np.array(_FUTURE_VELOCITY_COVARIANCE)
        Sigma_v[0] = self.velocity_covariance
        return ObstaclePrediction(
            means=_accumulated(np.asarray(position), dt / 2 * (mu_v[1:] + mu_v[:-1])),
            covariances=_accumulated(
                self.position_covariance, dt**2 / 4 * (Sigma_v[1:] + Sigma_v[:-1])
            ),
            radius=radius,
            dt=dt,
        )


@dataclass(frozen=True, eq=False)
class ConstantVelocityPredictor:
    """A velocity that is constant but unknown: its error grows with time, not with its root.

    mu_i    = mu_0 + i dt mu_v
    Sigma_i = Sigma_0 + (i dt)^2 Sigma_v

    With the report's Sigma_v this is 11 m^2 along x after 6 s, where (11b) gives 0.62 m^2.
    """

    position_covariance: FloatArray = field(default_factory=lambda: np.array(_POSITION_COVARIANCE))
    velocity_covariance: FloatArray = field(default_factory=lambda: np.array(_VELOCITY_COVARIANCE))

    def predict(
        self, position: FloatArray, velocity: FloatArray, radius: float, horizon: int, dt: float
    ) -> ObstaclePrediction:
        """Predict an obstacle in the plane or in space; see the class."""
        t = dt * np.arange(horizon + 1)
        return ObstaclePrediction(
            means=np.asarray(position) + t[:, None] * np.asarray(velocity),
            covariances=self.position_covariance + (t**2)[:, None, None] * self.velocity_covariance,
            radius=radius,
            dt=dt,
        )


def _turned(velocity: FloatArray, angles: NDArray[np.floating]) -> FloatArray:
    """Rotate one planar velocity by each of the angles, (n, 2)."""
    c, s = np.cos(angles), np.sin(angles)
    return np.stack([c * velocity[0] - s * velocity[1], s * velocity[0] + c * velocity[1]], axis=-1)


def _accumulated(start: FloatArray, increments: FloatArray) -> FloatArray:
    return np.concatenate([start[None], start + np.cumsum(increments, axis=0)])
