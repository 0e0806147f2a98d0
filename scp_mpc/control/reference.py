"""References: the states that the plan is to track."""

from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import SampledArray


@dataclass(frozen=True)
class CircularReference:
    """The report's reference (III.D): a circle about the origin at constant angular velocity.

    Args:
        radius: R [m].
        angular_velocity: omega_ref [rad/s]; the speed is R omega_ref.
    """

    radius: float = 8.0
    angular_velocity: float = 0.52

    def states(self, time: float, horizon: int, dt: float) -> SampledArray:
        """States (N+1, 4) of a planar double integrator from `time` [s] on, every `dt` [s]."""
        angle = self.angular_velocity * (time + dt * np.arange(horizon + 1))
        c, s = np.cos(angle), np.sin(angle)
        speed = self.radius * self.angular_velocity
        x_ref = np.stack([self.radius * c, -speed * s, self.radius * s, speed * c], axis=-1)
        return SampledArray.of(x_ref, dt)
