"""Figures drawn off screen: palette, sizes and how a picture gets into a file."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from scp_mpc.arrays import FloatArray

# Okabe and Ito's palette, told apart with every kind of colour vision.
ROBOT = "#0072B2"  # blue
OBSTACLE = "#D55E00"  # vermillion
PLAN = "#009E73"  # bluish green
LIMIT = "#000000"
HALF_PLANE = "#CC79A7"  # reddish purple
ACTIVE = "#F0E442"  # yellow
REFERENCE = "#A6A6A6"

DPI = 150


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of that many inches, free of the global state of pyplot."""
    figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG and return where it is."""
    figure.savefig(path, format="png")
    return path


def tidy(axes: Axes) -> None:
    """Take the frame off the free sides and lay a faint grid behind the data."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(visible=True, color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)


def as_map(axes: Axes) -> None:
    """Turn axes into a map of the plane: metres, equal on both axes."""
    tidy(axes)
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")


def show_square(axes: Axes, centre: FloatArray, half_width: float) -> None:
    """Show what is up to `half_width` from a centre (2,) on either axis [m]."""
    x, y = np.stack([centre - half_width, centre + half_width], axis=1)
    axes.set(xlim=x, ylim=y)


def legend_below(figure: Figure, panels: Sequence[Axes], columns: int) -> None:
    """Put one legend of all panels below everything, where it covers no data."""
    entries: dict[str, Artist] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            entries.setdefault(label, handle)
    handles, labels = list(entries.values()), list(entries)
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, frameon=False)
