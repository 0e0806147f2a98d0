"""How the time per control step grows with the horizon and with the number of obstacles.

For each pair of both, a closed loop among a crowd (`scp_mpc.simulation.Crowd`) is run twice, with
the other sides tried and without, and each call of `MPC.step` is timed. The report's scenarios 1
and 2 stand beside them. Exponents are fitted to the medians: time ~ N^a, time ~ M^b.
"""

import gc
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from time import perf_counter
from typing import Any

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.comparison.progress import progress
from scp_mpc.control.mpc import MPC
from scp_mpc.scp.plan import Plan
from scp_mpc.settings import Settings
from scp_mpc.simulation.crowds import Crowd
from scp_mpc.simulation.scenarios import SCENARIOS, Scenario

HORIZONS = (5, 8, 15, 30, 60, 120, 200)
OBSTACLES = (1, 2, 5, 12, 25, 50)
NAME = "scaling"  # of the files
_LARGE = 1500  # N times M beyond which a twentieth of the steps has to do


def rows(
    steps: int, horizons: Sequence[int] = HORIZONS, obstacles: Sequence[int] = OBSTACLES
) -> list[dict[str, Any]]:
    """Run everything in this process; one row per problem and setting.

    Args:
        steps: Control steps of each closed loop.
        horizons: Of the crowds.
        obstacles: Likewise.
    """
    worlds: list[Scenario | Crowd] = [SCENARIOS["scenario-2"], SCENARIOS["scenario-1"]]
    worlds += [Crowd(N, M) for N, M in product(horizons, obstacles)]
    jobs = [
        (world, multi_start, _steps(world, steps))
        for world in worlds
        for multi_start in (False, True)
    ]
    with progress(sum(count for *_, count in jobs)) as advance:
        return [_row(world, multi_start, count, advance) for world, multi_start, count in jobs]


def exponents(table: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Fit time ~ N^a for one obstacle from N = 30 on, and time ~ M^b at N = 30, to the medians."""
    crowds = [row for row in table if row["world"].startswith("crowd") and not row["multi_start"]]
    along = [(row["horizon"], row["median_ms"]) for row in crowds if row["obstacles"] == 1]
    across = [(row["obstacles"], row["median_ms"]) for row in crowds if row["horizon"] == 30]
    return {"a": _slope([p for p in along if p[0] >= 30]), "b": _slope(across)}


def markdown(table: Sequence[dict[str, Any]]) -> str:
    """The table in Markdown."""
    head = (
        "| Problem | N | Obstacles | Multi-start | Steps | Active | Median [ms] | p99 [ms] "
        "| Max [ms] | Certified, no slack | Softened | Other | Programs |\n"
        "|:--|--:|--:|:--|--:|--:|--:|--:|--:|--:|--:|--:|:--|"
    )
    return "\n".join([head, *map(_line, table)])


def _steps(world: Scenario | Crowd, steps: int) -> int:
    count = world.count if isinstance(world, Crowd) else 1
    return steps if world.horizon * count <= _LARGE else max(steps // 20, 1)


def _row(
    world: Scenario | Crowd, multi_start: bool, steps: int, advance: Callable[[], object]
) -> dict[str, Any]:
    plans, seconds = zip(*_drive(world, multi_start, steps, advance), strict=True)
    times: FloatArray = 1e3 * np.array(seconds)
    statuses = Counter(plan.status.name for plan in plans)
    programs: Counter[str] = sum((Counter(plan.qps) for plan in plans), Counter())
    return {
        "world": world.name,
        "horizon": world.horizon,
        "obstacles": len(world.predictions(0)),
        "multi_start": multi_start,
        "steps": steps,
        "active": sum(plan.iterate.touches for plan in plans),
        "median_ms": float(np.median(times)),
        "p99_ms": float(np.percentile(times, 99)),
        "max_ms": float(times.max()),
        "cost": float(sum(plan.cost for plan in plans)),
        "statuses": dict(statuses),
        "programs": dict(programs),
    }


def _drive(
    world: Scenario | Crowd, multi_start: bool, steps: int, advance: Callable[[], object]
) -> Iterator[tuple[Plan, float]]:
    """A closed loop without disturbance; one step solved before the clock runs."""
    problem = world.problem("axes")
    MPC(problem).step(world.start(), world.states(0), world.predictions(0))
    mpc, x = MPC(problem, Settings(multi_start=multi_start)), world.start()
    gc.collect()
    for k in range(steps):
        x_ref, obstacles = world.states(k), world.predictions(k)
        began = perf_counter()
        plan = mpc.step(x, x_ref, obstacles)
        yield plan, perf_counter() - began
        x = problem.model.step(x, plan.u0)
        advance()


def _slope(points: Sequence[tuple[int, float]]) -> float:
    if len(points) < 2:
        return float("nan")
    x, y = np.log(np.array(points)).T
    return float(np.polyfit(x, y, 1)[0])


def _line(row: dict[str, Any]) -> str:
    statuses = Counter(row["statuses"])
    converged, softened = statuses["CONVERGED"], statuses["SOFTENED"]
    cells = (
        row["world"],
        row["horizon"],
        row["obstacles"],
        "on" if row["multi_start"] else "off",
        row["steps"],
        row["active"],
        *(f"{row[key]:.2f}" for key in ("median_ms", "p99_ms", "max_ms")),
        converged,
        softened,
        row["steps"] - converged - softened,
        ", ".join(f"{name} {count}" for name, count in sorted(row["programs"].items())),
    )
    return "| " + " | ".join(map(str, cells)) + " |"
