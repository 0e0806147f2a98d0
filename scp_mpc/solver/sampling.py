"""The points of a plan at which the obstacles are constrained: samples, and points in between.

A longer robot is covered by several discs along its heading; then each is a point of its own.

Notation:
    N, K        intervals, instants in each of them; the last one is the sample
    n           discs of the robot
    C_k, D_k    position after k/K of an interval: C_k x_i + D_k u_i, k = 1 .. K-1
    phi         (N K d,)    forces on the positions
"""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scp_mpc.arrays import FloatArray
from scp_mpc.problem import Problem
from scp_mpc.robots.linear import LinearModel
from scp_mpc.robots.model import Model


class Sampling(ABC):
    """Positions of a plan at all points.

    Args:
        model: The robot.
        horizon: N.
        instants: K.
        discs: n.

    Attributes:
        instants: K.
        discs: n.
        count: Points in each interval, K n.
        points: N K n.
        first: What clocks call a descent's first program with so many points.
    """

    def __init__(self, model: Model, horizon: int, instants: int, discs: int = 1) -> None:
        """Count the points."""
        self.instants, self.discs, self.count = instants, discs, instants * discs
        self.points = horizon * self.count
        self.first = f"first program, {instants}"
        self._horizon, self._position = horizon, model.position

    @staticmethod
    def of(problem: Problem, instants: int) -> "Sampling":
        """The sampling for a problem's robot."""
        if isinstance(problem.model, LinearModel):
            return LinearSampling(problem.model, problem.horizon, instants)
        return NonlinearSampling(problem.model, problem.horizon, instants, problem.discs)

    @abstractmethod
    def positions(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Positions (N K n, d) of states (N+1, nx) and inputs (N, nu)."""

    def now(self, x0: FloatArray) -> FloatArray:
        """Positions (n, d) in the state now (nx,)."""
        return x0[None, self._position]

    def sag(self, states: FloatArray, inputs: FloatArray) -> float:  # noqa: ARG002
        """How far a plan's path bends off its chords, where the points do not show it [m]."""
        return 0.0

    @abstractmethod
    def track(self, states: FloatArray, inputs: int) -> FloatArray:
        """Positions (N K n, d) along states (N+1, nx) that deviations are added to."""

    def interpolated(self, values: FloatArray, axis: int = 1) -> FloatArray:
        """Values at stages 0 .. N along an axis, linearly interpolated at all points: 0 .. N K n.

        For covariances this errs on the safe side: if the obstacle moves in a straight line from
        one sample to the next, that of the position in between is no larger, whatever the
        correlation of both.
        """
        if self.count == 1:
            return values
        K, stages = self.instants, np.moveaxis(values, axis, 0)
        share = np.arange(1, K + 1).reshape(-1, *[1] * (stages.ndim - 1)) / K
        before, after = stages[:-1, None], stages[1:, None]
        inner = (1 - share) * before + share * after
        inner = inner.reshape(self._horizon * K, *stages.shape[1:])  # also without any obstacle
        inner = self.repeated(inner, axis=0)
        return np.moveaxis(np.concatenate([stages[:1], inner]), 0, axis)

    def repeated(self, values: FloatArray, axis: int) -> FloatArray:
        """Values at all instants along an axis, repeated for each disc."""
        return values if self.discs == 1 else np.repeat(values, self.discs, axis=axis)

    def stages(self, values: NDArray[Any]) -> NDArray[Any]:
        """Group values (..., N K n) by interval: (..., N, K n)."""
        return values.reshape(*values.shape[:-1], self._horizon, self.count)


class LinearSampling(Sampling):
    """The points of a linear robot.

    Attributes:
        C: ((K-1) d, nx) all C_k.
        D: ((K-1) d, nu) all D_k.
    """

    def __init__(self, model: LinearModel, horizon: int, instants: int) -> None:
        """Find the positions' dependence on state and input."""
        super().__init__(model, horizon, instants)
        self._shape = horizon, model.nx
        maps = [model.between(k / instants) for k in range(1, instants)]
        self.C = np.concatenate([np.zeros((0, model.nx)), *(C for C, _ in maps)])
        self.D = np.concatenate([np.zeros((0, model.nu)), *(D for _, D in maps)])

    def positions(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """See the base class."""
        samples = states[1:, self._position]
        if self.count == 1:
            return samples
        return self._merged(states[:-1] @ self.C.T + inputs @ self.D.T, samples)

    def track(self, states: FloatArray, inputs: int) -> FloatArray:
        """See the base class."""
        return self.positions(states, np.zeros((self._horizon, inputs)))

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
        forces = phi.reshape(self._horizon, -1)
        on_e, dim = np.zeros(self._shape), len(self._position)
        on_e[:, self._position] = forces[:, -dim:]
        if self.count == 1:
            return on_e, None
        between = forces[:, :-dim]
        on_e[:-1] += between[1:] @ self.C
        return on_e, between @ self.D

    def _merged(self, between: FloatArray, samples: FloatArray) -> FloatArray:
        merged: FloatArray = np.concatenate([between, samples], axis=1)
        return merged.reshape(self.points, -1)


class NonlinearSampling(Sampling):
    """The points of a nonlinear robot.

    Args:
        model: The robot.
        horizon: N.
        instants: K.
        discs: (n,) where the discs' centres are, from the position along the heading [m].
    """

    def __init__(self, model: Model, horizon: int, instants: int, discs: FloatArray) -> None:
        """Remember the robot and its body."""
        super().__init__(model, horizon, instants, len(discs))
        self._model, self._discs = model, discs
        self._plain = len(discs) == 1 and discs[0] == 0
        self._shares = np.arange(1, instants)[:, None] / instants

    def positions(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """See the base class."""
        whole = states[None, 1:]
        if self.instants > 1:
            inner = self._model.advance(states[None, :-1], inputs[None], self._shares)
            whole = np.concatenate([inner, whole])
        return np.swapaxes(self._bodies(whole), 0, 1).reshape(self.points, -1)

    def sag(self, states: FloatArray, inputs: FloatArray) -> float:
        """See the base class; at the middle between two instants."""
        shares = np.arange(2 * self.instants + 1)[:, None] / (2 * self.instants)
        path = self._bodies(self._model.advance(states[None, :-1], inputs[None], shares))
        bend = path[1::2] - (path[:-1:2] + path[2::2]) / 2
        return float(np.sqrt(np.add.reduce(bend * bend, axis=-1).max()))

    def track(self, states: FloatArray, inputs: int) -> FloatArray:  # noqa: ARG002
        """See the base class; on the straight way from sample to sample."""
        share = np.arange(1, self.instants + 1)[:, None] / self.instants
        before, after = states[:-1, None, self._position], states[1:, None, self._position]
        return self.repeated(((1 - share) * before + share * after).reshape(-1, before.shape[2]), 0)

    def now(self, x0: FloatArray) -> FloatArray:
        """See the base class."""
        return self._bodies(x0)

    def derivatives(
        self, states: FloatArray, inputs: FloatArray
    ) -> tuple[FloatArray, tuple[FloatArray, FloatArray] | None, FloatArray]:
        """Positions as above, and their derivatives; see `VaryingMotion`."""
        N = self._horizon
        at = self._slopes(states[1:])
        if self.instants == 1:
            return self._bodies(states[None, 1:]).reshape(self.points, -1), None, at
        inner = self._model.linearise(states[None, :-1], inputs[None], self._shares)
        whole = np.concatenate([inner.after, states[None, 1:]])
        positions = np.swapaxes(self._bodies(whole), 0, 1).reshape(self.points, -1)
        slopes = self._slopes(inner.after)
        C, D = (
            np.swapaxes(slopes @ M, 0, 1).reshape(N, -1, M.shape[-1]) for M in (inner.A, inner.B)
        )
        return positions, (C, D), at

    def curvature(
        self, states: FloatArray, inputs: FloatArray, nu: FloatArray, phi: FloatArray
    ) -> tuple[FloatArray, FloatArray | None]:
        """Second derivatives of nu' f and phi' p: (N, nx+nu, nx+nu) in x_i and u_i.

        The second are those (N,) in the headings at the samples, to which discs add; or None.

        Args:
            states: (N+1, nx) of a plan.
            inputs: (N, nu).
            nu: (N, nx) multipliers of the dynamics.
            phi: (N K n d,) forces on the positions.
        """
        before, K = states[None, :-1], self.instants
        forces = np.swapaxes(phi.reshape(self._horizon, K, -1), 0, 1)
        costates, shares = nu[None], np.ones((1, 1))
        bent = np.zeros((self._horizon,) + (states.shape[1] + inputs.shape[1],) * 2)
        if K > 1 and self._plain:
            pulls = np.zeros((K - 1, *nu.shape))
            pulls[:, :, self._position] = forces[:-1]
        elif K > 1:
            inner = self._model.linearise(before, inputs[None], self._shares)
            pulls = (forces[:-1, :, None] @ self._slopes(inner.after))[:, :, 0]
            turns = np.concatenate([inner.A, inner.B], axis=-1)[:, :, self._model.heading]
            sway = self._sway(inner.after, forces[:-1])[..., None, None]
            bent += (sway * turns[..., :, None] * turns[..., None, :]).sum(axis=0)
        if K > 1:
            costates, shares = np.concatenate([pulls, costates]), np.vstack([self._shares, shares])
        bent += self._model.curvature(before, inputs[None], costates, shares).sum(axis=0)
        return bent, None if self._plain else self._sway(states[1:], forces[-1])

    def _sway(self, states: FloatArray, forces: FloatArray) -> FloatArray:
        """Second derivatives (...) of forces' (..., n d) p in the heading."""
        theta = states[..., self._model.heading, None]
        ahead = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
        pushed = forces.reshape(*forces.shape[:-1], self.discs, -1)
        sway: FloatArray = -(self._discs * (pushed * ahead).sum(axis=-1)).sum(axis=-1)
        return sway

    def _bodies(self, states: FloatArray) -> FloatArray:
        """Centres (..., n, d) of the discs."""
        centre = states[..., None, self._position]
        if self._plain:
            return centre
        theta = states[..., self._model.heading, None]
        ahead = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
        body: FloatArray = centre + self._discs[:, None] * ahead
        return body

    def _slopes(self, states: FloatArray) -> FloatArray:
        """Their derivatives (..., n d, nx) with respect to the state."""
        d, nx = len(self._position), self._model.nx
        slopes = np.zeros((*states.shape[:-1], self.discs, d, nx))
        slopes[..., np.arange(d), self._position] = 1.0
        if not self._plain:
            theta = states[..., self._model.heading, None]
            slopes[..., 0, self._model.heading] = -self._discs * np.sin(theta)
            slopes[..., 1, self._model.heading] = self._discs * np.cos(theta)
        return slopes.reshape(*states.shape[:-1], self.discs * d, nx)
