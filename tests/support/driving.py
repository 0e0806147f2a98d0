"""A short drive past an obstacle, for tests that compare controllers."""

import hashlib

import numpy as np
from instances import obstacle, straight_reference

N = 8


def drive(mpc, steps, disturb=lambda _: None):
    """Drive along the x-axis past a slow obstacle; return the plans."""
    x, plans = np.array([0.0, 2.0, 0.05, 0.0]), []
    for k in range(steps):
        disturb(k)
        ref = straight_reference(N) + [0.4 * k, 0, 0, 0]
        plans.append(mpc.step(x, ref, [obstacle(N, (3.0 + 0.06 * k, 0.0), (0.3, 0.0))]))
        x = mpc.problem.model.step(x, plans[-1].u0)
    return plans


def same(first, second):
    return all(
        np.array_equal(a.X, b.X) and np.array_equal(a.U, b.U) and a.cost == b.cost
        for a, b in zip(first, second, strict=True)
    )


def bits(plans):
    """A fingerprint of everything that is applied."""
    parts = (p.X.tobytes() + p.U.tobytes() + p.s.tobytes() for p in plans)
    return hashlib.sha256(b"".join(parts)).hexdigest()


def good():
    ref = straight_reference(N)
    return {"x0": ref[0], "x_ref": ref, "obstacles": [obstacle(N, (1.5, 0.1))]}
