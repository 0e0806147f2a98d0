"""Promised against measured risk on logarithmic axes, with the diagonal between them."""

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
    "samples only": "X",
    "joint, uniform": "s",
    "joint, iterative": "D",
    "containment": "^",
    "report": "*",
}
_KINDS = tuple(_MARKERS)
_SPREAD = 1.045  # factor between neighbours that promise the same
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
        _panel(panels[1], closed)
        panels[1].set_title("closed loop: episodes in contact (not promised)", fontsize=14)
        panels[1].set_ylabel("share of episodes with contact [1]", fontsize=14)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=12, frameon=False)
    return figure


def _panel(axes: Axes, rows: Sequence[Row]) -> None:
    shown = [row for row in rows if "measured" in row]
    deltas = sorted({row["delta"] for row in shown})
    span = np.array([min(deltas) / 1.8, max(deltas) * 1.8])
    floor = min([_FLOOR * 5, *(row["high"] / 2 for row in shown)])
    axes.fill_between(span, span, 1.0, color="#999999", alpha=0.15, linewidth=0)
    axes.plot(span, span, color="black", linewidth=1.5, label="promise: measured = promised")
    series = {(row["inflation"], row["kind"]) for row in shown}
    ordered = [(i, k) for i in _COLOURS for k in _KINDS if (i, k) in series]
    for place, (inflation, kind) in enumerate(ordered):
        part = [row for row in shown if (row["inflation"], row["kind"]) == (inflation, kind)]
        shift = _SPREAD ** (place - (len(ordered) - 1) / 2)
        measured = np.array([row["measured"] for row in part])
        ends = np.array([[row["low"], row["high"]] for row in part]).T
        axes.errorbar(
            [shift * row["delta"] for row in part],
            np.maximum(measured, floor),
            yerr=np.abs(np.maximum(ends, floor) - np.maximum(measured, floor)),
            color=_COLOURS[inflation],
            marker=_MARKERS[kind],
            markerfacecolor=_COLOURS[inflation] if inflation == "exact" else "white",
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
    axes.text(
        0.03,
        0.97,
        "promise broken",
        transform=axes.transAxes,
        fontsize=13,
        va="top",
        color="#555555",
    )
