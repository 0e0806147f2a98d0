"""Tracking errors under wind: every run a point, every mean with its interval."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

Row = dict[str, Any]

# Okabe and Ito's colours; filled (rejection) against hollow (nominal) helps in print.
_COLOURS = {30: "#0072B2", 8: "#D55E00"}
_TICKS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)


def wind_figure(main: Sequence[Row], others: Sequence[Row] = ()) -> Figure:
    """Draw the RMS and the median error of all runs; the RMS under other disturbances, too.

    Args:
        main: Rows of `wind.measured`; the first one is the mark to reach.
        others: Rows of other disturbances.
    """
    rows = max(len(main), len(others))
    count = 3 if others else 2
    figure = Figure(figsize=(4.0 + 5.2 * count, 2.2 + 0.45 * rows), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, count)
    title = f"{main[0]['disturbance']}, {main[0]['runs']} runs each"
    _panel(panels[0], main, [_who(row) for row in main], "rms", "rms_mean", "rms_interval")
    panels[0].set_xlabel("RMS tracking error of a run [m]", fontsize=14)
    _panel(panels[1], main, [""] * len(main), "medians", "usual", "usual_interval")
    panels[1].set_xlabel("median tracking error of a run [m]", fontsize=14)
    for axes, mark in zip(panels, ("rms_mean", "usual"), strict=False):
        axes.set_title(title, fontsize=14)
        axes.axvline(main[0][mark], color="#555555", linestyle=":", linewidth=1.5)
    if others:
        names = [f"{row['disturbance']}: {_who(row)} ({row['runs']})" for row in others]
        _panel(panels[2], others, names, "rms", "rms_mean", "rms_interval")
        panels[2].set_title("other disturbances", fontsize=14)
        panels[2].set_xlabel("RMS tracking error of a run [m]", fontsize=14)
    marker: Row = {"linestyle": "none", "marker": "D", "markersize": 9, "color": "black"}
    point: Row = {"linestyle": "none", "marker": "o", "markersize": 5, "color": "#777777"}
    handles = [
        Line2D([], [], label="mean and its 95 % interval", **marker),
        Line2D([], [], label="the same, nominal", markerfacecolor="white", **marker),
        Line2D([], [], label="one run", **point),
        Line2D([], [], color="#555555", linestyle=":", label="mean of the first row"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=12, frameon=False)
    return figure


def _panel(
    axes: Axes, rows: Sequence[Row], names: Sequence[str], every: str, mean: str, ends: str
) -> None:
    """Points of the column `every`, and `mean` with the interval `ends`; from the top down."""
    rng = np.random.default_rng(0)
    for place, row in enumerate(rows):
        color, values = _COLOURS.get(row["horizon"], "black"), np.array(row[every])
        scatter = place + rng.uniform(-0.25, 0.25, len(values))
        axes.plot(values, scatter, "o", color=color, alpha=0.45, markersize=4, markeredgewidth=0)
        axes.errorbar(
            [row[mean]],
            [place],
            xerr=np.abs(np.array(row[ends]) - row[mean])[:, None],
            color="black",
            marker="D",
            markersize=9,
            markerfacecolor=color if row["rejects"] else "white",
            markeredgewidth=1.8,
            elinewidth=2.0,
            capsize=5,
        )
    axes.set_yticks(range(len(rows)), names)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xscale("log")
    shown = np.concatenate([row[every] for row in rows])
    low, high = 0.8 * shown.min(), 1.25 * shown.max()
    ticks = [t for t in _TICKS if low <= t <= high]
    axes.set_xlim(low, high)
    axes.set_xticks(ticks, [f"{t:g}" for t in ticks])
    axes.minorticks_off()
    axes.grid(axis="x", alpha=0.3)
    axes.tick_params(labelsize=12)


def _who(row: Row) -> str:
    return f"N = {row['horizon']}, {row['controller']}"
