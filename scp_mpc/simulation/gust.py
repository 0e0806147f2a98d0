"""Gusts: Dryden's turbulence, a Gaussian process with a rational spectrum.

White noise of unit intensity through (MIL-F-8785C, 1980, section 3.7.2; T = L / V)

    along the mean wind     H(s) = sigma sqrt(2 T) / (1 + T s)
    across it, vertical     H(s) = sigma sqrt(T) (1 + sqrt(3) T s) / (1 + T s)^2

which gives gusts of variance sigma^2. The filters are discretised exactly, state matrix and noise
(Van Loan, 1978), and start in their stationary distribution: no time step distorts the spectrum, as
Beal (1993), Digital simulation of atmospheric turbulence for Dryden and von Karman models, JGCD
16(1), shows for the usual approximations. Gusts are held over an interval.

Drag that is linear about the robot's speed turns a gust v into an acceleration c v.

Notation:
    sigma   (d,)    standard deviations [m/s]       L   (d,)    scale lengths [m]
    V               airspeed [m/s]                  c           drag over mass [1/s]
    F, g            filter dz = F z dt + g dW       h           gust v = h z
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky, expm, solve_continuous_lyapunov

from scp_mpc.arrays import FloatArray, as_array, as_number, frozen
from scp_mpc.errors import BoundsError, ShapeError
from scp_mpc.models.linear import LinearModel
from scp_mpc.simulation.disturbance import Push

_FOOT = 0.3048  # [m]


@dataclass(frozen=True, eq=False)
class DrydenGust:
    """Gusts along the axes of the workspace, the first of which is that of the mean wind.

    They act like an input: the robot's inputs must be accelerations along the same axes.

    Args:
        sigma: (d,) standard deviations [m/s].
        length: (d,) scale lengths [m].
        airspeed: V [m/s], at which the frozen field of gusts passes.
        drag: c [1/s].

    Raises:
        BoundsError: A number is not positive.
    """

    sigma: FloatArray
    length: FloatArray
    airspeed: float = 5.0
    drag: float = 0.5

    def __post_init__(self) -> None:
        """Copy and check."""
        for name in ("sigma", "length"):
            array = as_array(name, getattr(self, name), (2,), (3,))
            if array.min() <= 0:
                raise BoundsError(name, f"{array.min()} is not positive")
            object.__setattr__(self, name, frozen(array))
        if len(self.sigma) != len(self.length):
            raise ShapeError("length", f"{len(self.length)} axes, but sigma has {len(self.sigma)}")
        for name in ("airspeed", "drag"):
            number = as_number(name, getattr(self, name))
            if number <= 0:
                raise BoundsError(name, f"{number} is not positive")

    @classmethod
    def low_altitude(
        cls, altitude: float, wind: float, airspeed: float, drag: float = 0.5, dim: int = 2
    ) -> "DrydenGust":
        """Gusts near the ground as in MIL-F-8785C, 3.7.3.4.

        L_w = h, L_u = L_v = h / (0.177 + 0.000823 h)^1.2 with h in feet;
        sigma_w = 0.1 W_20, sigma_u = sigma_v = sigma_w / (0.177 + 0.000823 h)^0.4.

        Args:
            altitude: Above ground [m], 10 to 1,000 feet.
            wind: W_20, mean wind 20 feet above ground [m/s].
            airspeed: V [m/s].
            drag: c [1/s].
            dim: Of the workspace, 2 (horizontal) or 3.

        Raises:
            BoundsError: The altitude is outside the model's range, or a number is not positive.
        """
        h = as_number("altitude", altitude) / _FOOT
        if not 10 <= h <= 1000:
            raise BoundsError("altitude", f"{altitude} m is not within 10 to 1000 feet")
        base = 0.177 + 0.000823 * h
        sigma, length = 0.1 * as_number("wind", wind), altitude
        across, far = sigma / base**0.4, length / base**1.2
        return cls(
            np.array([across, across, sigma][:dim]),
            np.array([far, far, length][:dim]),
            airspeed,
            drag,
        )

    def begin(self, model: LinearModel, rng: np.random.Generator) -> Push:
        """See `Disturbance`.

        Raises:
            ShapeError: The robot has another number of inputs than there are axes.
        """
        if model.nu != len(self.sigma):
            raise ShapeError("sigma", f"{len(self.sigma)} axes for {model.nu} inputs of the robot")
        filters = [self._filter(axis, model.dt) for axis in range(model.nu)]
        states = [spread @ rng.standard_normal(len(spread)) for _, _, spread, _ in filters]

        def push(_: FloatArray) -> FloatArray:
            gusts = np.array([h @ z for (_, _, _, h), z in zip(filters, states, strict=True)])
            for axis, (F, noise, _, _) in enumerate(filters):
                states[axis] = F @ states[axis] + noise @ rng.standard_normal(len(F))
            added: FloatArray = model.B @ (self.drag * gusts)
            return added

        return push

    def _filter(
        self, axis: int, dt: float
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """State matrix of one step, factors of its noise and of the stationary covariance, h."""
        T, sigma = self.length[axis] / self.airspeed, self.sigma[axis]
        if axis == 0:
            F, g = np.array([[-1 / T]]), np.array([[1.0]])
            h = np.array([sigma * np.sqrt(2 / T)])
        else:
            # z_1'' + 2/T z_1' + 1/T^2 z_1 = dW, and v = sigma sqrt(T)/T^2 (z_1 + sqrt(3) T z_1')
            F, g = np.array([[0.0, 1.0], [-1 / T**2, -2 / T]]), np.array([[0.0], [1.0]])
            h = sigma * T**-1.5 * np.array([1.0, np.sqrt(3) * T])
        step = np.asarray(expm(F * dt))
        settled = np.asarray(solve_continuous_lyapunov(F, -g @ g.T))
        # What the noise of one interval adds is what a stationary state loses in it.
        added = settled - step @ settled @ step.T
        return step, _root(added), _root(settled), h


def _root(covariance: FloatArray) -> FloatArray:
    root: FloatArray = np.asarray(cholesky((covariance + covariance.T) / 2, lower=True))
    return root
