"""Iterative risk allocation: who needs risk gets it from those who do not (Ono and Williams, 2008).

Notation:
    delta   (J, C)  risk allocated to obstacle j at point c; their sum is the joint risk
    used    (J, C)  risk bound of the plan that was found with it
"""

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.safety.risk import LEAST_RISK

_KEPT = 0.1  # of the unused risk that stays where it is
_ACTIVE = 0.99  # share of the allocated risk from which it counts as used up


def reallocated(allocated: FloatArray, used: FloatArray) -> FloatArray:
    """Return an allocation (J, C) with the same sum, under which the plan remains feasible.

    An inactive constraint keeps what it used and a share of the rest; the active ones divide what
    is left over. Nobody is given less than it used, so that the cost cannot rise.
    """
    active = used >= _ACTIVE * allocated
    if not active.any():
        return allocated
    lower = np.maximum(used + _KEPT * (allocated - used), LEAST_RISK)
    left = np.minimum(lower, allocated)
    new = np.where(active, allocated, left)
    new[active] += (allocated.sum() - new.sum()) / np.count_nonzero(active)
    return new
