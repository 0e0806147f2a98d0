"""The plan that ignores the obstacles: no other costs less."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.settings import Settings
from scp_mpc.solver.certificate import Point
from scp_mpc.solver.condensed import Condensed
from scp_mpc.solver.condensed_step import CondensedStep
from scp_mpc.solver.iterate import Iterate
from scp_mpc.solver.trust_region import TrustRegion


@dataclass(frozen=True, eq=False)
class FreePlan:
    """The plan that ignores the obstacles, in one control step.

    Attributes:
        y: (ny,) its outputs.
        reaction: (nf,) forces of its bounds.
        certify: Makes `point`.
        inputs: (N, nu) to begin from in the next step; None where there is no need to.
    """

    y: FloatArray
    reaction: FloatArray
    certify: Callable[[], Point]
    inputs: FloatArray | None = None

    @cached_property
    def point(self) -> Point:
        """The plan, certified as the solution without obstacles."""
        return self.certify()


def free_linear(
    at: CondensedStep, condensed: Condensed, known: tuple[CondensedStep, FreePlan] | None
) -> FreePlan:
    """Chart a step of a linear robot and find its free plan: by a linear system or one program.

    Args:
        at: The step.
        condensed: Its problem.
        known: The same step at other points, and its free plan.
    """
    with at.watch.solving:
        if known is not None:
            like, plan = known
            at.chart = condensed.chart(like.inputs(like.chart.y_free))
            y, _ = at.rolled(like.inputs(plan.y), plan.y[like.layout.s])
            return _certified(at, y, plan.reaction)
        at.chart = condensed.chart()
    y, nothing = at.chart.y_free, np.zeros(len(at.chart.boxed))
    (lower, upper), box = at.bounds, at.layout.boxed
    if (lower[box] <= y[box]).all() and (upper[box] >= y[box]).all():
        at.finished["kkt"] += 1
        return _certified(at, y, nothing)
    for yields in at.ladder(firm=True):
        with at.watch.solving:
            held = at.solve(at.program(*at.nothing, yields), nothing.astype(np.intp))
        if held is not None:
            return _certified(at, at.chart.y(held.v), held.force)
    return _certified(at, y, nothing)


def _certified(at: CondensedStep, y: FloatArray, reaction: FloatArray) -> FreePlan:
    def certify() -> Point:
        return at.certify(*at.rolled(at.inputs(y), y[at.layout.s]), reaction, None)

    return FreePlan(y, reaction, certify)


def free_nonlinear(
    at: CondensedStep, settings: Settings, last: Iterate | None, known: FreePlan | None
) -> FreePlan:
    """Descend to the free plan of a nonlinear robot.

    Where an obstacle was in the way of the last plan, only the sides of the obstacles are sought
    from here, and one program about that plan has to do.

    Args:
        at: The step.
        settings: How to descend.
        last: The nominal plan, which knows the free plan of the step before; or None.
        known: The free plan of the same step at other points.
    """
    problem = at.problem
    sizes = np.full(problem.max_obstacles, problem.size.reference)
    search = TrustRegion(at, None, settings)
    if last is not None and last.touches:
        return _rough(at, search, at.start(last.inputs, sizes, None, _deviations(at, last)))
    if known is not None and known.inputs is not None:
        y, rolled = at.rolled(known.inputs, sizes)
        point = at.certify(y, rolled, known.reaction, None)
        _chart(search, point)
        return FreePlan(point.y, point.reaction, lambda: point, known.inputs)
    if last is None:
        start = at.start(np.tile(problem.model.idle, (problem.horizon, 1)), sizes, None)
    else:
        # Both lead to local optima only, so the better one counts: no good plan is forgotten.
        starts = [at.start(last.inputs, sizes, None, _deviations(at, last))]
        if last.free is not None:
            starts.append(at.start(last.free, sizes, None))
        start = min(starts, key=lambda point: at.merit(point.cost, 0.0, point.excess))
    _chart(search, start)
    nothing = np.zeros(len(at.chart.boxed), dtype=np.intp)
    end = search.descend_from(start, nothing, settings.max_iterations)
    point = start if end is None else end.point
    return FreePlan(point.y, point.reaction, lambda: point, point.rolled.inputs)


def _rough(at: CondensedStep, search: TrustRegion, start: Point) -> FreePlan:
    _chart(search, start)
    nothing = np.zeros(len(at.chart.boxed), dtype=np.intp)
    for yields in at.ladder(firm=True):
        with at.watch.solving:
            held = at.solve(at.program(*at.nothing, yields), nothing)
        if held is not None:
            y = at.chart.y(held.v)
            return replace(_certified(at, y, held.force), inputs=at.inputs(y))
    return FreePlan(start.y, start.reaction, lambda: start, start.rolled.inputs)


def _chart(search: TrustRegion, point: Point) -> None:
    if not search.charted(point):
        raise np.linalg.LinAlgError("no plan to begin from has finite derivatives")


def _deviations(at: CondensedStep, last: Iterate) -> FloatArray:
    return last.states[1:] - at.data.x_ref[1:]
