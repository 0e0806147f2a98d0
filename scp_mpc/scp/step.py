"""What one control step brings, checked before the solver is touched.

Notation:
    J, M    obstacles of this step, slots for them
    C       collision nodes, at which they are constrained: K in each interval
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    as_array,
    require_positive_semidefinite,
    require_sampled,
)
from scp_mpc.errors import TooManyObstaclesError
from scp_mpc.geometry.margin import Margin
from scp_mpc.geometry.no_go import NoGoSets
from scp_mpc.geometry.polytopes import Polytopes
from scp_mpc.geometry.risk import risk_bound
from scp_mpc.models.model import Model
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.obstacles.predictions import ObstaclePredictions, as_predictions
from scp_mpc.problem import Problem
from scp_mpc.scp.braking import braking
from scp_mpc.scp.nodes import Nodes

Braked = Literal["none", "outside", "all"]

_TICK = 1e-9
_TOUCH = 1e-9  # [m] within another body that is not
_OUTSIDE = 1e-9  # of a bound, in its own unit, that is not
_SIGMAS = 3.0  # standard deviations that an obstacle's way may differ from its mean's by


@dataclass(frozen=True, eq=False)
class Step:
    """The validated state, reference and obstacles of one control step.

    Attributes:
        problem: The problem to which they belong.
        x0: (nx,) state now.
        x_ref: (N+1, nx) reference, row 0 not weighted.
        obstacles: The J predictions.
        nodes: Where the plan is constrained.
        means: (J, C+1, d) expected positions, row 0 now [m].
        radii: (J, C) sums of the radii, or more where gaps between nodes ask for it [m].
        robot_covariance: (N+1, d, d) of the robot's own position [m^2], or None.
        scale: (J, C) what multiplies the standard deviations: sizes over s_ref; or None for one.
        u_last: (nu,) input last applied, from which the first rate counts; None for unknown.
        shapes: Which obstacles are polytopes; None if all are round.
    """

    problem: Problem
    x0: FloatArray
    x_ref: FloatArray
    obstacles: ObstaclePredictions
    nodes: Nodes
    means: FloatArray
    radii: FloatArray
    robot_covariance: FloatArray | None = None
    scale: FloatArray | None = None
    u_last: FloatArray | None = None
    shapes: Polytopes | None = None

    @classmethod
    def read(
        cls,
        problem: Problem,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        robot_covariance: ArrayLike | None = None,
        nodes: Nodes | None = None,
        u_last: ArrayLike | None = None,
    ) -> "Step":
        """Check everything and stack the predictions, as they are at the samples.

        Raises:
            InvalidArgumentError: Or one of its subclasses, with the argument and the number.
        """
        model, N, M = problem.model, problem.horizon, problem.max_obstacles
        state = as_array("x0", x0, (model.nx,))
        reference = as_reference(x_ref, N, model, state)
        known = as_predictions(obstacles)
        if len(known) > M:
            raise TooManyObstaclesError("obstacles", f"{len(known)} exceed max_obstacles = {M}")
        stacked = ObstaclePredictions.of(known, N, model.dim, model.dt)
        uncertain = None
        if robot_covariance is not None:
            shape = (model.dim, model.dim)
            uncertain = as_array("robot_covariance", robot_covariance, (N + 1, *shape), shape)
            uncertain = np.broadcast_to(uncertain, (N + 1, *shape))
            require_positive_semidefinite("robot_covariance", uncertain)
        last = None if u_last is None else as_array("u_last", u_last, (model.nu,))
        nodes = Nodes.of(problem) if nodes is None else nodes
        radii = np.repeat((problem.robot_radius + stacked.radii)[:, None], nodes.size, axis=1)
        means = nodes.interpolated(stacked.means)
        given = problem, state, reference, stacked, nodes, means, radii, uncertain
        shapes = None if stacked.shapes is None else Polytopes.of(stacked)
        step = cls(*given, u_last=last, shapes=shapes)
        return step if isinstance(problem.margin, Margin) else step.scaled_uniformly()

    @property
    def count(self) -> int:
        """Number of obstacles J."""
        return len(self.obstacles)

    @cached_property
    def covariances(self) -> FloatArray:
        """(J, C+1, d, d) covariances that the sizes s apply to [m^2]."""
        return self._covariances(self._grown)

    def _covariances(self, row: IntArray | None) -> FloatArray:
        covariances = self.obstacles.covariances
        if row is not None:
            covariances = covariances[np.arange(self.count)[:, None], row]
        if self.robot_covariance is not None:
            covariances = covariances + self.robot_covariance
        covariances = self.nodes.interpolated(covariances)
        if self.scale is not None:
            covariances = covariances.copy()
            covariances[:, 1:] *= (self.scale * self.scale)[..., None, None]
        return covariances

    @cached_property
    def largest_stds(self) -> FloatArray:
        """(J, C+1) bounds of the standard deviations in any direction [m]."""
        largest_stds = self._plain_stds
        if self.robot_covariance is None and self.nodes.count == 1 and self.scale is None:
            return largest_stds
        variances = largest_stds * largest_stds
        if self.robot_covariance is not None:
            variances = variances + np.trace(self.robot_covariance, axis1=1, axis2=2)
        largest_stds = np.sqrt(self.nodes.interpolated(variances))
        if self.scale is not None:
            largest_stds[:, 1:] *= self.scale
        return largest_stds

    @cached_property
    def _grown(self) -> IntArray | None:
        """(J, N+1) the row of each prediction that counts at each stage; None for its own."""
        if self.problem.growth_time is None or not self.obstacles:
            return None
        last = int(np.ceil(self.problem.growth_time / self.problem.model.dt - _TICK))
        stds = self.obstacles.largest_stds
        stage = np.arange(stds.shape[1])
        last = min(last, len(stage) - 1)
        return np.where((stage > last) & (stds > stds[:, last, None]), last, stage)

    @cached_property
    def _plain_stds(self) -> FloatArray:
        """(J, N+1) largest standard deviations of the predictions [m]."""
        stds = self.obstacles.largest_stds
        if self._grown is None:
            return stds
        return np.take_along_axis(stds, self._grown, axis=1)

    @cached_property
    def drift(self) -> FloatArray:
        """Way of the obstacles between two instants (J, C) [m].

        That of the mean, and three standard deviations of what the covariance grows by.
        """
        nodes, now = self.nodes, self.means[:, :1]
        means = np.concatenate([now, self.means[:, nodes.discs :: nodes.discs]], axis=1)
        variances = self._plain_stds**2
        growth = np.sqrt(np.maximum(variances[:, 1:] - variances[:, :-1], 0.0))
        growth = np.repeat(growth / nodes.instants, nodes.instants, axis=1)
        length: FloatArray = np.sqrt(_squared(means[:, 1:] - means[:, :-1]))
        return nodes.repeated(length + _SIGMAS * growth, axis=1)

    @property
    def contact(self) -> tuple[int, ...]:
        """Obstacles that the robot touches now, if they are where they are expected to be."""
        if not self.obstacles:
            return ()
        y = self.nodes.now(self.x0) - self.means[:, :1]  # (J, n, d)
        gaps = np.linalg.norm(y, axis=-1)
        if self.shapes is not None:
            j = self.shapes.slots
            gaps[j] = self.shapes.taken(j).distance(y[j])
        reach = self.problem.robot_radius + self.obstacles.radii
        return tuple(np.flatnonzero(gaps.min(axis=1) < reach - _TOUCH).tolist())

    @property
    def here(self) -> FloatArray:
        """(d,) the robot's position now: positions are counted from there, wherever that is."""
        return self.x0[self.problem.model.position]

    @cached_property
    def braking(self) -> tuple[FloatArray, FloatArray]:
        """Inputs (k, nu) that bring the robot to rest from now on, and states (k+1, nx)."""
        return braking(self.problem, self.x0, self.u_last)

    @property
    def is_outside(self) -> bool:
        """Whether the state now is outside of hard bounds."""
        low, high = self._outside()
        return bool(low.any() or high.any())

    def _outside(self) -> tuple[BoolArray, BoolArray]:
        """Which hard rows (nb,) are below their bounds now, and which are above."""
        (lower, upper), hard = self.problem.row_bounds, ~self.problem.soft_rows
        here = self.problem.state_rows @ self.x0
        return hard & (here < lower - _OUTSIDE), hard & (here > upper + _OUTSIDE)

    def row_bounds(self, braked: Braked = "none") -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds (N, nb) of E x at stages 1 .. N, E = `Problem.state_rows`.

        Args:
            braked: Which of the hard ones go as far as full braking does: none, those that are
                outside their bounds now, or all.
        """
        problem, rows = self.problem, self.problem.state_rows
        lower, upper = (np.tile(bound, (problem.horizon, 1)) for bound in problem.row_bounds)
        if braked == "none":
            return lower, upper
        low, high = self._outside()
        if braked == "all":
            low = high = ~problem.soft_rows
        if low.any() or high.any():
            states = self.braking[1][1:] if len(self.braking[0]) else self.x0[None]
            after = np.full((problem.horizon, len(rows)), rows @ states[-1])
            after[: len(states)] = states @ rows.T
            lower = np.where(low, np.minimum(lower, after), lower)
            upper = np.where(high, np.maximum(upper, after), upper)
        return lower, upper

    def path(self, away: FloatArray) -> FloatArray:
        """Positions (C+1, d) [m] from now on, given those of the nodes (C d,) relative to now."""
        here = self.here
        path = np.empty((self.nodes.size + 1, len(here)))
        path[0] = here
        np.add(away.reshape(-1, len(here)), here, out=path[1:])
        return path

    def scaled_uniformly(self) -> "Step":
        """The same with sizes as they are where all points are promised the same."""
        size = self.problem.size_for(self.count, self.nodes.count)
        scale = size / self.problem.size.reference
        return replace(self, scale=None if scale == 1 else np.full(self.radii.shape, scale))

    def widened(self, radii: FloatArray) -> "Step":
        """The same with other radii (J, C); what does not depend on them is not computed again."""
        wide = copy(self)
        vars(wide)["radii"] = radii
        return wide

    def scaled(self, sizes: FloatArray) -> "Step":
        """The same with sizes (J, C) of their own at all nodes."""
        return replace(self, scale=sizes / self.problem.size.reference)

    def within(
        self,
        positions: FloatArray,
        s: FloatArray,
        distance: float,
        known: BoolArray | None = None,
    ) -> BoolArray | None:
        """Which obstacles may be nearer than a distance, (J, C) for nodes 1 .. C; None for none.

        The direction n from the mean to p gives a lower bound of the signed distance to the
        s-sigma ellipsoid, n'(p - mu) - s sqrt(n' Sigma n), and n' Sigma n is at most the largest
        variance. Who is clear by these bounds is clear of either inflation's no-go set. Polytopes
        are measured with the distance itself.

        Args:
            positions: (C+1, d) of the robot [m].
            s: (M,) sizes of the ellipsoids.
            distance: Beyond the radii [m].
            known: (J, C) pairs that need no answer.
        """
        if not self.obstacles:
            return None
        near = self._within_ellipsoids(positions, s, distance, known)
        if self.shapes is None:
            return near
        j = self.shapes.slots
        room = self.shapes.taken(j).distance(positions[1:] - self.means[j, 1:]) - self.radii[j]
        close = room <= s[j, None] * self.largest_stds[j, 1:] + distance
        if known is not None:
            close &= ~known[j]
        near = np.zeros(self.radii.shape, dtype=np.bool_) if near is None else near
        near[j] = close
        return near if near.any() else None

    def _within_ellipsoids(
        self,
        positions: FloatArray,
        s: FloatArray,
        distance: float,
        known: BoolArray | None,
    ) -> BoolArray | None:
        """`within` for obstacles that are round."""
        y = positions[1:] - self.means[:, 1:]
        length2 = _squared(y)
        reach = self.radii + distance
        size = s[: self.count, None]
        least = size * self.largest_stds[:, 1:] + reach
        unclear = length2 <= least * least
        if known is not None:
            unclear &= ~known
        if not unclear.any():
            return None
        y = y[unclear]
        width2 = np.add.reduce(
            (self.covariances[:, 1:][unclear] @ y[..., None])[..., 0] * y, axis=1
        )
        size, reach = (np.broadcast_to(v, unclear.shape)[unclear] for v in (size, reach))
        length2 = length2[unclear]
        close = length2 - size * np.sqrt(np.maximum(width2, 0.0)) <= reach * np.sqrt(length2)
        if not close.any():
            return None
        unclear[unclear] = close
        return unclear

    def depths(self, path: FloatArray, s: FloatArray) -> FloatArray:
        """How deep a path (C, d) enters the no-go sets at sizes s (M,): (J, C) [m]."""
        now = self.x0[self.problem.model.position]
        depths = np.zeros((self.count, len(path)))
        whole = np.concatenate([now[None], path])
        near = self.within(whole, s, 0.0)
        if near is not None:
            j, i = np.nonzero(near)
            covariances = self.covariances[j, i + 1]
            shapes = None if self.shapes is None else self.shapes.taken(j)
            sets = NoGoSets.pairs(self.means[j, i + 1], covariances, self.radii[j, i], shapes)
            before = whole[i] - self.means[j, i]
            g = self.problem.no_go.linearise(sets, path[i][:, None], s[j], before).value
            depths[j, i] = np.maximum(0.0, -g[:, 0])
        return depths

    def risks(self, path: FloatArray) -> FloatArray:
        """Half-space bounds (J, C) of the risks along a path (C, d), for what was predicted."""
        if not self.count:
            return np.zeros((0, self.nodes.size))
        plain = self if self.scale is None else replace(self, scale=None)
        Sigma = plain._covariances(None)[:, 1:]  # a risk is that of the whole prediction
        given = plain.means[:, 1:], Sigma, self.radii, self.count, self.shapes
        return risk_bound(NoGoSets.stacked(*given), path)


def as_reference(x_ref: ArrayLike, horizon: int, model: Model, x0: FloatArray) -> FloatArray:
    """Return the reference (N+1, nx) of a robot in state x0 (nx,), held where it is one state.

    Headings are angles: they are unwrapped, row by row, from that of the state, so that the plan
    never turns the long way round.

    Raises:
        InvalidArgumentError: Or one of its subclasses.
    """
    require_sampled("x_ref", x_ref, model.dt)
    reference = as_array("x_ref", x_ref, (horizon + 1, model.nx), (model.nx,))
    if reference.ndim == 1:
        reference = np.tile(reference, (horizon + 1, 1))
    if model.heading is not None:
        heading = reference[:, model.heading]
        turns = np.rint(np.diff(heading, prepend=x0[model.heading]) / (2 * np.pi))
        if turns.any():
            heading -= 2 * np.pi * np.cumsum(turns)
    return reference


def _squared(vectors: FloatArray) -> FloatArray:
    """Squared lengths (...) of many short vectors (..., d): component by component."""
    total: FloatArray = vectors[..., 0] * vectors[..., 0]
    for k in range(1, vectors.shape[-1]):
        total += vectors[..., k] * vectors[..., k]
    return total
