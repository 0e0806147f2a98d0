"""The descent for nonlinear robots: convex programs within a trust region, judged by a merit.

    repeat:  linearise dynamics and obstacles about the plan -> convex program in the trust region
             -> Newton's step on the original problem, for the active set that came out
             -> roll its inputs out: the trial
             -> accept if the merit falls as predicted, or the KKT residual by half; else shrink
    until    the KKT residual of the original problem is below the tolerance

The merit is cost and penalty on all violations; its weight exceeds the forces met so far. A plan is
always rolled out, so it needs no term for defects (`varying.py`). The region bounds what the inputs
change by; as constraints of the program its bounds push, so that no point that they hold is ever
certified.
"""

from dataclasses import replace

import numpy as np

from scp_mpc.arrays import FloatArray, IntArray
from scp_mpc.settings import Settings
from scp_mpc.solver.active_set import CondensedProgram, Held
from scp_mpc.solver.certificate import Point, Pushed
from scp_mpc.solver.condensed_step import CondensedStep, Yielding
from scp_mpc.solver.conflicts import Conflicts, Tangent
from scp_mpc.solver.curvature import bent_program, newton_step
from scp_mpc.solver.descent import Descent
from scp_mpc.solver.iterate import NEGLIGIBLE
from scp_mpc.solver.sampling import NonlinearSampling
from scp_mpc.solver.search import ROUNDING, End, Search
from scp_mpc.solver.varying import Varying, VaryingChart

_ENOUGH = 0.01  # share of the predicted decrease that a trial must bring
_SHRINK, _GROW = 0.3, 3.0
_SMALLEST = 1e-8  # trust region, relative to the inputs' range, at which to give up
_WEIGHT = 2.0  # of the merit's penalty over the largest force
_FADING = 0.5  # of that weight from one program to the next, where forces allow
_CLOSE = 1e-2  # KKT residual from which on its fall counts, whatever the merit does
_NOISE = 1e-12  # of the merit, relative


