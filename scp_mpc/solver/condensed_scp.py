"""Sequential convex programming on the condensed problem: the fast way.

The plan that ignores the obstacles costs one linear system, or one program where something else is
bounded; for a nonlinear robot it is a descent of its own. If it is clear of every obstacle, nothing
can be better. Else the descent runs on the pairs of obstacle and point that are near; all others
stay out, and are rechecked where it ends.
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
from scp_mpc.solver.chart import Condensation
from scp_mpc.solver.condensed import Condensed
from scp_mpc.solver.condensed_step import CondensedStep
from scp_mpc.solver.conflicts import Conflicts
from scp_mpc.solver.descent import Descent, Glimpse, judge
from scp_mpc.solver.free_plan import FreePlan, free_linear, free_nonlinear
from scp_mpc.solver.iterate import NEGLIGIBLE, Iterate, Multipliers, moved
from scp_mpc.solver.newton import Newton
from scp_mpc.solver.sampling import LinearSampling, NonlinearSampling, Sampling
from scp_mpc.solver.step_data import StepData
from scp_mpc.solver.stopwatch import Stopwatch
from scp_mpc.solver.trust_region import TrustRegion
from scp_mpc.solver.varying import Varying

_NEAR = 2.0  # [m] beyond the no-go set; pairs farther off stay out of the programs
_MANY = 200  # pairs of obstacle and stage beyond which sparse programs are quicker than dense ones


class CondensedSCP:
    """Solves control steps of a problem whose Hessian in the inputs is positive definite.

    Usage: `begin` a step; then `unhindered`, `free`, `glimpses` and `descend` as often as wanted.
    """

    def __init__(self, problem: Problem, settings: Settings, condensed: Condensation) -> None:
        """Set up the solver of the condensed programs."""
        self._problem, self._settings, self._condensed = problem, settings, condensed
        self._layout = condensed.layout
        self._qp = ActiveSetSolver(self._layout.variables)
        self._search = Newton if isinstance(condensed, Condensed) else TrustRegion
        self._position = problem.model.position
        self._at: CondensedStep
        self._free: FreePlan

    @classmethod
    def of(cls, problem: Problem, settings: Settings, sampling: Sampling) -> "CondensedSCP | None":
        """Condense a problem; None where the inputs' Hessian is singular."""
        if isinstance(sampling, NonlinearSampling):
            return cls(problem, settings, Varying(problem, sampling))
        assert isinstance(sampling, LinearSampling)
        try:
            return cls(problem, settings, Condensed(problem, sampling))
        except (np.linalg.LinAlgError, RuntimeError):
            return None

    @property
    def finished(self) -> Counter[str]:
        """Programs solved since `begin`, by solver."""
        return self._at.finished

    def begin(
        self,
        step: StepData,
        watch: Stopwatch,
        last: Iterate | None = None,
        like: "CondensedSCP | None" = None,
    ) -> None:
        """Read a control step and find the plan that ignores the obstacles.

        Args:
            step: The control step.
            watch: Its clock.
            last: The nominal plan, from which a nonlinear robot's free plan is sought.
            like: Who has begun the same step at other points.
        """
        self._qp.limit(watch.deadline)
        self._at = at = CondensedStep(self._problem, self._condensed, self._qp, step, watch)
        known = None if like is None else (like._at, like._free)
        if isinstance(self._condensed, Condensed):
            self._free = free_linear(at, self._condensed, known)
        else:
            self._free = free_nonlinear(at, self._settings, last, known and known[1])

    def widen(self, step: StepData) -> None:
        """Take other radii or sizes for the step that has begun."""
        self._at.data = step

    def unhindered(self) -> Descent | None:
        """The plan that ignores the obstacles, if it is clear of them all: none costs less."""
        if not self._clear(self._free.y):
            return None
        point = self._free.point
        if point.residuals.worst > self._settings.tolerance:
            return None
        if self._search is TrustRegion and not self._clear(point.y):  # y may be linearised
            return None
        return self._ended(point, np.inf, 0)

    def _clear(self, y: FloatArray) -> bool:
        return self._at.data.within(self._at.path(y), y[self._layout.s], 0.0) is None

    def free(self) -> Iterate:
        """The plan that ignores the obstacles, which may not be clear of them."""
        return self._iterate(self._free.point, np.inf)

    def free_path(self) -> FloatArray:
        """Its positions (C, d)."""
        return self._at.path(self._free.y)[1:]

    def descend(self, nominal: Iterate, limit: int, goal: Descent | None = None) -> Descent | None:
        """Descend from a nominal plan; None if given up, or if a program could not be solved.

        Args:
            nominal: Where to begin.
            limit: Iterations at most.
            goal: Give up when it is plain that this plan will not be reached.
        """
        at, c, data = self._at, self._layout, self._at.data
        first = self._condensed.sampling.first
        if not data.count:  # the free plan was the only one, and it did not hold up
            return None
        if not at.watch.affords(first):
            return None
        began = at.watch.elapsed
        p = self._condensed.sampling.positions(nominal.states, nominal.inputs) - data.track[1:]
        e = nominal.states[1:] - data.x_ref[1:]
        y = c.outputs(data, p, nominal.s, nominal.inputs, e)
        near = touched = nominal.touched[: data.count]
        bounds, iterations = self._active_bounds(nominal), 0
        last: Descent | None = None
        while True:
            near = self._near(at.path(y)[None], y[c.s], near)
            if self._too_many(near):
                return last
            conflicts = Conflicts(data, c, near)
            active = np.concatenate([bounds, -touched[near].astype(np.intp)])
            search = self._search(at, conflicts, self._settings, goal)
            end = search.descend(y, active, limit - iterations, began, e)
            if end is None:
                return last
            landing = at.watch.elapsed
            iterations += end.iterations
            y, e = end.point.y, end.point.rolled.deviations
            missed = data.within(at.path(y), y[c.s], 0.0, known=near)
            depths = None if missed is None else data.depths(at.path(y)[1:], y[c.s])
            last = self._ended(end.point, end.cap, iterations, depths)
            at.watch.learn("landing", landing)
            if missed is None:
                return last
            if iterations >= limit or not at.watch.affords(first):
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
        at, c, data = self._at, self._layout, self._at.data
        whole = np.empty((len(paths), len(data.track), len(self._position)))
        whole[:, 0], whole[:, 1:] = data.x0[self._position], paths
        here = whole[0].copy()
        here[1:] = self._condensed.sampling.positions(best.states, best.inputs)
        known = np.stack([at.path(self._free.y), here])
        near = self._near(known, best.s, np.zeros((data.count, len(paths[0])), dtype=np.bool_))
        if self._too_many(near):
            return []
        conflicts = Conflicts(data, c, near)
        with at.watch.linearising:
            a, b = conflicts.about(whole, best.s)
        with at.watch.solving:
            A = np.einsum("ckw,kwn->ckn", a, conflicts.response(at.chart))
            b -= (a * at.chart.y_free[conflicts.at]).sum(axis=2)
        bounds, yields = self._active_bounds(best), at.ladder(firm)[-1]
        found = []
        for rows, least, path in zip(A, b, paths, strict=True):
            if at.watch.remaining < 0:
                break
            program = at.program(rows, least, yields)
            found.append(self._glimpse(program, bounds, conflicts, best, path))
        return found

    def _glimpse(
        self,
        program: CondensedProgram,
        bounds: IntArray,
        conflicts: Conflicts,
        best: Iterate,
        path: FloatArray,
    ) -> Glimpse:
        shape = self._at.data.count, len(path)
        with self._at.watch.solving, self._at.watch.inside:
            end = self._qp.glimpse(program, bounds)
        if end is None:
            nobody = np.zeros(shape, dtype=np.bool_)
            every = self._condensed.sampling.count
            samples = path[every - 1 :: every]
            return Glimpse(np.inf, nobody, path, partial(moved, best, self._position, samples))
        self._at.finished["daqp"] += 1
        v, pushing = end
        y = self._at.chart.y(v)
        merit = self._at.chart.least + float(v @ v) / 2 + program.penalty(v)
        start = partial(self._reached, best, y)
        return Glimpse(merit, conflicts.table(pushing, *shape), self._at.path(y)[1:], start)

    def _reached(self, best: Iterate, y: FloatArray) -> Iterate:
        """An iterate's bounds and sizes about the plan y."""
        y, rolled = self._at.rolled(self._at.inputs(y), best.s)
        states = self._at.data.x_ref.copy()
        states[0] = self._at.data.x0
        states[1:] += rolled.deviations
        return replace(best, states=states, inputs=rolled.inputs)

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
        more = self._at.data.within(self._at.path(self._free.y), s, _NEAR)
        return ~near if more is None else more

    def _active_bounds(self, nominal: Iterate) -> IntArray:
        """Which bounded entries a nominal plan holds: -1 at lower, 1 at upper bounds."""
        c, duals = self._layout, nominal.multipliers
        active = np.zeros(c.size - c.boxed.start, dtype=np.intp)
        if duals is not None:
            forces = c.gathered(duals.margin, duals.inputs, duals.rates, duals.states)
            active[forces < -NEGLIGIBLE], active[forces > NEGLIGIBLE] = -1, 1
        return active

    def _ended(
        self, point: Point, cap: float, iterations: int, depths: FloatArray | None = None
    ) -> Descent:
        """Judge a point; `depths` (J, C) are its violations where pairs were left out."""
        residuals, slack, at = point.residuals, point.slack, self._at
        if depths is None and residuals.feasibility > self._settings.tolerance:
            depths = at.data.depths(at.path(point.y)[1:], point.y[self._layout.s])
        most = 0.0 if point.pushed is None else float(point.pushed.slack.max())
        if depths is not None:
            most, slack = float(depths.max(initial=0.0)), float(depths.sum())
            residuals = replace(residuals, feasibility=max(residuals.feasibility, most))
        if len(point.excess):
            most = max(most, float(point.excess.max()))
        return Descent(
            partial(self._iterate, point, cap, depths),
            point.cost,
            at.merit(point.cost, slack, point.excess),
            residuals,
            judge(residuals, most, self._settings.tolerance),
            iterations,
        )

    def _iterate(self, point: Point, cap: float, depths: FloatArray | None = None) -> Iterate:
        """Name the parts of a point in the words of the problem."""
        problem, c, data = self._problem, self._layout, self._at.data
        states = np.empty_like(data.x_ref)
        states[0] = data.x0
        np.add(data.x_ref[1:], point.rolled.deviations, out=states[1:])
        slack, forces = np.zeros((2, problem.max_obstacles, self._condensed.sampling.points))
        margin, inputs, rates, limits = c.parted(-point.reaction)
        if point.pushed is not None:
            pairs, force = point.pushed.conflicts, point.pushed.force
            slack[pairs.obstacle, pairs.point] = point.pushed.slack
            forces[pairs.obstacle, pairs.point] = force
            if not c.moving:  # the bound takes whatever pushes a size that cannot move
                pull = force * point.pushed.tangent.a[:, -1]
                pulled = np.bincount(pairs.obstacle, weights=pull, minlength=len(margin))
                margin = pulled.astype(np.float64)
        if depths is not None:
            slack[: data.count] = depths
        pins = forces - cap if np.isfinite(cap) else forces
        duals = Multipliers(point.costates, inputs, margin, -forces, pins, limits, rates)
        s, free = point.y[c.s], self._free.inputs
        return Iterate(states, point.rolled.inputs, s, slack, duals, free).frozen()
