"""The report's obstacle: it travels on a circle at constant angular velocity (III.B)."""

from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import FloatArray


@dataclass(frozen=True)
class CircularObstacle:
    """True motion p(t) = R [cos theta, sin theta] with theta = theta_0 + omega t.

    Args:
        track_radius: Radius R of the circle about the origin [m].
        angular_velocity: omega [rad/s].
        start_angle: theta_0 [rad].
        radius: Radius of the obstacle itself [m].
    """

    track_radius: float = 8.0
    angular_velocity: float = 0.12
    start_angle: float = np.deg2rad(55.0)
    radius: float = 0.2

    def position(self, time: float) -> FloatArray:
        """Position (2,) [m] at `time` [s]."""
        theta = self.start_angle + self.angular_velocity * time
        return self.track_radius * np.array([np.cos(theta), np.sin(theta)])

    def velocity(self, time: float) -> FloatArray:
        """Velocity (2,) [m/s] at `time` [s]."""
        theta = self.start_angle + self.angular_velocity * time
        speed = self.track_radius * self.angular_velocity
        return speed * np.array([-np.sin(theta), np.cos(theta)])
