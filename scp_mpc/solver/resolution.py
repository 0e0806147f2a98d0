"""How finely a control step is resolved in time: samples alone, or points between them, too.

Samples alone where the problem says so, and where the robot's and the obstacles' ways from one
sample to the next are within the radii. In either case but the first the radii grow by what
happens between two points (`sweep.py`).
"""

from collections import Counter
from dataclasses import replace

from scp_mpc.arrays import FloatArray
from scp_mpc.problem import Problem
from scp_mpc.settings import Settings
from scp_mpc.solver.descent import Descent
from scp_mpc.solver.engine import Engine
from scp_mpc.solver.iterate import Iterate
from scp_mpc.solver.plan import Status
from scp_mpc.solver.sampling import LinearSampling
from scp_mpc.solver.step_data import StepData
from scp_mpc.solver.stopwatch import Stopwatch
from scp_mpc.solver.sweep import Sweep, swept, too_fast


class Resolution:
    """The engines for both, and the choice between them.

    Args:
        problem: What to solve.
        settings: How to solve it.

    Attributes:
        coarse: Samples alone.
        fine: Points between them, too; the same as `coarse` where the problem wants none.
    """

    def __init__(self, problem: Problem, settings: Settings) -> None:
        """Set both engines up."""
        self.coarse = self.fine = Engine(problem, settings, 1)
        self._tolerance = settings.tolerance
        self._covers_gaps = problem.nodes_per_interval > 1
        if self._covers_gaps:
            self.fine = Engine(problem, settings, problem.nodes_per_interval)

    @property
    def wants_nominal(self) -> bool:
        """Whether even the plan that ignores the obstacles is sought from the nominal one."""
        return not isinstance(self.coarse.sampling, LinearSampling)

    def forget(self) -> None:
        """Forget what earlier programs left behind."""
        self.coarse.forget()
        self.fine.forget()

    def begin(
        self, step: StepData, watch: Stopwatch, last: Iterate | None = None
    ) -> tuple[Engine, StepData, Descent | None]:
        """Begin a step at the samples; the third is the free plan, if that is clear."""
        engine, wide = self.coarse, step
        engine.begin(step, watch, last)
        if self._covers_gaps and step.count:
            wide = self.widened(engine, step, engine.free_sweep())
        best = engine.unhindered()
        return engine, step if best is None else wide, best

    def refined(
        self, step: StepData, watch: Stopwatch, last: Iterate | None
    ) -> tuple[Engine, StepData, Descent | None]:
        """Go on between the samples, if the free plan or the last one is too fast for less.

        Where there is no time for it, the samples have to do: their radii leave room for all that
        happens in a whole interval.
        """
        coarse, fine = self.coarse, self.fine
        if not self._covers_gaps or not step.count:
            return coarse, step, None
        sweep = coarse.free_sweep()
        if last is not None:
            sweep = sweep.and_more(coarse.sweep(last))
        if not too_fast(step, sweep) or not watch.affords("refining", fine.sampling.first):
            return coarse, step, None
        began = watch.elapsed
        step = step.sampled(fine.sampling)
        fine.begin(step, watch, last, like=coarse)
        wide = self.widened(fine, step, fine.free_sweep())
        best = fine.unhindered()
        watch.learn("refining", began)
        return fine, step if best is None else wide, best

    def finished(self, engine: Engine) -> Counter[str]:
        """Programs solved in this control step, which ended with this engine."""
        finished = self.coarse.finished
        return finished if engine is self.coarse else finished + engine.finished

    def assumed(self, engine: Engine, step: StepData, start: Iterate) -> Sweep | None:
        """What the plan is assumed to do between two points; None where that does not matter."""
        if not self._covers_gaps or not step.count:
            return None
        return engine.assumed(start)

    def widened(self, engine: Engine, step: StepData, sweep: Sweep | None) -> StepData:
        """Let an engine take the radii that this needs."""
        wide = step if sweep is None else swept(step, sweep)
        engine.widen(wide)
        return wide

    def kept(self, engine: Engine, step: StepData, sweep: Sweep | None, best: Descent) -> bool:
        """Whether a plan is clear between its points, too, for what it really does there."""
        if sweep is None or not best.status.ok:
            return True
        if sweep.covers(engine.sweep(best.iterate)):
            return True
        return bool(_depths(engine, step, best.iterate).max(initial=0.0) <= self._tolerance)

    def finer(self, engine: Engine, step: StepData, watch: Stopwatch) -> tuple[Engine, StepData]:
        """Where to go on after a plan that was not kept: between the samples, if there is time."""
        if engine is self.fine or not watch.affords("refining", self.fine.sampling.first):
            return engine, step
        step = step.sampled(self.fine.sampling)
        self.fine.begin(step, watch, None, like=self.coarse)
        return self.fine, step


def exposed(engine: Engine, step: StepData, best: Descent) -> Descent:
    """A plan that is not clear between its points after all, with how far it is not."""
    depths = _depths(engine, step, best.iterate)
    slack = best.iterate.slack.copy()
    slack[: step.count] = depths
    iterate = replace(best.iterate, slack=slack).frozen()
    residuals = replace(best.residuals, feasibility=float(depths.max()))
    return replace(best, make=lambda: iterate, status=Status.VIOLATING, residuals=residuals)


def _depths(engine: Engine, step: StepData, iterate: Iterate) -> FloatArray:
    """How deep an iterate enters the no-go sets (J, C), for what it does between its points."""
    return swept(step, engine.sweep(iterate)).depths(engine.path(iterate), iterate.s)
