"""The two ways to descend, as one: the condensed problem, and the sparse one behind it."""

from collections import Counter
from collections.abc import Sequence
from math import inf

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.problem import Problem
from scp_mpc.robots.linear import LinearModel
from scp_mpc.robots.model import Model
from scp_mpc.settings import Settings
from scp_mpc.solver.condensed_scp import CondensedSCP
from scp_mpc.solver.descent import Descent, Glimpse
from scp_mpc.solver.iterate import Iterate
from scp_mpc.solver.plan import Status
from scp_mpc.solver.sampling import LinearSampling, Sampling
from scp_mpc.solver.sparse_scp import SparseSCP
from scp_mpc.solver.step_data import StepData
from scp_mpc.solver.stopwatch import Stopwatch
from scp_mpc.solver.sweep import Sweep


class Engine:
    """Solves control steps with so many points in each interval.

    Usage: `begin` a step; then everything else as often as wanted.

    Args:
        problem: What to solve.
        settings: How to solve it.
        count: Points in each interval, K.
    """

    def __init__(self, problem: Problem, settings: Settings, count: int) -> None:
        """Condense the problem, if it can be, and lay out the sparse one."""
        self._problem, self._settings = problem, settings
        self.sampling = Sampling.of(problem, count)
        self._condensed = self.sparse = None
        if settings.condense:
            self._condensed = CondensedSCP.of(problem, settings, self.sampling)
        if isinstance(problem.model, LinearModel):
            assert isinstance(self.sampling, LinearSampling)
            self.sparse = SparseSCP(problem, settings, self.sampling)
        elif self._condensed is None:
            raise InvalidArgumentError("condense", "False, but nonlinear models need it")
        self._fresh = False
        self._full_sag = _full_sag(problem.model, problem, count)

    @property
    def primary(self) -> CondensedSCP | SparseSCP:
        """Who is asked first."""
        first = self._condensed or self.sparse
        assert first is not None
        return first

    @property
    def condenses(self) -> bool:
        """Whether that is the condensed problem."""
        return self._condensed is not None

    @property
    def finished(self) -> Counter[str]:
        """Programs solved since `begin`, by solver."""
        if self._fresh or self._condensed is None or self.sparse is None:
            return self.primary.finished
        return self.primary.finished + self.sparse.finished

    def begin(
        self,
        step: StepData,
        watch: Stopwatch,
        last: Iterate | None = None,
        like: "Engine | None" = None,
    ) -> None:
        """Read a control step.

        Args:
            step: The control step.
            watch: Its clock.
            last: The nominal plan, if there is one.
            like: Who has begun the same step at other points.
        """
        self._step, self._watch, self._fresh = step, watch, True
        if self._condensed is not None:
            self._condensed.begin(step, watch, last, None if like is None else like._condensed)
        elif self.sparse is not None:
            self.sparse.begin(step, watch)

    def widen(self, step: StepData) -> None:
        """Take other radii or sizes for the step that has begun."""
        self._step = step
        self.primary.widen(step)
        self._fresh = True

    def forget(self) -> None:
        """Forget what earlier programs left behind."""
        if self.sparse is not None:
            self.sparse.forget()

    def path(self, iterate: Iterate) -> FloatArray:
        """Positions (C, d) of an iterate."""
        return self.sampling.positions(iterate.states, iterate.inputs)

    def sweep(self, iterate: Iterate) -> Sweep:
        """What an iterate does between its points."""
        known = self._swept(self.path(iterate))
        return Sweep(known.chord, max(known.sag, self.sampling.sag(iterate.states, iterate.inputs)))

    def assumed(self, start: Iterate) -> Sweep:
        """What a plan found from an iterate is assumed to do there, at full input at most."""
        known = self.free_sweep().and_more(self.sweep(start))
        return Sweep(known.chord, max(known.sag, self._full_sag))

    def free_sweep(self) -> Sweep:
        """What the plan that ignores the obstacles does between its points."""
        if isinstance(self.sampling, LinearSampling):
            return self._swept(self.free_path())
        return self.sweep(self.free())

    def unhindered(self) -> Descent | None:
        """See `CondensedSCP.unhindered`."""
        return self.primary.unhindered()

    def free(self) -> Iterate:
        """The plan that ignores the obstacles, which may not be clear of them."""
        return self.primary.free()

    def free_path(self) -> FloatArray:
        """Its positions (C, d)."""
        return self.primary.free_path()

    def glimpses(self, best: Iterate, paths: Sequence[FloatArray], firm: bool) -> list[Glimpse]:
        """See `CondensedSCP.glimpses`."""
        return self.primary.glimpses(best, paths, firm)

    def follow(self, start: Iterate, goal: Descent) -> Descent | None:
        """Descend from a rival's start; None where it is plain that it will not reach the goal."""
        return self.primary.descend(start, self._settings.max_iterations, goal)

    def descend(self, nominal: Iterate) -> Descent | None:
        """Descend on the condensed problem; on the sparse one where that has no answer.

        None if not even the first program was solved, or there was no time for it.
        """
        limit = self._settings.max_iterations
        if self._condensed is None:
            return self.primary.descend(nominal, limit)
        best = self._condensed.descend(nominal, limit)
        if best is not None and best.status is not Status.VIOLATING:
            return best
        if self.sparse is None or self._watch.deadline < inf:
            return best  # a sparse program may take ten times as long, and cannot be stopped
        if self._fresh:
            self.sparse.begin(self._step, self._watch)
            self._fresh = False
        other = self.sparse.descend(nominal, limit)
        if best is None or other is None:
            return best or other
        return other if other.beats(best, lead=0.0) else best

    def _swept(self, path: FloatArray) -> Sweep:
        whole = np.concatenate([self.sampling.now(self._step.x0), path])
        return Sweep.of(whole.reshape(-1, self.sampling.discs, path.shape[1]))


def _full_sag(model: Model, problem: Problem, count: int) -> float:
    """How far the largest inputs bend a linear robot's path off its chord between points [m]."""
    if not isinstance(model, LinearModel):
        return 0.0
    _, half = model.between(0.5 / count)
    _, whole = model.between(1.0 / count)
    most = np.maximum(np.abs(problem.u_min), np.abs(problem.u_max))
    return float(np.linalg.norm(np.abs(half - whole / 2) @ most))
