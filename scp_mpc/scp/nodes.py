"""Collision nodes: where along a plan the obstacles are constrained, and what happens in between.

Each interval has K instants, the last of which is the sample; a longer robot is covered by n discs
along its heading, and each is a node of its own. Between two instants, if the centres of robot and
obstacle are r' apart at both and move l relative to each other along a straight line, they never
come closer than sqrt(r'^2 - (l/2)^2). A held input bends the robot's way by b off its chord. So the
radii r are kept everywhere if the nodes of an interval keep

    r' = sqrt((r + b)^2 + (l/2)^2)      with l and b of that interval

Notation:
    N, K, n     intervals, instants in each of them, discs of the robot
    C           nodes of the plan, N K n
    C_k, D_k    position after k/K of an interval: C_k x_i + D_k u_i, k = 1 .. K-1
    phi         (C d,)  forces on the positions
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scp_mpc.arrays import FloatArray
from scp_mpc.models.linear import LinearModel
from scp_mpc.models.model import Model
from scp_mpc.problem import Problem

_RESERVE = 1.2  # of what is assumed about a plan over what is known of the one before


@dataclass(frozen=True, eq=False)
class Motion:
    """Bounds of a robot's motion between two neighbouring instants, interval by interval.

    Attributes:
        chord: (N,) longest straight way [m].
        deviation: (N,) largest distance of the path from it [m].
    """

    chord: FloatArray
    deviation: FloatArray

    def reserved(self, other: "Motion", least: float) -> "Motion":
        """What covers this and another motion, also a little earlier or later, with a reserve.

        Args:
            other: The other one.
            least: Deviation that is assumed in any case [m].
        """
        chord = _RESERVE * _widened(np.maximum(self.chord, other.chord))
        deviation = _RESERVE * _widened(np.maximum(self.deviation, other.deviation))
        return Motion(chord, np.maximum(deviation, least))

    def covers(self, other: "Motion") -> bool:
        """Whether another motion stays within these bounds."""
        return bool((other.chord <= self.chord).all() and (other.deviation <= self.deviation).all())


class Nodes(ABC):
    """The collision nodes of a robot's plans.

    Args:
        model: The robot.
        horizon: N.
        instants: K.
        discs: n.

    Attributes:
        instants: K.
        discs: n.
        count: Nodes in each interval, K n.
        size: C.
    """

    def __init__(self, model: Model, horizon: int, instants: int, discs: int = 1) -> None:
        """Count the nodes."""
        self.instants, self.discs, self.count = instants, discs, instants * discs
        self.size = horizon * self.count
        self._horizon, self._position = horizon, model.position

    @staticmethod
    def of(problem: Problem) -> "Nodes":
        """The nodes of a problem's robot."""
        model, N, K = problem.model, problem.horizon, problem.nodes_per_interval
        if isinstance(model, LinearModel):
            most = np.maximum(np.abs(problem.u_min), np.abs(problem.u_max))
            return LinearNodes(model, N, K, most)
        return NonlinearNodes(model, N, K, problem.discs)

    @abstractmethod
    def positions(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Positions (C, d) of states (N+1, nx) and inputs (N, nu)."""

    @abstractmethod
    def derivatives(
        self, states: FloatArray, inputs: FloatArray
    ) -> tuple[FloatArray, tuple[FloatArray, FloatArray] | None, FloatArray]:
        """Positions (C, d), and their derivatives.

        Returns:
            The positions; those between samples by x_i and u_i, (N, m, nx) and (N, m, nu), or None
            if K = 1; and those at the samples by x_{i+1}, (N, n d, nx).
        """

    @abstractmethod
    def deviation(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """How far the path bends off its chords in each interval, (N,) [m]."""

    @property
    def most_deviation(self) -> float:
        """How far the largest inputs bend it, where that does not depend on the plan [m]."""
        return 0.0

    def now(self, x0: FloatArray) -> FloatArray:
        """Positions (n, d) in the state now (nx,)."""
        return x0[None, self._position]

    def motion(self, states: FloatArray, inputs: FloatArray) -> Motion:
        """What a plan does between its nodes."""
        path = np.concatenate([self.now(states[0]), self.positions(states, inputs)])
        path = path.reshape(-1, self.discs, path.shape[1])
        way = path[1:] - path[:-1]
        length = np.sqrt(np.add.reduce(way * way, axis=-1))
        chord = length.reshape(self._horizon, -1).max(axis=1)
        return Motion(chord, self.deviation(states, inputs))

    def radii(self, radii: FloatArray, drift: FloatArray, motion: Motion) -> FloatArray:
        """The radii r' (J, C) that leave room for a motion.

        Args:
            radii: (J, C) r [m].
            drift: (J, C) way of the obstacles between two instants [m].
            motion: Of the robot.
        """
        chord, bend = (np.repeat(part, self.count) for part in (motion.chord, motion.deviation))
        wide: FloatArray = np.hypot(radii + bend, (chord + drift) / 2)
        intervals, n = self.stages(wide), self.discs
        # A sample also begins the next interval, and has to leave room for what happens there.
        ends = intervals[:, :-1, -n:]
        ends[:] = np.maximum(ends, intervals[:, 1:, :n])
        return wide

    def interpolated(self, values: FloatArray, axis: int = 1) -> FloatArray:
        """Values at stages 0 .. N along an axis, linearly interpolated at all nodes: 0 .. C.

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
        """Group values (..., C) by interval: (..., N, K n)."""
        return values.reshape(*values.shape[:-1], self._horizon, self.count)


class LinearNodes(Nodes):
    """The nodes of a linear robot: positions are linear in state and input, always the same.

    Args:
        model: The robot.
        horizon: N.
        instants: K.
        most: (nu,) largest inputs.
    """

    def __init__(
        self, model: LinearModel, horizon: int, instants: int, most: FloatArray | None = None
    ) -> None:
        """Find the positions' dependence on state and input."""
        super().__init__(model, horizon, instants)
        K, d = instants, len(self._position)
        self._C, self._D, *bend = model.within(K)
        self._bend = bend[0].T, bend[1].T
        none = np.zeros(model.nu) if most is None else most
        most_bent = np.abs(bend[1].reshape(K, d, -1)) @ none
        self._most = float(np.linalg.norm(most_bent, axis=1).max())
        at = np.zeros((horizon, d, model.nx))
        at[:, np.arange(d), self._position] = 1.0
        C, D = (np.repeat(part[None], horizon, axis=0) for part in (self._C, self._D))
        self._slopes: tuple[tuple[FloatArray, FloatArray] | None, FloatArray]
        self._slopes = None if K == 1 else (C, D), at

    def positions(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """See the base class."""
        samples = states[1:, self._position]
        if self.count == 1:
            return samples
        between = states[:-1] @ self._C.T + inputs @ self._D.T
        return np.concatenate([between, samples], axis=1).reshape(self.size, -1)

    def derivatives(
        self, states: FloatArray, inputs: FloatArray
    ) -> tuple[FloatArray, tuple[FloatArray, FloatArray] | None, FloatArray]:
        """See the base class."""
        return self.positions(states, inputs), *self._slopes

    def deviation(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """See the base class; at the middle between two instants."""
        bend = states[:-1] @ self._bend[0] + inputs @ self._bend[1]
        bend = bend.reshape(self._horizon, self.instants, -1)
        deviation: FloatArray = np.sqrt(np.add.reduce(bend * bend, axis=2).max(axis=1))
        return deviation

    @property
    def most_deviation(self) -> float:
        """See the base class."""
        return self._most


class NonlinearNodes(Nodes):
    """The nodes of a nonlinear robot.

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
        self._halves = np.arange(2 * instants + 1)[:, None] / (2 * instants)

    def positions(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """See the base class."""
        whole = states[None, 1:]
        if self.instants > 1:
            inner = self._model.advance(states[None, :-1], inputs[None], self._shares)
            whole = np.concatenate([inner, whole])
        return np.swapaxes(self._bodies(whole), 0, 1).reshape(self.size, -1)

    def deviation(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """See the base class; at the middle between two instants."""
        path = self._bodies(self._model.advance(states[None, :-1], inputs[None], self._halves))
        bend = path[1::2] - (path[:-1:2] + path[2::2]) / 2
        length = np.sqrt(np.add.reduce(bend * bend, axis=-1))
        deviation: FloatArray = length.max(axis=(0, 2))
        return deviation

    def now(self, x0: FloatArray) -> FloatArray:
        """See the base class."""
        return self._bodies(x0)

    def derivatives(
        self, states: FloatArray, inputs: FloatArray
    ) -> tuple[FloatArray, tuple[FloatArray, FloatArray] | None, FloatArray]:
        """See the base class."""
        N = self._horizon
        at = self._slopes(states[1:])
        if self.instants == 1:
            return self._bodies(states[None, 1:]).reshape(self.size, -1), None, at
        inner = self._model.linearise(states[None, :-1], inputs[None], self._shares)
        whole = np.concatenate([inner.after, states[None, 1:]])
        positions = np.swapaxes(self._bodies(whole), 0, 1).reshape(self.size, -1)
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
            phi: (C d,) forces on the positions.
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


def _widened(values: FloatArray) -> FloatArray:
    """The largest of each value (N,) and its neighbours."""
    wide = values.copy()
    wide[1:] = np.maximum(wide[1:], values[:-1])
    wide[:-1] = np.maximum(wide[:-1], values[1:])
    return wide
