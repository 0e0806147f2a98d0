"""Sequential convex programming on the condensed problem: the fast way for linear robots.

The plan that ignores the obstacles costs one linear system, or one program where inputs reach
their bounds. If it is clear of every obstacle, nothing can be better. Else the descent of
`newton.py` runs on the pairs of obstacle and point that are near; all others stay out, and are
rechecked where it ends.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from scp_mpc.arrays import BoolArray, FloatArray, IntArray
from scp_mpc.problem import Problem
from scp_mpc.settings import Settings
from scp_mpc.solver.active_set import ActiveSetSolver, CondensedProgram
from scp_mpc.solver.certificate import Point
from scp_mpc.solver.condensed import Condensed
from scp_mpc.solver.condensed_step import CondensedStep
from scp_mpc.solver.conflicts import Conflicts
from scp_mpc.solver.descent import Descent, Glimpse, judge
from scp_mpc.solver.iterate import NEGLIGIBLE, Iterate, Multipliers, moved
from scp_mpc.solver.newton import Newton
from scp_mpc.solver.sampling import Sampling
from scp_mpc.solver.step_data import StepData
from scp_mpc.solver.stopwatch import Stopwatch

_NEAR = 2.0  # [m] beyond the no-go set; pairs farther off stay out of the programs
_MANY = 200  # pairs of obstacle and stage beyond which sparse programs are quicker than dense ones


class CondensedSCP:
    """Solves control steps of a problem with linear dynamics and a positive definite Hessian.

    Usage: `begin` a step; then `unhindered`, `free`, `glimpses` and `descend` as often as wanted.
    """

    def __init__(self, problem: Problem, settings: Settings, condensed: Condensed) -> None:
        """Set up the solver of the condensed programs."""
        self._problem, self._settings, self._condensed = problem, settings, condensed
        self._qp = ActiveSetSolver(condensed.response[condensed.boxed])
        self._position = problem.model.position
        self._at: CondensedStep

    @classmethod
    def of(cls, problem: Problem, settings: Settings, sampling: Sampling) -> "CondensedSCP | None":
        """Condense a problem; None where the inputs' Hessian is singular."""
        try:
            return cls(problem, settings, Condensed(problem, sampling))
        except (np.linalg.LinAlgError, RuntimeError):
            return None

    @property
    def finished(self) -> Counter[str]:
        """Programs solved since `begin`, by solver."""
        return self._at.finished

    def begin(self, step: StepData, watch: Stopwatch, like: "CondensedSCP | None" = None) -> None:
        """Read a control step and find the plan that nothing constrains.

        Args:
            step: The control step.
            watch: Its clock.
            like: Who has begun the same step at other points.
        """
        self._qp.limit(watch.deadline)
        known = None if like is None else like._at
        self._at = CondensedStep(self._problem, self._condensed, self._qp, step, watch, known)

    def widen(self, step: StepData) -> None:
        """Take other radii or sizes for the step that has begun."""
        self._at.data = step

    def unhindered(self) -> Descent | None:
        """The plan that ignores the obstacles, if it is clear of them all: none costs less."""
        y, _ = self._at.within_bounds
        if self._at.data.within(self._at.path(y), y[self._condensed.s], 0.0) is not None:
            return None
        point = self._at.free_point()
        certified = point.residuals.worst <= self._settings.tolerance
        return self._ended(point, np.inf, 0) if certified else None

    def free(self) -> Iterate:
        """The plan that ignores the obstacles, which may not be clear of them."""
        return self._iterate(self._at.free_point(), np.inf)

    def free_path(self) -> FloatArray:
        """Its positions (C, d)."""
        return self._at.path(self._at.within_bounds[0])[1:]

    def descend(self, nominal: Iterate, limit: int, goal: Descent | None = None) -> Descent | None:
        """Descend from a nominal plan; None if given up, or if a program could not be solved.

        Args:
            nominal: Where to begin.
            limit: Iterations at most.
            goal: Give up when it is plain that this plan will not be reached.
        """
        at, c, data = self._at, self._condensed, self._at.data
        if not data.count:  # the free plan was the only one, and it did not hold up
            return None
        if not at.watch.affords(c.sampling.first):
            return None
        began = at.watch.elapsed
        p = c.sampling.positions(nominal.states, nominal.inputs) - data.track[1:]
        y = np.concatenate([p.ravel(), nominal.inputs.ravel(), nominal.s])
        near = touched = nominal.touched[: data.count]
        bounds, iterations = self._active_bounds(nominal), 0
        last: Descent | None = None
        while True:
            near = self._near(at.path(y)[None], y[c.s], near)
            if self._too_many(near):
                return last
            conflicts = Conflicts(data, c, near)
            active = np.concatenate([bounds, -touched[near].astype(np.intp)])
            newton = Newton(at, conflicts, self._settings, goal)
            end = newton.descend(y, active, limit - iterations, began)
            if end is None:
                return last
            landing = at.watch.elapsed
            iterations, y = iterations + end.iterations, end.point.y
            missed = data.within(at.path(y), y[c.s], 0.0, known=near)
            depths = None if missed is None else data.depths(at.path(y)[1:], y[c.s])
            last = self._ended(end.point, end.cap, iterations, depths)
            at.watch.learn("landing", landing)
            if missed is None:
                return last
            if iterations >= limit or not at.watch.affords(c.sampling.first):
                return last
            began = at.watch.elapsed
            bounds = end.active[: len(bounds)]
            touched = conflicts.table(end.active[len(bounds) :] != 0, *near.shape)

    def glimpses(
        self, best: Iterate, paths: Sequence[FloatArray], firm: bool = True
    ) -> list[Glimpse]:
        """Solve one program about each path (C, d), all linearised at once, until the deadline.

        Args:
            best: Whose bounds and sizes to begin with.
            paths: Where to linearise; they need not obey the dynamics.
            firm: Whether slack is out of the question.
        """
        if not paths:
            return []
        at, c, data = self._at, self._condensed, self._at.data
        whole = np.empty((len(paths), len(data.track), len(self._position)))
        whole[:, 0], whole[:, 1:] = data.x0[self._position], paths
        here = whole[0].copy()
        here[1:] = c.sampling.positions(best.states, best.inputs)
        known = np.stack([at.path(at.within_bounds[0]), here])
        near = self._near(known, best.s, np.zeros((data.count, len(paths[0])), dtype=np.bool_))
        if self._too_many(near):
            return []
        conflicts = Conflicts(data, c, near)
        with at.watch.linearising:
            a, b = conflicts.about(whole, best.s)
        with at.watch.solving:
            A = np.einsum("ckw,kwn->ckn", a, conflicts.response)
            b -= (a * at.y_free[conflicts.at]).sum(axis=2)
        bounds, cap = self._active_bounds(best), np.inf if firm else self._problem.slack_weight
        found = []
        for rows, least, path in zip(A, b, paths, strict=True):
            if at.watch.remaining < 0:
                break
            found.append(self._glimpse(at.program(rows, least), bounds, cap, conflicts, best, path))
        return found

    def _glimpse(
        self,
        program: CondensedProgram,
        bounds: IntArray,
        cap: float,
        conflicts: Conflicts,
        best: Iterate,
        path: FloatArray,
    ) -> Glimpse:
        shape = self._at.data.count, len(path)
        with self._at.watch.solving, self._at.watch.inside:
            end = self._qp.glimpse(program, bounds, cap)
        if end is None:
            nobody = np.zeros(shape, dtype=np.bool_)
            samples = path[self._condensed.sampling.count - 1 :: self._condensed.sampling.count]
            return Glimpse(np.inf, nobody, path, partial(moved, best, self._position, samples))
        self._at.finished["daqp"] += 1
        v, pushing = end
        y = self._at.y(v)
        merit = self._at.least + float(v @ v) / 2
        if np.isfinite(cap):
            merit += cap * float(np.maximum(program.b - program.A @ v, 0.0).sum())
        start = partial(self._reached, best, y)
        return Glimpse(merit, conflicts.table(pushing, *shape), self._at.path(y)[1:], start)

    def _reached(self, best: Iterate, y: FloatArray) -> Iterate:
        """An iterate's bounds and sizes about the plan y."""
        states = self._at.data.x_ref.copy()
        inputs = y[self._condensed.u].reshape(-1, self._problem.model.nu)
        states[0] = self._at.data.x0
        states[1:] += self._condensed.deviations(inputs)
        return replace(best, states=states, inputs=inputs)

    def _too_many(self, near: BoolArray) -> bool:
        """Whether a sparse program is quicker; with a deadline it is never asked."""
        if self._at.watch.deadline < np.inf:
            return False
        return int(np.count_nonzero(near)) > _MANY * self._condensed.sampling.count

    def _near(self, paths: FloatArray, s: FloatArray, near: BoolArray) -> BoolArray:
        """Pairs in `near` (J, C), or near to one of the paths (c, C+1, d).

        If there is none, those near to the plan that ignores the obstacles; or else all.
        """
        for path in paths:
            more = self._at.data.within(path, s, _NEAR, known=near)
            near = near if more is None else near | more
        if near.any():
            return near
        more = self._at.data.within(self._at.path(self._at.within_bounds[0]), s, _NEAR)
        return ~near if more is None else more

    def _active_bounds(self, nominal: Iterate) -> IntArray:
        """Which bounded entries a nominal plan holds: -1 at lower, 1 at upper bounds."""
        active = np.zeros(self._condensed.boxed.stop - self._condensed.boxed.start, dtype=np.intp)
        duals = nominal.multipliers
        if duals is not None:
            forces = np.concatenate([duals.inputs.ravel(), duals.margin])[: len(active)]
            active[forces < -NEGLIGIBLE], active[forces > NEGLIGIBLE] = -1, 1
        return active

    def _ended(
        self, point: Point, cap: float, iterations: int, depths: FloatArray | None = None
    ) -> Descent:
        """Judge a point; `depths` (J, C) are its violations where pairs were left out."""
        residuals, slack = point.residuals, point.slack
        if depths is None and residuals.feasibility > self._settings.tolerance:
            depths = self._at.data.depths(self._at.path(point.y)[1:], point.y[self._condensed.s])
        most = 0.0 if point.pushed is None else float(point.pushed.slack.max())
        if depths is not None:
            most, slack = float(depths.max(initial=0.0)), float(depths.sum())
            residuals = replace(residuals, feasibility=max(residuals.feasibility, most))
        return Descent(
            partial(self._iterate, point, cap, depths),
            point.cost,
            point.cost + self._problem.slack_weight * slack,
            residuals,
            judge(residuals, most, self._settings.tolerance),
            iterations,
        )

    def _iterate(self, point: Point, cap: float, depths: FloatArray | None = None) -> Iterate:
        """Name the parts of a point in the words of the problem."""
        problem, c, data = self._problem, self._condensed, self._at.data
        N, M, nu = problem.horizon, problem.max_obstacles, problem.model.nu
        states = np.empty_like(data.x_ref)
        states[0] = data.x0
        np.add(data.x_ref[1:], point.deviations, out=states[1:])
        slack, forces = np.zeros((2, M, c.sampling.points))
        margin: FloatArray = -point.reaction[N * nu :] if c.moving_sizes else np.zeros(M)
        if point.pushed is not None:
            pairs, force = point.pushed.conflicts, point.pushed.force
            slack[pairs.obstacle, pairs.point] = point.pushed.slack
            forces[pairs.obstacle, pairs.point] = force
            if not c.moving_sizes:  # the bound takes whatever pushes a size that cannot move
                pull = force * point.pushed.tangent.a[:, -1]
                margin = np.bincount(pairs.obstacle, weights=pull, minlength=M).astype(np.float64)
        if depths is not None:
            slack[: data.count] = depths
        inputs, pins = point.reaction[: N * nu].reshape(N, nu), forces
        if np.isfinite(cap):
            pins = forces - cap
        duals = Multipliers(point.costates, -inputs, margin, -forces, pins)
        u, s = point.y[c.u].reshape(N, nu), point.y[c.s]
        return Iterate(states, u, s, slack, duals).frozen()
