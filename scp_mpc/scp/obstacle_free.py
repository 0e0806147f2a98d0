"""The plan that ignores the obstacles: no other costs less, and most steps need no more."""

import numpy as np

from scp_mpc.scp.certificate import Nominal
from scp_mpc.scp.iterate import Iterate
from scp_mpc.scp.loop import Loop
from scp_mpc.scp.transcription import Transcription


def obstacle_free(at: Transcription, loop: Loop, last: Iterate | None) -> Nominal:
    """Return the obstacle-free optimum of a step.

    For a linear robot that is one linear system, or one program where bounds are in the way. For a
    nonlinear one the loop finds it, from the better of the last plan and the last obstacle-free
    one, for both lead to local optima only; where an obstacle shaped the last plan, only the sides
    of the obstacles are sought from here, and one program about that plan has to do.

    Args:
        at: The step.
        loop: Solves it.
        last: The nominal plan, or None.
    """
    if at.linear:
        return _linear(at, last)
    plan = _nonlinear(at, loop, last)
    at.free = plan.rollout.inputs
    return plan


def _nonlinear(at: Transcription, loop: Loop, last: Iterate | None) -> Nominal:
    idle = np.tile(at.problem.model.idle, (at.problem.horizon, 1))
    if last is None:
        start = at.plain(idle)
    else:
        start = at.plain(last.inputs, last.states[1:] - at.step.x_ref[1:])
        if last.touches:
            return _one_program(at, start)
        if last.free is not None:
            other = at.plain(last.free)
            merits = [at.merit(p.cost, 0.0, p.excess) for p in (start, other)]
            start = other if merits[1] < merits[0] else start
    found = loop.run(start, screen=False)
    if found is None or found.nominal is None:
        return start
    return found.nominal


def _linear(at: Transcription, last: Iterate | None) -> Nominal:
    rest = np.tile(at.problem.model.idle, (at.problem.horizon, 1))
    s = np.full(at.problem.max_obstacles, at.problem.size.reference)
    condensed = at.condenser.condensed(at.condenser.rolled(rest), s)
    y, (lower, upper), box = condensed.y_free, at.bounds, at.layout.boxed
    if (lower[box] <= y[box]).all() and (upper[box] >= y[box]).all():
        at.firm.solver.finished["kkt"] += 1
        return at.plain(at.inputs(y))
    start = at.plain(at.inputs(y))
    if last is not None and not last.touches:
        none = np.zeros(at.step.radii.shape, dtype=np.bool_)
        start = at.at(last, none)
    convex = at.solve(start, condensed, start.planes, at.relaxations(firm=True))
    return start if convex is None else at.reached(convex, convex.solution)


def _one_program(at: Transcription, start: Nominal) -> Nominal:
    condensed = at.condensed(start)
    convex = at.solve(start, condensed, start.planes, at.relaxations(firm=True))
    return start if convex is None else at.reached(convex, convex.solution)
