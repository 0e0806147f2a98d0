"""Ways in which an obstacle may move: straight on, or in a turn, under accelerations at random.

Notation:
    p, v    (d,)        position [m] and velocity [m/s]; the state is x = [p, v], nx = 2 d
    omega               turn rate [rad/s]; J turns by a right angle
    q                   spectral density of the white acceleration a [m^2/s^3]
    T                   interval [s], of any length; phi = omega T
    F, Q    (nx, nx)    x(t + T) = F x(t) + noise, noise ~ N(0, Q)

    dp/dt = v,    dv/dt = omega J v + a

Both models are discretised exactly (Bar-Shalom, Li and Kirubarajan, 2001, 6.2.2 and 11.7.1; there
the turning noise is approximate): with R the rotation by phi,

    sigma = sin(phi)/phi,   beta = (1 - cos(phi))/phi^2,   gamma = (phi - sin(phi))/phi^3

    F = [[I, T (sigma I + phi beta J)],       Q = q [[2 gamma T^3 I,               sym.    ],
         [0, R                       ]]              [T^2 (beta I + phi gamma J),  T I     ]]

For omega = 0 that is the constant velocity's Q = q [[T^3/3, T^2/2], [T^2/2, T]].
"""

from dataclasses import dataclass
from math import cos, sin

import numpy as np

from scp_mpc.arrays import FloatArray, as_number
from scp_mpc.errors import BoundsError
from scp_mpc.settings import require_positive

_SMALL = 1e-3  # [rad]; below this phi - sin(phi) has lost half its digits
_QUARTER: FloatArray = np.array([[0.0, -1.0], [1.0, 0.0]])


@dataclass(frozen=True)
class Motion:
    """Constant velocity (turn rate 0) or a coordinated turn, with white accelerations.

    Attributes:
        density: q > 0, the variance that each second adds to each component of the velocity
            [m^2/s^3].
        turn_rate: omega [rad/s], positive to the left; in the plane only.
        weight: How often obstacles move like this, relative to the other motions.
    """

    density: float
    turn_rate: float = 0.0
    weight: float = 1.0

    def __post_init__(self) -> None:
        """Check every number."""
        require_positive("density", self.density)
        require_positive("weight", self.weight)
        if abs(as_number("turn_rate", self.turn_rate)) > 100:
            raise BoundsError("turn_rate", f"{self.turn_rate} rad/s: are these degrees?")

    def transition(self, dt: float, dim: int = 2) -> tuple[FloatArray, FloatArray]:
        """Return F and Q over `dt` seconds; see the module.

        Raises:
            BoundsError: A negative dt, or a turn that is not in the plane.
        """
        T = as_number("dt", dt)
        if T < 0:
            raise BoundsError("dt", f"{T} s is negative")
        if self.turn_rate and dim != 2:
            raise BoundsError("turn_rate", f"{self.turn_rate} rad/s turns in {dim} dimensions")
        phi, q, d = self.turn_rate * T, self.density, dim
        half = sin(phi / 2) / (phi / 2) if phi / 2 else 1.0  # the smallest float has no half
        sigma, beta = sin(phi) / phi if phi else 1.0, half * half / 2
        gamma = (phi - sin(phi)) / phi**3 if abs(phi) > _SMALL else 1 / 6 - phi**2 / 120
        F, Q = np.zeros((2, 2 * d, 2 * d))
        eye = np.eye(d)
        J = _QUARTER if d == 2 else np.zeros((d, d))
        F[:d, :d], F[:d, d:] = eye, T * (sigma * eye + phi * beta * J)
        F[d:, d:] = cos(phi) * eye + sin(phi) * J
        Q[:d, :d], Q[d:, d:] = 2 * q * gamma * T**3 * eye, q * T * eye
        Q[d:, :d] = q * T**2 * (beta * eye + phi * gamma * J)
        Q[:d, d:] = Q[d:, :d].T
        return F, Q
