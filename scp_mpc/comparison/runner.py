"""All benchmarks behind one door: each writes a table, its numbers and mostly a figure."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from scp_mpc.comparison import deadlines, horizon_timing, optimality, programs, robots, scaling
from scp_mpc.comparison.one_thread import in_one_thread
from scp_mpc.comparison.robots_figure import robots_figure
from scp_mpc.comparison.scaling_figure import scaling_figure
from scp_mpc.comparison.timing_table import measured_on
from scp_mpc.provenance import provenance

BENCHMARKS = ("horizon", "scaling", "deadlines", "optimality", "programs", "robots")


def run(name: str, out: Path, steps: int, seed: int, echo: Callable[[str], None]) -> None:
    """Run one benchmark in a process of one thread and write its files into a folder.

    Args:
        name: One of `BENCHMARKS`.
        out: The folder.
        steps: Control steps of each closed loop.
        seed: Of turns and random starts.
        echo: Takes the Markdown table.
    """
    if name == "horizon":
        numbers = out / f"{horizon_timing.WITH_CROWDS}.json"
        horizon_timing.main(numbers, out, steps, seed, echo=echo, crowds=True)
    elif name == "scaling":
        table = in_one_thread(scaling.rows, steps)
        fitted = scaling.exponents(table)
        text = scaling.markdown(table) + (
            f"\n\nMedian ~ N^{fitted['a']:.2f} (one obstacle, N >= 30, one start), "
            f"~ M^{fitted['b']:.2f} (N = 30, one start)."
        )
        _write(out, scaling.NAME, text, {"rows": table, "exponents": fitted}, echo)
        _save(scaling_figure(table, fitted), out / f"{scaling.NAME}.png")
    elif name == "deadlines":
        table = in_one_thread(deadlines.rows, steps)
        _write(out, deadlines.NAME, deadlines.markdown(table), {"rows": table}, echo)
        _save(deadlines.figure(table), out / f"{deadlines.NAME}.png")
    elif name == "optimality":
        table = in_one_thread(optimality.rows, steps, optimality.STARTS, seed)
        _write(out, optimality.NAME, optimality.markdown(table), {"rows": table}, echo)
    elif name == "robots":
        table = in_one_thread(robots.rows, steps)
        _write(out, robots.NAME, robots.markdown(table), {"rows": table}, echo)
        _save(robots_figure(table), out / f"{robots.NAME}.png")
    else:
        table = in_one_thread(programs.rows, steps)
        _write(out, programs.NAME, programs.markdown(table), {"rows": table}, echo)


def _write(
    out: Path, name: str, table: str, content: dict[str, Any], echo: Callable[[str], None]
) -> None:
    origin = provenance()
    text = f"{table}\n\n{measured_on(origin)}"
    echo(text)
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.md").write_text(text + "\n", encoding="utf-8")
    numbers = json.dumps(content | {"provenance": origin}, indent=2)
    (out / f"{name}.json").write_text(numbers + "\n", encoding="utf-8")


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=150)
