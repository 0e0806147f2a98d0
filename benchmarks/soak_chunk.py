"""One chunk of the soak: many control steps in one process, counted."""

import logging
import os
import resource
import sys
from collections import Counter
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from time import perf_counter, time_ns
from typing import Any

import numpy as np

from benchmarks.audit import audit
from benchmarks.soak_worlds import FAULTS, Kind, World, kinds
from scp_mpc.control.mpc import MPC
from scp_mpc.scp.plan import Plan

EPISODE = 50  # control steps
PER_DECADE = 50  # bins of the histogram of seconds
_BAD_CALL = 0.04  # chance per step
_RESET = 0.01  # likewise
_TWIN = 0.05  # chance per episode that a twin without bad calls goes along
_EXAMPLES = 5
_WORKER = f"{os.getpid()}-{time_ns()}"


@dataclass
class Tally:
    """What happened, in numbers that add up.

    Attributes:
        steps: Control steps.
        statuses: How they ended.
        kinds: Of what kind of problem they were.
        refused: Bad calls that raised what they must, by fault.
        invalid: Inputs that cannot be applied.
        lies: Plans that say ok and are not.
        escaped: Bad calls that were not refused as they must, and exceptions from good calls.
        traces: Steps that a bad call before them changed.
        compared: Steps compared with a twin that saw no bad call.
        late: Steps with a deadline that took longer than one and a half of it.
        timed: Steps with a deadline.
        examples: The first of everything that must not be.
        bins: Steps by time, logarithmic; see `PER_DECADE`.
        slowest: Seconds.
    """

    steps: int = 0
    statuses: Counter[str] = field(default_factory=Counter)
    kinds: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    invalid: int = 0
    lies: int = 0
    escaped: int = 0
    traces: int = 0
    compared: int = 0
    late: int = 0
    timed: int = 0
    examples: list[str] = field(default_factory=list)
    bins: Counter[str] = field(default_factory=Counter)
    slowest: float = 0.0

    def note(self, example: str) -> None:
        """Keep one of the first examples."""
        if len(self.examples) < _EXAMPLES:
            self.examples.append(example)


def run_chunk(seed: int, index: int, steps: int) -> dict[str, Any]:
    """Run `steps` control steps from the child `index` of a seed; return the line to write."""
    logging.getLogger("scp_mpc").setLevel(logging.ERROR)  # it is warned about by design
    began = perf_counter()
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))
    tally, fleet = Tally(), _fleet()
    shares = np.array([kind.share for kind, *_ in fleet])
    while tally.steps < steps:
        kind, mpc, twin = fleet[rng.choice(len(fleet), p=shares / shares.sum())]
        mpc.reset()
        twin.reset()
        # A deadline on the scale of a step does not repeat itself.
        paired = rng.random() < _TWIN and (kind.settings.time_limit() or 0.0) < 1e-5
        world = World(kind.problem, rng)
        for _ in range(min(EPISODE, steps - tally.steps)):
            _step(kind, mpc, twin if paired else None, world, rng, tally)
    return {
        "seed": seed,
        "chunk": index,
        "worker": _WORKER,
        "resident": resident(),
        "seconds": perf_counter() - began,
        **vars(tally),
    }


@cache
def _fleet() -> list[tuple[Kind, MPC, MPC]]:
    """Controllers and their twins, set up once per process."""
    return [(k, MPC(k.problem, k.settings), MPC(k.problem, k.settings)) for k in kinds()]


def _step(
    kind: Kind, mpc: MPC, twin: MPC | None, world: World, rng: np.random.Generator, tally: Tally
) -> None:
    x, x_ref, seen, time = world.x, world.reference(), world.seen(), world.time
    if rng.random() < _RESET:
        for one in (mpc, twin):
            if one is not None:
                one.reset()
    if rng.random() < _BAD_CALL:
        _bad_call(mpc, world, rng, tally)
    tally.steps += 1
    tally.kinds[kind.name] += 1
    began = perf_counter()
    try:
        plan = mpc.step(x, x_ref, seen, time=time)
    except Exception as error:  # whatever it is, it must not happen
        tally.escaped += 1
        tally.note(f"{kind.name}: {type(error).__name__}: {error}")
        world.advance(np.clip(0.0, kind.problem.u_min, kind.problem.u_max))
        return
    seconds = perf_counter() - began
    tally.statuses[plan.status.name] += 1
    tally.bins[str(int(np.floor(PER_DECADE * np.log10(seconds))))] += 1
    tally.slowest = max(tally.slowest, seconds)
    limit = kind.settings.time_limit()
    if limit is not None and limit > 1e-5:
        tally.timed += 1
        tally.late += seconds > 1.5 * limit
    finding = audit(kind.problem, x, mpc.obstacles, plan)
    tally.invalid += bool(finding.invalid)
    tally.lies += bool(finding.lie)
    if finding.invalid or finding.lie:
        tally.note(f"{kind.name}: {finding.invalid or finding.lie}")
    if twin is not None:
        tally.compared += 1
        if not _same(plan, twin.step(x, x_ref, seen, time=time)):
            tally.traces += 1
            tally.note(f"{kind.name}: differs from a controller that saw no bad call")
    u = plan.u0 if not finding.invalid else np.clip(0.0, kind.problem.u_min, kind.problem.u_max)
    world.advance(u)


def _bad_call(mpc: MPC, world: World, rng: np.random.Generator, tally: Tally) -> None:
    name, error, call = FAULTS[rng.integers(len(FAULTS))]
    try:
        call(mpc.step, world.x, world.reference(), mpc.problem)
    except error:
        tally.refused[name] += 1
    except Exception as other:
        tally.escaped += 1
        tally.note(f"{name}: {type(other).__name__}: {other}")
    else:
        tally.escaped += 1
        tally.note(f"{name}: accepted")


def _same(first: Plan, second: Plan) -> bool:
    return first.status is second.status and all(
        np.array_equal(a, b, equal_nan=True)
        for a, b in ((first.X, second.X), (first.U, second.U), (first.s, second.s))
    )


def resident() -> int:
    """Bytes of this process in memory; where the system does not say, the most there ever were."""
    pages = Path("/proc/self/statm")
    if pages.exists():
        return int(pages.read_text(encoding="ascii").split()[1]) * resource.getpagesize()
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else 1024 * most
