"""Iterative risk allocation: who needs risk gets it from those who do not (Ono and Williams, 2008).

Notation:
    delta   (J, C)  risk allocated to obstacle j at point c; their sum is the joint risk
    used    (J, C)  risk bound of the plan that was found with it
"""

from scp_mpc.arrays import FloatArray

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
