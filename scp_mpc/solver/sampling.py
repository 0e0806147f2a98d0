"""The points of a plan at which the obstacles are constrained: samples, and points in between.

Notation:
    N, K        intervals, points in each of them; the last one is the sample
    C_k, D_k    position after k/K of an interval: C_k x_i + D_k u_i, k = 1 .. K-1
    phi         (N K d,)    forces on the positions
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scp_mpc.arrays import FloatArray
from scp_mpc.robots.linear import LinearModel


class Sampling:
    """Positions of a plan at K points per interval, and what forces there do to it.

    Args:
        model: The robot.
        horizon: N.
        count: K.

    Attributes:
        points: N K.
        first: What clocks call a descent's first program with so many points.
    """

    def __init__(self, model: LinearModel, horizon: int, count: int) -> None:
        """Find the positions' dependence on state and input."""
        self.count, self.points = count, horizon * count
        self.first = f"first program, {count}"
        self._position, self._shape = model.position, (horizon, model.nx)
        maps = [model.between(k / count) for k in range(1, count)]
        self.C = np.concatenate([np.zeros((0, model.nx)), *(C for C, _ in maps)])
        self.D = np.concatenate([np.zeros((0, model.nu)), *(D for _, D in maps)])

    def positions(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Positions (N K, d) of states (N+1, nx) and inputs (N, nu)."""
        samples = states[1:, self._position]
        if self.count == 1:
            return samples
        return self._merged(states[:-1] @ self.C.T + inputs @ self.D.T, samples)

    def deviations(self, e: FloatArray, inputs: FloatArray) -> FloatArray:
        """The same of deviations e (N, nx) at stages 1 .. N; there is none at stage 0."""
        samples = e[:, self._position]
        if self.count == 1:
            return samples
        between = inputs @ self.D.T
        between[1:] += e[:-1] @ self.C.T
        return self._merged(between, samples)

    def pull(self, phi: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """What forces phi do: (N, nx) on e, and (N, nu) on the inputs, or None for nothing."""
        forces = phi.reshape(self._shape[0], -1)
        on_e, dim = np.zeros(self._shape), len(self._position)
        on_e[:, self._position] = forces[:, -dim:]
        if self.count == 1:
            return on_e, None
        between = forces[:, :-dim]
        on_e[:-1] += between[1:] @ self.C
        return on_e, between @ self.D

    def interpolated(self, values: FloatArray, axis: int = 1) -> FloatArray:
        """Values at stages 0 .. N along an axis, linearly interpolated at all points: 0 .. N K.

        For covariances this errs on the safe side: if the obstacle moves in a straight line from
        one sample to the next, that of the position in between is no larger, whatever the
        correlation of both.
        """
        if self.count == 1:
            return values
        stages = np.moveaxis(values, axis, 0)
        share = np.arange(1, self.count + 1).reshape(-1, *[1] * (stages.ndim - 1)) / self.count
        before, after = stages[:-1, None], stages[1:, None]
        inner = ((1 - share) * before + share * after).reshape(-1, *stages.shape[1:])
        return np.moveaxis(np.concatenate([stages[:1], inner]), 0, axis)

    def stages(self, values: NDArray[Any]) -> NDArray[Any]:
        """Group values (..., N K) by interval: (..., N, K)."""
        return values.reshape(*values.shape[:-1], self._shape[0], self.count)

    def _merged(self, between: FloatArray, samples: FloatArray) -> FloatArray:
        merged: FloatArray = np.concatenate([between, samples], axis=1)
        return merged.reshape(self.points, -1)
