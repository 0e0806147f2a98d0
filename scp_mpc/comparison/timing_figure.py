"""The distribution of the time per control step, one panel per horizon."""

from collections.abc import Sequence

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from scp_mpc.comparison.attempts import Attempts
from scp_mpc.simulation.scenarios import DT

# Okabe and Ito's colours, told apart by any eye; line styles tell apart those that share one.
_STYLES = {
    "scp_mpc": ("#0072B2", "-"),
    "scp_mpc (multi-start)": ("#56B4E9", "-"),
    "scp_mpc, one start": ("#56B4E9", "-"),
    "scp_mpc (piqp)": ("#CC79A7", "-"),
    "ipopt": ("#D55E00", "-"),
    "fatrop": ("#E69F00", "-"),
    "sqp-qrqp": ("#009E73", "-"),
    "sqp-hpipm": ("#009E73", "--"),
    "sqp-osqp": ("#009E73", ":"),
    "slsqp": ("#000000", "-."),
}


def timing_figure(contests: Sequence[Sequence[Attempts]]) -> Figure:
    """Draw the share of steps solved within a time, one panel per contest."""
    figure = Figure(figsize=(max(5.2 * len(contests), 11), 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(contests), sharex=True, sharey=True, squeeze=False)[0]
    for axes, contest in zip(panels, contests, strict=True):
        for attempts in contest:
            if attempts.plans:
                colour, line = _STYLES[attempts.solver]
                axes.ecdf(
                    attempts.milliseconds,
                    label=attempts.solver,
                    color=colour,
                    linestyle=line,
                    linewidth=2.0,
                )
        axes.axvline(1e3 * DT, color="black", linewidth=1.2, linestyle=":")
        axes.annotate(
            f"the report's {1e3 * DT:g} ms",
            (1e3 * DT, 0.04),
            xytext=(-5, 0),
            textcoords="offset points",
            fontsize=11,
            rotation=90,
            ha="right",
            va="bottom",
        )
        axes.set_xscale("log")
        axes.set_ylim(-0.02, 1.02)
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.set_title(_title(contest[0]), fontsize=14)
        axes.set_xlabel("time per control step [ms]", fontsize=13)
        axes.tick_params(labelsize=12)
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("share of steps", fontsize=13)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, fontsize=11, frameon=False)
    return figure


def _title(attempts: Attempts) -> str:
    crowd = f", {attempts.obstacles} obstacles" if attempts.obstacles > 1 else ", 1 obstacle"
    return f"N = {attempts.horizon}{crowd}"
