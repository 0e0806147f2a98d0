"""What all figures of the benchmarks share: a canvas, colours that any eye tells apart, axes."""

from collections.abc import Sequence
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

# Okabe and Ito's.
BLUE, SKY, GREEN, ORANGE, VERMILION, PURPLE, BLACK = (
    "#0072B2",
    "#56B4E9",
    "#009E73",
    "#E69F00",
    "#D55E00",
    "#CC79A7",
    "#000000",
)


def canvas(
    width: float, height: float, columns: int = 1, **shared: Any
) -> tuple[Figure, list[Axes]]:
    """A figure of some inches with a row of panels; `shared` goes to `Figure.subplots`."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, list(figure.subplots(1, columns, squeeze=False, **shared)[0])


def plain(axes: Axes, log: str = "", x: Sequence[float] = (), size: int = 12) -> None:
    """Grid and readable ticks; `log` names the axes with decades, `x` the ticks of the first."""
    for name in log:
        axis = {"x": axes.xaxis, "y": axes.yaxis}[name]
        axes.set(**{f"{name}scale": "log"})
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_formatter(NullFormatter())
    if len(x):
        axes.set_xticks(list(x), [f"{tick:g}" for tick in x])
        axes.minorticks_off()
    axes.tick_params(labelsize=size)
    axes.grid(alpha=0.3)


def legend_below(figure: Figure, axes: Axes, columns: int) -> None:
    """One legend for all panels, from the entries of one."""
    handles, labels = axes.get_legend_handles_labels()
    style: dict[str, Any] = {"ncols": columns, "fontsize": 11, "frameon": False}
    figure.legend(handles, labels, loc="outside lower center", **style)
