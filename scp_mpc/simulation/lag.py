"""Actuators that take their time.

    tau da/dt = u_k - a  within interval k, a = 0 at the start
    a_{k+1}   = u_k + (a_k - u_k) e^{-dt / tau}
    mean      = u_k + (a_k - u_k) (1 - e^{-dt / tau}) tau / dt

The robot gets the mean of each interval in place of u_k.
"""

from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import FloatArray, as_number
from scp_mpc.errors import BoundsError
from scp_mpc.models.linear import LinearModel
from scp_mpc.simulation.disturbance import Push


@dataclass(frozen=True)
class ActuatorLag:
    """A first-order lag on all inputs.

    Args:
        time_constant: tau [s].

    Raises:
        BoundsError: tau is not positive.
    """

    time_constant: float = 0.1

    def __post_init__(self) -> None:
        """Check the number."""
        if as_number("time_constant", self.time_constant) <= 0:
            raise BoundsError("time_constant", f"{self.time_constant} s is not positive")

    def begin(self, model: LinearModel, rng: np.random.Generator) -> Push:  # noqa: ARG002
        """See `Disturbance`."""
        ratio = self.time_constant / model.dt
        kept = float(np.exp(-1 / ratio))
        actuator = np.zeros(model.nu)

        def push(u: FloatArray) -> FloatArray:
            nonlocal actuator
            behind = actuator - u
            actuator = u + kept * behind
            lost: FloatArray = model.B @ ((1 - kept) * ratio * behind)
            return lost

        return push
