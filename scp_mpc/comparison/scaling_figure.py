"""Median and 99th percentile of the time per step over horizon and number of obstacles."""

from collections.abc import Sequence
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from scp_mpc.simulation.scenarios import DT

# Okabe and Ito's colours, told apart by any eye; markers help in print.
_COLOURS = ("#0072B2", "#56B4E9", "#009E73", "#E69F00", "#D55E00", "#CC79A7", "#000000")
_MARKERS = "osD^vPX"


def scaling_figure(table: Sequence[dict[str, Any]], fitted: dict[str, float]) -> Figure:
    """Draw one curve per number of obstacles over N, and one per horizon over the obstacles."""
    figure = Figure(figsize=(12.5, 6.0), layout="constrained")
    FigureCanvasAgg(figure)
    crowds = [row for row in table if row["world"].startswith("crowd") and row["multi_start"]]
    panels = figure.subplots(1, 2, sharey=True)
    for axes, along, across, label in (
        (panels[0], "horizon", "obstacles", "M ="),
        (panels[1], "obstacles", "horizon", "N ="),
    ):
        for i, value in enumerate(sorted({row[across] for row in crowds})):
            part = sorted(
                (row for row in crowds if row[across] == value), key=lambda row: row[along]
            )
            x = [row[along] for row in part]
            style = {"color": _COLOURS[i], "marker": _MARKERS[i], "linewidth": 2.0}
            axes.plot(x, [row["median_ms"] for row in part], label=f"{label} {value}", **style)
            p99 = [row["p99_ms"] for row in part]
            axes.plot(x, p99, color=_COLOURS[i], linestyle=":", linewidth=1.4)
        axes.axhline(1e3 * DT, color="black", linewidth=1.2, linestyle="--")
        axes.set_xscale("log")
        axes.set_yscale("log")
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
        axes.xaxis.set_minor_formatter(FuncFormatter(lambda *_: ""))
        ticks = sorted({row[along] for row in crowds})
        axes.set_xticks(ticks, [f"{tick}" for tick in ticks])
        axes.minorticks_off()
        axes.tick_params(labelsize=12)
        axes.grid(alpha=0.3)
        axes.legend(
            fontsize=11, frameon=False, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.13)
        )
    where = {"xytext": (0, 4), "textcoords": "offset points", "fontsize": 11}
    panels[0].annotate(f"sampling time {DT:g} s", (5, 1e3 * DT), **where)
    panels[0].set_xlabel("horizon N", fontsize=13)
    panels[1].set_xlabel("obstacles M", fontsize=13)
    panels[0].set_ylabel("time per control step [ms]", fontsize=13)
    panels[0].set_title(f"one start, M = 1, N >= 30: median ~ N^{fitted['a']:.2f}", fontsize=13)
    panels[1].set_title(f"one start, N = 30: median ~ M^{fitted['b']:.2f}", fontsize=13)
    figure.suptitle(
        "Solid: median, dotted: 99th percentile, with the ways past tried at every step",
        fontsize=12,
    )
    return figure