class TrustRegion(Search):
    """Descends about some pairs of obstacle and point of a nonlinear robot; see `Search`."""

    def __init__(
        self,
        step: CondensedStep,
        conflicts: Conflicts | None,
        settings: Settings,
        goal: Descent | None = None,
    ) -> None:
        """Begin with a trust region without limits."""
        super().__init__(step, conflicts, settings, goal)
        problem = step.problem
        span = (problem.u_max - problem.u_min) / 2
        self._span = np.where(span > 0, span, 1.0)
        self._radius, self._weight = np.inf, 0.0
        self._about: Point

    def descend(
        self,
        y: FloatArray,
        active: IntArray,
        limit: int,
        began: float = 0.0,
        guess: FloatArray | None = None,
    ) -> End | None:
        """See the base class; the first half-spaces are about y, the dynamics about its inputs."""
        step, conflicts = self._step, self._conflicts
        tangent = None if conflicts is None else conflicts.tangent(y)
        with step.watch.solving:
            start = step.start(step.inputs(y), y[step.layout.s], conflicts, guess)
        if not self.charted(start):
            return None
        return self.descend_from(start, active, limit, began, tangent)

    def descend_from(
        self,
        start: Point,
        active: IntArray,
        limit: int,
        began: float = 0.0,
        tangent: Tangent | None = None,
    ) -> End | None:
        """Descend from a charted plan; the first half-spaces are a tangent's, if one is given."""
        watch, first = self._step.watch, self._step.condensed.sampling.first
        point, end, residual = start, None, np.inf
        for iteration in range(1, limit + 1):
            task = first if iteration == 1 else "program"
            if iteration > 1:
                if not watch.affords(task):
                    break
                began = watch.elapsed
            attempt = self._attempt(point, tangent or self._tangent(point), active, residual)
            watch.learn(task, began)
            if attempt is None:
                break
            accepted, trial, held = attempt
            done = trial.residuals.worst <= self._tolerance
            if not (accepted and (done or self.charted(trial))):
                self._shrink(point, held)
                if self._radius < _SMALLEST:
                    break
                continue
            point, tangent, residual, active = trial, None, trial.residuals.worst, held.active
            end = End(trial, active, self._cap, iteration)
            if done:
                break
            if self._goal is not None and self._vain(iteration, trial, self._goal):
                return None
        return end

    def _attempt(
        self, point: Point, tangent: Tangent | None, active: IntArray, residual: float
    ) -> tuple[bool, Point, Held] | None:
        """Whether a trial is accepted, the trial and its program's solution; None if unsolved."""
        self._about = point
        solved = self._convex(tangent, active)
        if solved is None:
            return None
        program, held = solved
        W = self._curvature(tangent, held)
        held = self._bent(program, held, W)
        trial = self._step.point(self._conflicts, held)
        if self._accepted(point, trial, program, held, W, residual):
            return True, trial, held
        if trial.pushed is None or not np.isfinite(trial.cost):
            return False, trial, held
        other = self._corrected(program, held, trial.pushed.tangent)
        if other is None:
            return False, trial, held
        trial = self._step.point(self._conflicts, other)
        return self._accepted(point, trial, program, held, W, residual), trial, held

    def _tangent(self, point: Point) -> Tangent | None:
        return None if point.pushed is None else point.pushed.tangent

    def charted(self, point: Point) -> bool:
        """Chart the problem about a plan, if its derivatives are such that it can be done."""
        with self._step.watch.linearising:
            condensed = self._step.condensed
            assert isinstance(condensed, Varying)
            try:
                self._step.chart = condensed.chart(point.rolled, point.y[self._step.layout.s])
            except np.linalg.LinAlgError:
                return False
        return True

    def _convex(
        self, tangent: Tangent | None, active: IntArray
    ) -> tuple[CondensedProgram, Held] | None:
        with self._step.watch.solving:
            if tangent is None or self._conflicts is None:
                return self._solved(*self._step.nothing, active)
            return self._solved(*self._step.convex(self._conflicts, tangent), active)

    def _program(self, A: FloatArray, b: FloatArray, yields: Yielding) -> CondensedProgram:
        """A program within the trust region about the plan."""
        program, c = self._step.program(A, b, yields), self._step.layout
        if np.isfinite(self._radius):
            u = self._about.y[c.u] - self._step.chart.y_free[c.u]
            reach = self._radius * np.tile(self._span, c.shape[0])
            program.lower[c.inputs] = np.maximum(program.lower[c.inputs], u - reach)
            program.upper[c.inputs] = np.minimum(program.upper[c.inputs], u + reach)
        return program

    def _bent(self, program: CondensedProgram, held: Held, W: FloatArray) -> Held:
        """The program's solution with the curvature that the convex one leaves out.

        Newton's step for its active set; or, where that is about to change, the solution of the
        program with all curvature that keeps it convex.
        """
        whole = newton_step(held, held.v - self._chart_now.here, W)
        if whole is not None and self._step.consistent(program, whole, ROUNDING):
            return whole
        return self._resolved(program, held, W)

    def _resolved(self, program: CondensedProgram, held: Held, W: FloatArray) -> Held:
        bent, centre, root = bent_program(program, self._chart_now.here, W)
        with self._step.watch.solving:
            other = self._step.solve(bent, held.active)
        return held if other is None else replace(other, v=centre + root @ other.v)

    def _corrected(self, program: CondensedProgram, held: Held, reached: Tangent) -> Held | None:
        """The second-order correction: the least change that takes the active pairs back to g = 0.

        A step bends away from its linearised constraints by its square, which the merit would hold
        against it wherever it is, also next to the optimum (Maratos, 1978).
        """
        bounds = len(program.F)
        pairs = held.indices >= bounds
        if not pairs.any():
            return None
        rows = np.concatenate([program.F, program.A])[held.indices]
        wanted = np.zeros(len(rows))
        wanted[pairs] = -reached.g[held.indices[pairs] - bounds]
        change, *_ = np.linalg.lstsq(rows, wanted)
        return replace(held, v=held.v + change)

    @property
    def _chart_now(self) -> VaryingChart:
        chart = self._step.chart
        assert isinstance(chart, VaryingChart)
        return chart

    def _curvature(self, tangent: Tangent | None, held: Held) -> FloatArray:
        """W (nv, nv): what the convex program leaves out of the Lagrangian's second derivative."""
        step, chart, conflicts = self._step, self._chart_now, self._conflicts
        bounds, bends, pushed = len(chart.boxed), np.zeros((0, len(held.v))), None
        force = held.force[bounds:]
        if conflicts is not None and tangent is not None:
            pushed = Pushed(tangent, force, np.zeros(len(force)), conflicts)
            pairs = (force > NEGLIGIBLE).nonzero()[0]
            L = conflicts.bend(tangent)[pairs] * np.sqrt(force[pairs])[:, None, None]
            bends = np.einsum("kwm,kwn->kmn", L, conflicts.response(chart)[pairs])
            bends = bends.reshape(-1, bends.shape[-1])
        rolled, e = self._about.rolled, chart.guess(held.v)
        nu, phi = step.costates(rolled, e, held.force[:bounds], pushed)
        model, states = step.problem.model, step.data.x_ref.copy()
        states[0] = step.data.x0
        states[1:] += rolled.deviations
        sampling = step.condensed.sampling
        assert isinstance(sampling, NonlinearSampling)
        bent = sampling.curvature(states, rolled.inputs, -nu, -phi)
        return chart.curvature(*bent, model.heading) - bends.T @ bends

    def _accepted(
        self,
        point: Point,
        trial: Point,
        program: CondensedProgram,
        held: Held,
        W: FloatArray,
        residual: float,
    ) -> bool:
        """Whether a trial brings enough of what its program predicted."""
        if not np.isfinite(trial.cost):
            return False
        problem = self._step.problem
        largest = float(np.abs(held.force[len(program.lower) :]).max(initial=0.0))
        weight = max(_FADING * self._weight, _WEIGHT * largest)
        self._weight = min(weight, problem.slack_weight)
        if self._yields is Yielding.EVERYBODY:
            self._weight = problem.slack_weight
        chart, d = self._chart_now, held.v - self._chart_now.here
        before, after = self._merit(point), self._merit(trial)
        model = chart.least + float(held.v @ held.v + d @ W @ d) / 2 + program.penalty(held.v)
        predicted, actual = before - model, before - after
        if actual >= _ENOUGH * predicted - _NOISE * abs(before):
            if actual >= predicted / 2:
                self._radius *= _GROW
            return True
        return trial.residuals.worst <= residual / 2 <= _CLOSE

    def _merit(self, point: Point) -> float:
        """Cost and penalties on all violations, whoever is supposed to yield."""
        merit = self._step.merit(point.cost, 0.0, point.excess)
        if point.pushed is not None:
            merit += self._weight * float(np.maximum(0.0, -point.pushed.tangent.g).sum())
        return merit

    def _shrink(self, point: Point, held: Held) -> None:
        """Trust only a part of the way that the inputs were to go."""
        c, chart = self._step.layout, self._step.chart
        change = (chart.y(held.v)[c.u] - point.y[c.u]).reshape(c.shape) / self._span
        self._radius = _SHRINK * min(self._radius, float(np.abs(change).max()))
