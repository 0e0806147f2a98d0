"""Promised against measured risk on logarithmic axes, with a step where each promise ends."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

Row = dict[str, Any]

# Okabe and Ito's blue and vermilion, told apart by any eye; filled against hollow helps in print.
_COLOURS = {"exact": "#0072B2", "axes": "#D55E00"}
_MARKERS = {
    "stage": "o",
    "sample": "v",
    "samples only": "X",
    "joint, uniform": "s",
    "joint, iterative": "D",
    "containment": "^",
    "report": "*",
}
_KINDS = tuple(_MARKERS)
_MISTAKE = "#000000"  # of what promises nothing between the samples
_SPREAD = 1.065  # factor between neighbours that promise the same
_FLOOR = 2e-5


def risk_figure(opened: Sequence[Row], closed: Sequence[Row] = ()) -> Figure:
    """Draw the worst scene of each promise; beside it, the episodes in contact if there are any.

    Args:
        opened: Rows of `risk.open_loop`.
        closed: Rows of `risk.closed_loop`.
    """
    figure = Figure(figsize=(13.0 if closed else 8.0, 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, 2 if closed else 1, squeeze=False)[0]
    _panel(panels[0], opened)
    panels[0].set_title("open loop: the worst scene", fontsize=14)
    panels[0].set_ylabel("measured probability of contact [1]", fontsize=14)
    if closed:
        _panel(panels[1], closed, promised=False)
        panels[1].set_title("closed loop: episodes in contact (not promised)", fontsize=14)
        panels[1].set_ylabel("share of episodes with contact [1]", fontsize=14)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=12, frameon=False)
    return figure


def _panel(axes: Axes, rows: Sequence[Row], promised: bool = True) -> None:
    shown = [row for row in rows if "measured" in row]
    deltas = sorted({row["delta"] for row in shown})
    span = np.array([min(deltas) / 1.8, max(deltas) * 1.8])
    floor = max(_FLOOR, min([1e-4, *(row["high"] / 2 for row in shown)]))
    axes.plot(span, span, color="black", linewidth=1.0, linestyle=":", label="diagonal")
    series = {(row["inflation"], row["kind"]) for row in shown}
    ordered = [(i, k) for i in _COLOURS for k in _KINDS if (i, k) in series]
    width = _SPREAD ** (len(ordered) / 2)
    # Neighbours stand aside of the diagonal: a step for each.
    for at, delta in enumerate(deltas if promised else []):
        step = np.array([delta / width, delta * width])
        label = "promise: at most delta" if at == 0 else None
        axes.fill_between(step, delta, 1.2, color="#999999", alpha=0.15, linewidth=0)
        axes.plot(step, [delta, delta], color="black", linewidth=2.0, label=label)
    for place, (inflation, kind) in enumerate(ordered):
        part = [row for row in shown if (row["inflation"], row["kind"]) == (inflation, kind)]
        shift = _SPREAD ** (place - (len(ordered) - 1) / 2)
        measured = np.array([row["measured"] for row in part])
        ends = np.array([[row["low"], row["high"]] for row in part]).T
        color = _MISTAKE if kind == "samples only" else _COLOURS[inflation]
        axes.errorbar(
            [shift * row["delta"] for row in part],
            np.maximum(measured, floor),
            yerr=np.abs(np.maximum(ends, floor) - np.maximum(measured, floor)),
            color=color,
            marker=_MARKERS[kind],
            markerfacecolor="white" if inflation == "axes" else color,
            markersize=14 if kind == "report" else 9,
            markeredgewidth=1.8,
            elinewidth=1.8,
            capsize=4,
            linestyle="none",
            label=f"{inflation}: {kind}",
        )
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(*span)
    top = max([span[1], *(1.3 * row["high"] for row in shown)])
    axes.set_ylim(floor, min(top, 1.2))
    axes.set_xticks(deltas, [f"{delta:g}" for delta in deltas])
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.tick_params(labelsize=13)
    axes.grid(alpha=0.3)
    axes.set_xlabel("promised probability delta [1]", fontsize=14)
    if promised:
        axes.text(
            0.03,
            0.03,
            "grey: promise broken",
            transform=axes.transAxes,
            fontsize=13,
            va="bottom",
            color="#555555",
        )
