"""Tracking under wind: tables, and a figure where every run is a point."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from benchmarks.figures import BLUE, VERMILION, canvas, plain
from benchmarks.tables import table

Row = dict[str, Any]

_NAMES = (
    "N | Controller | Disturbance | Runs | RMS error [m]: mean (95 %) | median "
    "| Difference (95 %) | To the report's way (95 %) | Median error [m] | Least clearance [m] "
    "| Contacts | Slack steps"
)
_GROUPS = {
    "main": "The report's wind, its obstacle, its no-go sets",
    "calm": "No disturbance",
    "alone": "The report's wind without an obstacle",
    "others": "Other disturbances",
    "prediction": "The robot's own covariance in the no-go sets",
    "exact": "The report's wind with exact no-go sets",
}

_COLOURS = {30: BLUE, 8: VERMILION}  # filled (rejection) against hollow (nominal)
_TICKS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)


def markdown(groups: Mapping[str, Sequence[Row]], steps: int) -> str:
    """All groups with a line of explanation each."""
    parts = [
        f"{steps} steps per run; the same winds for all variants. The difference is to the first "
        "row with the same disturbance, wind by wind; the report's way is N = 30, nominal, from "
        "the last plan alone. Error: distance from the reference of the same time; its RMS is over "
        "a run, mean and median are over the runs. Clearance: from the no-go set."
    ]
    for group, rows in groups.items():
        if not rows:
            continue
        parts.append(f"{_GROUPS[group]}:")
        parts.append(table(_NAMES, "rllrlrllrrrr", map(_cells, rows)))
    return "\n\n".join(parts)


def _cells(row: Row) -> list[object]:
    return [
        row["horizon"],
        row["controller"],
        row["disturbance"],
        row["runs"],
        f"{row['rms_mean']:.3f} {_ends(row['rms_interval'])}",
        f"{row['rms_median']:.3f}",
        f"{row['excess']:+.3f} {_ends(row['excess_interval'])}",
        f"{row['beyond']:+.3f} {_ends(row['beyond_interval'])}" if "beyond" in row else "",
        f"{row['usual']:.3f}",
        f"{row['clearance']:.3f}" if row["obstacle"] else "",
        row["contact"],
        row["slack"],
    ]


def _ends(ends: Sequence[float]) -> str:
    return f"({ends[0]:.3f} to {ends[1]:.3f})"


def wind_figure(main: Sequence[Row], others: Sequence[Row] = ()) -> Figure:
    """Draw the RMS and the median error of all runs; the RMS under other disturbances, too.

    Args:
        main: Rows of `wind.measured`; the first one is the mark to reach.
        others: Rows of other disturbances.
    """
    rows = max(len(main), len(others))
    count = 3 if others else 2
    figure, panels = canvas(4.0 + 5.2 * count, 2.2 + 0.45 * rows, count)
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
    shown = np.concatenate([row[every] for row in rows])
    low, high = 0.8 * shown.min(), 1.25 * shown.max()
    plain(axes, "x", [t for t in _TICKS if low <= t <= high])
    axes.set_xlim(low, high)
    axes.set_yticks(range(len(rows)), names)
    axes.set_ylim(len(rows) - 0.5, -0.5)


def _who(row: Row) -> str:
    return f"N = {row['horizon']}, {row['controller']}"
