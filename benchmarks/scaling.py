"""How the time per control step grows with the horizon and with the number of obstacles.

    python benchmarks/run.py --only scaling --out out/bench

For each pair of both, a closed loop among a crowd (`scp_mpc.simulation.Crowd`) is run twice, with
the other sides tried and without. The report's scenarios 1 and 2 stand beside them. Exponents are
fitted to the medians: time ~ N^a, time ~ M^b.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.figures import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    canvas,
    plain,
)
from benchmarks.progress import progress
from benchmarks.tables import table
from benchmarks.timing import closed_loop, milliseconds
from scp_mpc import Settings
from scp_mpc.simulation import DT, SCENARIOS, Crowd, Scenario

HORIZONS = (5, 8, 15, 30, 60, 120, 200)
OBSTACLES = (1, 2, 5, 12, 25, 50)
NAME = "scaling"  # of the files
_LARGE = 1500  # N times M beyond which a twentieth of the steps has to do
_COLOURS = (BLUE, SKY, GREEN, ORANGE, VERMILION, PURPLE, BLACK)
_MARKERS = "osD^vPX"  # help in print


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


def exponents(found: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Fit time ~ N^a for one obstacle from N = 30 on, and time ~ M^b at N = 30, to the medians."""
    crowds = [row for row in found if row["world"].startswith("crowd") and not row["multi_start"]]
    along = [(row["horizon"], row["median_ms"]) for row in crowds if row["obstacles"] == 1]
    across = [(row["obstacles"], row["median_ms"]) for row in crowds if row["horizon"] == 30]
    return {"a": _slope([p for p in along if p[0] >= 30]), "b": _slope(across)}


def markdown(found: Sequence[dict[str, Any]]) -> str:
    """The table in Markdown."""
    names = (
        "Problem | N | Obstacles | Multi-start | Steps | Active | Median [ms] | p99 [ms] "
        "| Max [ms] | Certified, no slack | Softened | Other | Programs"
    )
    return table(names, "lrrlrrrrrrrrl", map(_cells, found))


def figure(found: Sequence[dict[str, Any]], fitted: dict[str, float]) -> Figure:
    """Draw one curve per number of obstacles over N, and one per horizon over the obstacles."""
    drawing, panels = canvas(12.5, 6.0, 2, sharey=True)
    crowds = [row for row in found if row["world"].startswith("crowd") and row["multi_start"]]
    for axes, along, across, label in (
        (panels[0], "horizon", "obstacles", "M ="),
        (panels[1], "obstacles", "horizon", "N ="),
    ):
        for i, value in enumerate(sorted({row[across] for row in crowds})):
            part = sorted(
                (row for row in crowds if row[across] == value), key=lambda row: row[along]
            )
            x = [row[along] for row in part]
            style: dict[str, Any] = {"color": _COLOURS[i], "marker": _MARKERS[i], "linewidth": 2.0}
            axes.plot(x, [row["median_ms"] for row in part], label=f"{label} {value}", **style)
            p99 = [row["p99_ms"] for row in part]
            axes.plot(x, p99, color=_COLOURS[i], linestyle=":", linewidth=1.4)
        axes.axhline(1e3 * DT, color="black", linewidth=1.2, linestyle="--")
        plain(axes, "xy", sorted({row[along] for row in crowds}))
        axes.legend(
            fontsize=11, frameon=False, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.13)
        )
    where: dict[str, Any] = {"xytext": (0, 4), "textcoords": "offset points", "fontsize": 11}
    panels[0].annotate(f"sampling time {DT:g} s", (5, 1e3 * DT), **where)
    panels[0].set_xlabel("horizon N", fontsize=13)
    panels[1].set_xlabel("obstacles M", fontsize=13)
    panels[0].set_ylabel("time per control step [ms]", fontsize=13)
    panels[0].set_title(f"one start, M = 1, N >= 30: median ~ N^{fitted['a']:.2f}", fontsize=13)
    panels[1].set_title(f"one start, N = 30: median ~ M^{fitted['b']:.2f}", fontsize=13)
    drawing.suptitle(
        "Solid: median, dotted: 99th percentile, with the ways past tried at every step",
        fontsize=12,
    )
    return drawing


def _steps(world: Scenario | Crowd, steps: int) -> int:
    return steps if world.horizon * len(world.bodies) <= _LARGE else max(steps // 20, 1)


def _row(
    world: Scenario | Crowd, multi_start: bool, steps: int, advance: Callable[[], object]
) -> dict[str, Any]:
    settings = Settings(multi_start=multi_start, deadline=None)
    run = list(closed_loop(world, world.problem("axes"), settings, steps, advance))
    plans = [step.plan for step in run]
    programs: Counter[str] = sum((Counter(plan.qps) for plan in plans), Counter())
    times = milliseconds([step.wall for step in run])
    return {
        "world": world.name,
        "horizon": world.horizon,
        "obstacles": len(world.bodies),
        "multi_start": multi_start,
        "steps": steps,
        "active": sum(plan.iterate.touches for plan in plans),
        **{f"{key}_ms": value for key, value in times.items()},
        "cost": float(sum(plan.cost for plan in plans)),
        "statuses": dict(Counter(plan.status.name for plan in plans)),
        "programs": dict(programs),
    }


def _slope(points: Sequence[tuple[int, float]]) -> float:
    if len(points) < 2:
        return float("nan")
    x, y = np.log(np.array(points)).T
    return float(np.polyfit(x, y, 1)[0])


def _cells(row: dict[str, Any]) -> tuple[object, ...]:
    statuses = Counter(row["statuses"])
    converged, softened = statuses["CONVERGED"], statuses["SOFTENED"]
    return (
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
