"""Closed loops, each call of `MPC.step` timed.

Twice: by the clock on the wall, and by the processor time of its thread, which leaves out what the
operating system gives to others. The garbage collector looks at nothing that was there before.
"""

import gc
import resource
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from time import perf_counter, thread_time

import numpy as np

from scp_mpc import MPC, Plan, Problem, Settings
from scp_mpc.arrays import FloatArray
from scp_mpc.simulation import Scene


@dataclass(frozen=True, eq=False)
class Timed:
    """One control step.

    Attributes:
        x: (nx,) state before.
        plan: Its plan.
        wall: Seconds.
        thread: Seconds of processor time.
        interrupted: Whether the operating system took the processor away meanwhile.
    """

    x: FloatArray
    plan: Plan
    wall: float
    thread: float
    interrupted: bool


def closed_loop(
    world: Scene,
    problem: Problem,
    settings: Settings,
    steps: int,
    advance: Callable[[], object] = lambda: None,
) -> Iterator[Timed]:
    """Drive without disturbance; another controller solves one step before the clock runs.

    Args:
        world: What is in the way, and where to go.
        problem: What is solved.
        settings: How.
        steps: Control steps.
        advance: Called after each of them, for a progress bar.
    """
    x, dt, N = world.start(), problem.model.dt, problem.horizon
    MPC(problem, settings).step(x, world.x_ref(0.0, x), world.predictions(0.0, dt, N))
    mpc = MPC(problem, settings)
    gc.collect()
    gc.freeze()
    try:
        for k in range(steps):
            x_ref, obstacles = world.x_ref(k * dt, x), world.predictions(k * dt, dt, N)
            switches, began, worked = _switches(), perf_counter(), thread_time()
            plan = mpc.step(x, x_ref, obstacles)
            thread, wall = thread_time() - worked, perf_counter() - began
            yield Timed(x, plan, wall, thread, _switches() > switches)
            x = problem.model.step(x, plan.u0)
            advance()
    finally:
        gc.unfreeze()


def milliseconds(seconds: Sequence[float] | FloatArray) -> dict[str, float]:
    """Median, p99 and maximum [ms]."""
    times = 1e3 * np.asarray(seconds)
    return {
        "median": float(np.median(times)),
        "p99": float(np.percentile(times, 99)),
        "max": float(times.max()),
    }


def _switches() -> int:
    """How often the operating system took the processor away from this thread."""
    return resource.getrusage(resource.RUSAGE_THREAD).ru_nivcsw
