"""How late a control step ends with a deadline, and what that costs.

Closed loops among twelve obstacles at N = 30, at the samples alone and at points between them,
without a deadline and with some. Each call of `MPC.step` is timed twice: by the clock on the wall,
and by the processor time of its thread, which leaves out what the operating system gives to others.
"""

import gc
import resource
from collections import Counter
from collections.abc import Callable, Sequence
from itertools import product
from time import perf_counter, thread_time
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from scp_mpc.arrays import FloatArray
from scp_mpc.comparison.progress import progress
from scp_mpc.control.mpc import MPC
from scp_mpc.settings import Settings
from scp_mpc.simulation.crowds import Crowd

NAME = "deadlines"  # of the files
DEADLINES = (None, 5.0, 2.0)  # [ms]
_WORLD = Crowd(30, 12)
_POINTS = (1, 4)
_LOOPS = 3  # as many times the steps as other benchmarks take
_STYLES = {None: ("#000000", "-"), 5.0: ("#0072B2", "--"), 2.0: ("#D55E00", "-.")}


def rows(steps: int) -> list[dict[str, Any]]:
    """Run everything in this process; one row per deadline and number of points."""
    jobs = list(product(_POINTS, DEADLINES))
    with progress(_LOOPS * steps * len(jobs)) as advance:
        return [_row(points, limit, _LOOPS * steps, advance) for points, limit in jobs]


def markdown(table: Sequence[dict[str, Any]]) -> str:
    """The table in Markdown."""
    head = (
        "| Deadline [ms] | Points per interval | Steps | Median [ms] | p99 [ms] | Max [ms] "
        "| Max of processor time [ms] | 1 ms late | of these interrupted | How the steps ended |\n"
        "|--:|--:|--:|--:|--:|--:|--:|--:|--:|:--|"
    )
    return "\n".join([head, *map(_line, table)])


def figure(table: Sequence[dict[str, Any]]) -> Figure:
    """Draw, for each run, the share of steps that take longer than a time."""
    canvas = Figure(figsize=(12.5, 5.5), layout="constrained")
    FigureCanvasAgg(canvas)
    for axes, points in zip(canvas.subplots(1, 2, sharey=True), _POINTS, strict=True):
        for row in (row for row in table if row["points"] == points):
            colour, line = _STYLES[row["deadline_ms"]]
            times = np.sort(row["processor_ms"])
            share = 1 - np.arange(len(times)) / len(times)
            name = "none" if row["deadline_ms"] is None else f"{row['deadline_ms']:g} ms"
            axes.step(times, share, where="pre", color=colour, linestyle=line, lw=2, label=name)
            if row["deadline_ms"] is not None:
                axes.axvline(row["deadline_ms"], color=colour, linestyle=":", linewidth=1.2)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_xticks([0.2, 0.5, 1, 2, 5, 10, 20, 50], ["0.2", "0.5", *"125", "10", "20", "50"])
        axes.minorticks_off()
        axes.tick_params(labelsize=12)
        axes.grid(alpha=0.3)
        where = "the samples" if points == 1 else f"{points} points per interval"
        axes.set_title(f"obstacles constrained at {where}", fontsize=13)
        axes.set_xlabel("processor time of a control step [ms]", fontsize=13)
    axes.legend(title="deadline", fontsize=12, title_fontsize=12, frameon=False)
    canvas.axes[0].set_ylabel("share of steps that take longer", fontsize=13)
    canvas.suptitle(f"N = {_WORLD.horizon}, {_WORLD.count} obstacles", fontsize=13)
    return canvas


def _row(
    points: int, limit: float | None, steps: int, advance: Callable[[], object]
) -> dict[str, Any]:
    problem = _WORLD.problem("exact", None, points)
    mpc = MPC(problem, Settings(deadline=None if limit is None else 1e-3 * limit))
    x, wall, processor, interrupted = _WORLD.start(), [], [], []
    gc.collect()
    gc.freeze()
    for k in range(steps):
        x_ref, obstacles = _WORLD.states(k), _WORLD.predictions(k)
        switches, began, worked = _switches(), perf_counter(), thread_time()
        plan = mpc.step(x, x_ref, obstacles)
        processor.append(1e3 * (thread_time() - worked))
        wall.append(1e3 * (perf_counter() - began))
        interrupted.append(_switches() > switches)
        x = problem.model.step(x, plan.u0)
        advance()
    gc.unfreeze()
    times: FloatArray = np.array(wall)
    late = times > (np.inf if limit is None else limit + 1)
    return {
        "deadline_ms": limit,
        "points": points,
        "steps": steps,
        "median_ms": float(np.median(times)),
        "p99_ms": float(np.percentile(times, 99)),
        "max_ms": float(times.max()),
        "max_processor_ms": max(processor),
        "late": int(late.sum()),
        "late_interrupted": int((late & np.array(interrupted)).sum()),
        "processor_ms": processor,
        "statuses": dict(Counter({s.name: n for s, n in mpc.counts.items()}).most_common()),
    }


def _switches() -> int:
    """How often the operating system took the processor away from this thread."""
    return resource.getrusage(resource.RUSAGE_THREAD).ru_nivcsw


def _line(row: dict[str, Any]) -> str:
    limit = row["deadline_ms"]
    ended = ", ".join(f"{name} {count}" for name, count in row["statuses"].items())
    cells = (
        "none" if limit is None else f"{limit:g}",
        row["points"],
        row["steps"],
        *(f"{row[key]:.2f}" for key in ("median_ms", "p99_ms", "max_ms", "max_processor_ms")),
        "" if limit is None else row["late"],
        "" if limit is None else row["late_interrupted"],
        ended,
    )
    return "| " + " | ".join(map(str, cells)) + " |"
