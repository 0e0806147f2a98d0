"""Disturbances that act on the robot but are unknown to the controller.

Each says what it adds to the nominal next state, step by step:

    x_{k+1} = f(x_k, u_k) + push_k(u_k)
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from scp_mpc.arrays import FloatArray, as_array
from scp_mpc.models.linear import LinearModel

Push = Callable[[FloatArray], FloatArray]


class Disturbance(Protocol):
    """Something that acts on a robot."""

    def begin(self, model: LinearModel, rng: np.random.Generator) -> Push:
        """Return a new run's push: from the input (nu,) of each step, in turn, to (nx,)."""
        ...


@dataclass(frozen=True)
class CorrelatedDisturbance:
    """The report's wind (III.F): w_k = alpha w_{k-1} + std * N(0, 1), from w = 0.

    Args:
        alpha: Correlation from one step to the next.
        std: (nx,) standard deviation of each step's innovation, in units of the state.
    """

    alpha: float = 0.85
    std: tuple[float, ...] = (0.0, 0.08, 0.0, 0.08)

    def samples(self, rng: np.random.Generator) -> Iterator[FloatArray]:
        """Yield w_0, w_1, ... without end, each (nx,)."""
        std = np.array(self.std)
        w = np.zeros(len(std))
        while True:
            w = self.alpha * w + std * rng.standard_normal(len(std))
            yield w

    def begin(self, model: LinearModel, rng: np.random.Generator) -> Push:  # noqa: ARG002
        """See `Disturbance`."""
        wind = self.samples(rng)
        return lambda _: next(wind)


@dataclass(frozen=True)
class ConstantPush:
    """A push that never changes, as of an unknown weight or a slope.

    Args:
        force: (nu,) what is added to the input, in its unit; its bounds do not apply.
    """

    force: tuple[float, ...] = (0.4, 0.4)

    def begin(self, model: LinearModel, rng: np.random.Generator) -> Push:  # noqa: ARG002
        """See `Disturbance`."""
        push: FloatArray = model.B @ as_array("force", self.force, (model.nu,))
        return lambda _: push
