"""Controllers and reports with stamps and names, for the tests of staleness."""

from dataclasses import replace

import numpy as np
from driving import N
from instances import obstacle, problem, straight_reference

from scp_mpc import (
    MPC,
    Settings,
    StalenessPolicy,
)

NAN = np.nan


def settings(**changes):
    return Settings(staleness=StalenessPolicy(**changes))


def seen(stamp=None, name=None, at=(3.0, 0.1), velocity=(0.3, 0.0)):
    return replace(obstacle(N, at, velocity), stamp=stamp, name=name)


def controller(slots=1, **changes):
    return MPC(problem(N, max_obstacles=slots), settings(**changes))


def step(mpc, *obstacles, time=None):
    ref = straight_reference(N)
    return mpc.step(ref[0], ref, obstacles, time=time)


def state(mpc):
    """Everything that a step may change, to compare by identity."""
    memory = mpc._memory
    return (mpc._last, mpc._steps_touching, mpc.obstacles, mpc.counts, mpc.overruns) + (
        memory._time,
        dict(memory._reports),
    )
