"""The report's robot: a point mass driven by accelerations (III.A, equation 9)."""

import numpy as np

from scp_mpc.arrays import FloatArray, as_number
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.models.linear import LinearModel


class DoubleIntegrator(LinearModel):
    """A point mass driven by accelerations.

        x = [p1, v1, p2, v2, ...]   position [m] and velocity [m/s] of each axis
        u = [a1, a2, ...]           acceleration [m/s^2]

    Each axis is discretised exactly for an input held over the interval:
    p+ = p + dt v + dt^2/2 a,  v+ = v + dt a.

    Args:
        dt: Sampling time [s].
        dim: Dimension of the workspace, 2 or 3.
    """

    def __init__(self, dt: float, dim: int = 2) -> None:
        """Build A and B as block diagonals over the axes."""
        if isinstance(dim, float) or dim not in (2, 3):
            raise InvalidArgumentError("dim", f"{dim!r} is neither 2 nor 3")
        dt = as_number("dt", dt)
        axes: FloatArray = np.eye(dim)
        super().__init__(
            A=np.kron(axes, np.array([[1.0, dt], [0.0, 1.0]])),
            B=np.kron(axes, np.array([[dt**2 / 2], [dt]])),
            dt=dt,
            position=np.arange(0, 2 * dim, 2),
            velocity=np.arange(1, 2 * dim, 2),
        )

    def state(self, position: FloatArray, velocity: FloatArray) -> FloatArray:
        """Interleave positions (..., d) and velocities (..., d) into states (..., 2 d)."""
        return np.stack([position, velocity], axis=-1).reshape(*np.shape(position)[:-1], -1)
