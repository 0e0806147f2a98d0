"""How late a control step ends with a deadline, and what that costs.

    python benchmarks/run.py --only deadlines --out out/bench

Closed loops among twelve obstacles at N = 30, at the samples alone and at nodes between them,
without a deadline and with some.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from itertools import product
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.figures import BLACK, BLUE, VERMILION, canvas, plain
from benchmarks.progress import progress
from benchmarks.tables import table
from benchmarks.timing import closed_loop, milliseconds
from scp_mpc import Settings
from scp_mpc.arrays import FloatArray
from scp_mpc.simulation import Crowd

NAME = "deadlines"  # of the files
DEADLINES = (None, 5.0, 2.0)  # [ms]
_WORLD = Crowd(30, 12)
_NODES = (1, 4)
_LOOPS = 3  # as many times the steps as other benchmarks take
_STYLES = {None: (BLACK, "-"), 5.0: (BLUE, "--"), 2.0: (VERMILION, "-.")}


def rows(steps: int) -> list[dict[str, Any]]:
    """Run everything in this process; one row per deadline and number of nodes."""
    jobs = list(product(_NODES, DEADLINES))
    with progress(_LOOPS * steps * len(jobs)) as advance:
        return [_row(nodes, limit, _LOOPS * steps, advance) for nodes, limit in jobs]


def markdown(found: Sequence[dict[str, Any]]) -> str:
    """The table in Markdown."""
    names = (
        "Deadline [ms] | Nodes per interval | Steps | Median [ms] | p99 [ms] | Max [ms] "
        "| Max of processor time [ms] | 1 ms late | of these interrupted | How the steps ended"
    )
    return table(names, "rrrrrrrrrl", map(_cells, found))


def figure(found: Sequence[dict[str, Any]]) -> Figure:
    """Draw, for each run, the share of steps that take longer than a time."""
    drawing, panels = canvas(12.5, 5.5, 2, sharey=True)
    for axes, nodes in zip(panels, _NODES, strict=True):
        for row in (row for row in found if row["nodes"] == nodes):
            colour, line = _STYLES[row["deadline_ms"]]
            times = np.sort(row["processor_ms"])
            share = 1 - np.arange(len(times)) / len(times)
            name = "none" if row["deadline_ms"] is None else f"{row['deadline_ms']:g} ms"
            axes.step(times, share, where="pre", color=colour, linestyle=line, lw=2, label=name)
            if row["deadline_ms"] is not None:
                axes.axvline(row["deadline_ms"], color=colour, linestyle=":", linewidth=1.2)
        plain(axes, "xy", (0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200))
        where = "the samples" if nodes == 1 else f"{nodes} nodes per interval"
        axes.set_title(f"obstacles constrained at {where}", fontsize=13)
        axes.set_xlabel("processor time of a control step [ms]", fontsize=13)
    panels[-1].legend(title="deadline", fontsize=12, title_fontsize=12, frameon=False)
    panels[0].set_ylabel("share of steps that take longer", fontsize=13)
    drawing.suptitle(f"N = {_WORLD.horizon}, {_WORLD.count} obstacles", fontsize=13)
    return drawing


def _row(
    nodes: int, limit: float | None, steps: int, advance: Callable[[], object]
) -> dict[str, Any]:
    settings = Settings(deadline=None if limit is None else 1e-3 * limit)
    problem = _WORLD.problem("exact", None, nodes)
    run = list(closed_loop(_WORLD, problem, settings, steps, advance))
    times: FloatArray = 1e3 * np.array([step.wall for step in run])
    late = times > (np.inf if limit is None else limit + 1)
    processor = [1e3 * step.thread for step in run]
    return {
        "deadline_ms": limit,
        "nodes": nodes,
        "steps": steps,
        **{f"{key}_ms": value for key, value in milliseconds(times / 1e3).items()},
        "max_processor_ms": max(processor),
        "late": int(late.sum()),
        "late_interrupted": int((late & np.array([step.interrupted for step in run])).sum()),
        "processor_ms": processor,
        "statuses": dict(Counter(step.plan.status.name for step in run).most_common()),
    }


def _cells(row: dict[str, Any]) -> tuple[object, ...]:
    limit = row["deadline_ms"]
    return (
        "none" if limit is None else f"{limit:g}",
        row["nodes"],
        row["steps"],
        *(f"{row[key]:.2f}" for key in ("median_ms", "p99_ms", "max_ms", "max_processor_ms")),
        "" if limit is None else row["late"],
        "" if limit is None else row["late_interrupted"],
        ", ".join(f"{name} {count}" for name, count in row["statuses"].items()),
    )
