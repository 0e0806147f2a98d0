"""Median and 99th percentile of the time per step of each robot, as bars."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

_COLOURS = {True: "#D55E00", False: "#0072B2"}  # Okabe and Ito's


def robots_figure(table: Sequence[dict[str, Any]]) -> Figure:
    """Draw a row per course: multi-start at every step, and one start."""
    names = list(dict.fromkeys(map(_name, table)))
    figure = Figure(figsize=(11.0, 1.6 + 0.45 * len(names)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    for multi_start, shift in ((True, -0.15), (False, 0.15)):
        part = [row for row in table if row["multi_start"] is multi_start]
        y = np.array([names.index(_name(row)) for row in part]) + shift
        median = [row["wall"]["median"] for row in part]
        p99 = [row["wall"]["p99"] for row in part]
        colour, label = _COLOURS[multi_start], "multi-start" if multi_start else "one start"
        axes.hlines(y, median, p99, color=colour, linewidth=2.0)
        axes.plot(median, y, "o", color=colour, label=f"{label}: median")
        axes.plot(p99, y, "|", color=colour, markersize=12, label=f"{label}: p99")
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.tick_params(labelsize=11)
    axes.grid(axis="x", alpha=0.3)
    axes.set_xlabel("time per control step [ms]", fontsize=13)
    figure.legend(
        *axes.get_legend_handles_labels(),
        fontsize=11,
        frameon=False,
        loc="outside upper center",
        ncols=4,
    )
    return figure


def _name(row: dict[str, Any]) -> str:
    return f"{row['robot']}, N = {row['horizon']}, {row['points']} point(s)"
