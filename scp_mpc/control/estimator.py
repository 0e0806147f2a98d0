"""What pushes the robot: a Kalman filter on the robot's state and the disturbance behind it.

    z_{k+1} = f(z_k, u_k) + noise,  noise ~ N(0, W)         z = [x; w], see `models/disturbed.py`
    y_k     = H z_k + noise,        noise ~ N(0, V)

    predict     z^- = f(z, u),  S^- = F S F' + W,           F the Jacobian of f at (z, u)
    correct     nu = y - H z^-,  T = H S^- H' + V,  K = S^- H' T^-1
                z = z^- + K nu,  S = (I - K H) S^- (I - K H)' + K V K'

The last line is Joseph's form: symmetric and positive semi-definite whatever the rounding.
Bar-Shalom, Li & Kirubarajan (2001), Estimation with Applications to Tracking and Navigation, ch. 5.
If model and noise are as assumed, nu' T^-1 nu follows a chi-square distribution with ny degrees of
freedom (their section 5.4): `Estimate.surprise` tells whether they are.

Notation:
    z, S    (nz,), (nz, nz)     estimate and its covariance     y   (ny,)       measurement
    W, V    (nz, nz), (ny, ny)  covariances of the noise        H   (ny, nz)
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import cho_factor, cho_solve, solve_discrete_are

from scp_mpc.arrays import FloatArray, as_array, frozen
from scp_mpc.errors import BoundsError, InvalidArgumentError
from scp_mpc.models.disturbed import Disturbed

_FINEST = 1e-6  # a measurement's standard deviation, so that T can be inverted


@dataclass(frozen=True, eq=False)
class Estimate:
    """What is known after a measurement.

    Attributes:
        state: (nx,) of the robot.
        disturbance: (nw,) that acts over the next interval.
        covariance: (nx+nw, nx+nw) of both.
        innovation: (ny,) measurement less its prediction.
        surprise: nu' T^-1 nu of this innovation, about ny where the model holds.
    """

    state: FloatArray
    disturbance: FloatArray
    covariance: FloatArray
    innovation: FloatArray
    surprise: float


class DisturbanceEstimator:
    """Estimates a first-order Gauss-Markov disturbance, and the robot's state, from measurements.

    The first measurement starts it: the state is what is measured (the least one that is, where
    that is not all of it), the disturbance zero with its stationary covariance.

    Args:
        model: The robot with its disturbance.
        std: Standard deviation of what is new in the disturbance at each step, in its own unit:
            a number or (nw,).
        process_std: The same for the rest of the state: what else the model does not know, a number
            or (nx,). Without any, the filter would trust the model over the measurements.
        measurement_std: Standard deviation of the measurement, a number or (ny,). Less than 1e-6
            counts as 1e-6.
        measurement: H (ny, nx), what is measured of the robot's state; all of it if None.
        initial_std: Standard deviation of the state before the first measurement, a number
            or (nx,).

    Raises:
        InvalidArgumentError: Or one of its subclasses, with the argument and the number.
    """

    def __init__(
        self,
        model: Disturbed,
        *,
        std: ArrayLike,
        process_std: ArrayLike = 1e-3,
        measurement_std: ArrayLike = 1e-4,
        measurement: ArrayLike | None = None,
        initial_std: ArrayLike = 10.0,
    ) -> None:
        """Check the noise; nothing is known yet."""
        if not isinstance(model, Disturbed):
            raise InvalidArgumentError("model", f"{model!r} is not a Disturbed")
        nx, nw = model.nominal.nx, model.nw
        C = np.eye(nx) if measurement is None else as_array("measurement", measurement, (-1, nx))
        if not len(C):
            raise InvalidArgumentError("measurement", "nothing is measured")
        fresh = _deviations("std", std, nw)
        self.model = model
        self.measurement = frozen(np.hstack([C, np.zeros((len(C), nw))]))
        self.process_noise = frozen(
            np.diag(np.concatenate([_deviations("process_std", process_std, nx), fresh]) ** 2)
        )
        noise = np.maximum(_deviations("measurement_std", measurement_std, len(C)), _FINEST)
        self.measurement_noise = frozen(np.diag(noise**2))
        settled = fresh**2 / max(1 - model.alpha**2, 1e-3)
        before = _deviations("initial_std", initial_std, nx) ** 2
        self._before = np.diag(np.concatenate([before, settled]))
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next measurement is the first."""
        self._estimate: Estimate | None = None

    def restore(self, estimate: Estimate | None) -> None:
        """Go back to an earlier estimate, as if nothing had been measured since."""
        self._estimate = estimate

    @property
    def estimate(self) -> Estimate | None:
        """The last one; None before the first measurement."""
        return self._estimate

    def update(self, y: ArrayLike, u: ArrayLike | None = None) -> Estimate:
        """Take in a measurement.

        Args:
            y: (ny,) measurement now.
            u: (nu,) input applied since the last measurement; not used with the first one.

        Raises:
            InvalidArgumentError: Or one of its subclasses. The estimator is then as before.
        """
        H, nx = self.measurement, self.model.nominal.nx
        y = as_array("y", y, (len(H),))
        u = None if u is None else as_array("u", u, (self.model.nu,))
        if self._estimate is None:
            z = self.model.joined(np.linalg.pinv(H[:, :nx]) @ y)
            S = self._before
        elif u is None:
            raise InvalidArgumentError("u", "missing: which input was applied since the last call?")
        else:
            last = self._estimate
            z = self.model.joined(last.state, last.disturbance)
            # A model that is not linear brings its own Jacobian: the extended Kalman filter.
            z, S = self.model.step(z, u), self.ahead(last.covariance)
        nu = y - H @ z
        K, S, T = self._corrected(S)
        z = z + K @ nu
        surprise = float(nu @ cho_solve(cho_factor(T), nu))
        self._estimate = Estimate(frozen(z[:nx]), frozen(z[nx:]), frozen(S), frozen(nu), surprise)
        return self._estimate

    def ahead(self, covariance: FloatArray) -> FloatArray:
        """Covariance one step later, before anything is measured."""
        F = self.model.A
        later: FloatArray = F @ covariance @ F.T + self.process_noise
        return later

    def behind(self, covariance: FloatArray) -> FloatArray:
        """Covariance after a measurement, from the one before it."""
        return self._corrected(covariance)[1]

    def settled(self) -> FloatArray:
        """Covariance (nz, nz) after a measurement that it converges to, by Riccati's equation.

        Raises:
            InvalidArgumentError: It does not converge: the measurements do not show everything.
        """
        H = self.measurement
        try:
            S = solve_discrete_are(self.model.A.T, H.T, self.process_noise, self.measurement_noise)
        except (np.linalg.LinAlgError, ValueError) as error:
            raise InvalidArgumentError(
                "measurement", f"does not show state and disturbance ({error})"
            ) from None
        return self.behind(np.asarray(S))

    def _corrected(self, S: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Gain (nz, ny), covariance after a measurement, covariance of the innovation."""
        H, V = self.measurement, self.measurement_noise
        T = H @ S @ H.T + V
        K: FloatArray = cho_solve(cho_factor(T), H @ S).T
        rest = np.eye(len(S)) - K @ H
        after = rest @ S @ rest.T + K @ V @ K.T
        return K, (after + after.T) / 2, T


def _deviations(argument: str, value: ArrayLike, size: int) -> FloatArray:
    """Standard deviations (size,) from one number or as many."""
    array = np.broadcast_to(as_array(argument, value, (), (size,)), size)
    if (array < 0).any():
        raise BoundsError(argument, f"{array.min()} is negative")
    return array
