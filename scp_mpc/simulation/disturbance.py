"""Disturbances that act on the robot but are unknown to the controller."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import FloatArray


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
