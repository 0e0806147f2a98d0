"""What every plan must be, and some hard steps, for the tests of faults."""

import numpy as np
from driving import N
from instances import straight_reference
from judge import judge

from scp_mpc import (
    SCP,
    ObstaclePrediction,
)

NAN, INF = np.nan, np.inf
REF = straight_reference(N)
ON_TOP = ObstaclePrediction(REF[:, [0, 2]], 0.04 * np.eye(2), 0.2)
WALL = [ObstaclePrediction(np.tile([1.2, y], (N + 1, 1)), 0.3 * np.eye(2), 0.4) for y in (-1, 1)]


def hold(case, x0, x_ref, obstacles, plan):
    """What every plan must be, whatever happened."""
    assert np.isfinite(plan.U).all(), plan.status
    assert (plan.u0 >= case.u_min).all()
    assert (plan.u0 <= case.u_max).all()
    assert judge(case, x0, x_ref, obstacles, plan).complaints == []


def solve_and_hold(case, x0, x_ref, obstacles, settings=None):
    plan = SCP(case, settings).solve(x0, x_ref, obstacles)
    hold(case, x0, x_ref, obstacles, plan)
    return plan
