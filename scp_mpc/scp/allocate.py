"""Iterative risk allocation in the solver: plan, give risk to those who need it, plan again."""

import numpy as np

from scp_mpc.safety.allocation import reallocated
from scp_mpc.safety.margin import JointRisk
from scp_mpc.safety.risk import size_at_risk
from scp_mpc.scp.loop import Loop
from scp_mpc.scp.plan import Result
from scp_mpc.scp.transcription import Transcription

_ROUNDS = 6  # at most
_GAIN = 0.001  # share of the cost that makes another one worth while


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
