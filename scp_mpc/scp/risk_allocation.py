"""Iterative risk allocation: who needs risk gets it from those who do not (Ono and Williams, 2008).

Plan, give risk to those who need it, plan again.

Notation:
    delta   (J, C)  risk allocated to obstacle j at node c; their sum is the joint risk
    used    (J, C)  risk bound of the plan that was found with it
"""

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.geometry.margin import JointRisk
from scp_mpc.geometry.risk import size_at_risk
from scp_mpc.scp.loop import Loop
from scp_mpc.scp.plan import Result
from scp_mpc.scp.transcription import Transcription

_ROUNDS = 6  # at most
_GAIN = 0.001  # share of the cost that makes another one worth while
_EVEN = 0.1  # of the joint risk that is spread evenly, so that nobody is left with nothing


def reallocated(allocated: FloatArray, used: FloatArray) -> FloatArray:
    """Return an allocation (J, C) with the same sum, under which the plan remains feasible.

        delta_new = (1 - k) sum(delta) used / sum(used) + k mean(delta)

    Nobody is given less than it used, so that the cost cannot rise. Ono and Williams divide what
    is left over among the active constraints alone; in proportion to the use it reaches their
    neighbours in time, too, who would hold the plan up next.
    """
    total, spent = allocated.sum(), used.sum()
    if not 0 < spent < total:
        return allocated
    even = min(_EVEN, (1 - spent / total) / 2)
    new: FloatArray = (1 - even) * total / spent * used + even * total / used.size
    return new * (total / new.sum())


def allocate(at: Transcription, loop: Loop, best: Result) -> Result:
    """Improve a plan that keeps a joint risk in equal shares; others are returned as they are.

    The plan stays feasible from one allocation to the next, so that its cost cannot rise.
    """
    step = at.step
    margin = step.problem.margin
    if not isinstance(margin, JointRisk) or margin.allocation == "uniform":
        return best
    risks = np.full(step.radii.shape, margin.delta / step.radii.size)
    for _ in range(_ROUNDS):
        if not (best.status.ok and best.iterate.touches and at.clock.allows("iteration")):
            break
        path = step.nodes.positions(best.iterate.states, best.iterate.inputs)
        risks = reallocated(risks, step.risks(path))
        at.step = step.scaled(size_at_risk(risks))
        other = loop.run(at.at(best.iterate))
        if other is None or not other.beats(best, 0.0):
            break
        gain, best = best.merit - other.merit, other
        if gain <= _GAIN * best.merit:
            break
    at.step = step
    return best
