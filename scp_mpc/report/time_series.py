"""Quantities over time: size s, inputs, velocities and the time for each control step.

Yellow spans mark the steps at which the obstacle's constraint is active along the plan.
"""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from scp_mpc.report.canvas import (
    ACTIVE,
    HALF_PLANE,
    LIMIT,
    OBSTACLE,
    PLAN,
    REFERENCE,
    ROBOT,
    legend_below,
    new_figure,
    tidy,
)
from scp_mpc.report.encounters import active_steps, spans_of
from scp_mpc.simulation.closed_loop import ClosedLoop
from scp_mpc.simulation.scenarios import DT

_COORDINATES = "xy"
_LEAST_SPAN = 0.05  # [standard deviations] around s_ref; s itself is known to about 0.01


def size_figure(run: ClosedLoop) -> Figure:
    """Draw s between its bounds, and the slack where keeping to them was not possible."""
    times, margin = run.times[:-1], run.problem.size
    figure, (size, violation) = _panels(run, "size s of the no-go set, and slack")
    s = [float(plan.s[0]) for plan in run.plans]
    size.axhline(margin.reference, color=REFERENCE, linewidth=5, label=r"$s_\mathrm{ref}$")
    size.step(times, s, where="post", color=ROBOT, linewidth=2, label="s")
    size.axhline(margin.lower, color=LIMIT, linestyle="--", linewidth=1, label=r"$s_\mathrm{min}$")
    _widen(size, margin.reference - _LEAST_SPAN, margin.reference + _LEAST_SPAN)
    size.set_ylabel("s [standard deviations]")
    slack = [1e3 * float(plan.slack.max(initial=0.0)) for plan in run.plans]
    violation.step(times, slack, where="post", color=OBSTACLE, label="largest slack of the plan")
    _widen(violation, -0.5, 10.0)
    violation.set_ylabel("slack [mm]")
    legend_below(figure, (size, violation), columns=5)
    return figure


def input_figure(run: ClosedLoop) -> Figure:
    """Draw the applied inputs between their bounds."""
    figure, panels = _panels(run, "applied inputs")
    problem, times = run.problem, run.times[:-1]
    for row, (axes, name) in enumerate(zip(panels, _COORDINATES, strict=True)):
        for bound, label in ((problem.u_min[row], "bounds"), (problem.u_max[row], None)):
            axes.axhline(bound, color=LIMIT, linestyle="--", linewidth=1, label=label)
        axes.step(times, run.inputs[:, row], where="post", color=ROBOT, linewidth=1, label="input")
        axes.set_ylabel(rf"$a_{name}$ [m/s²]")
    legend_below(figure, panels[:1], columns=3)
    return figure


def velocity_figure(run: ClosedLoop) -> Figure:
    """Draw the true velocities with the reference's."""
    figure, panels = _panels(run, "velocities")
    for row, (axes, name) in enumerate(zip(panels, _COORDINATES, strict=True)):
        column = 2 * row + 1
        axes.plot(
            run.times, run.reference[:, column], color=REFERENCE, linewidth=3, label="reference"
        )
        axes.plot(run.times, run.states[:, column], color=ROBOT, linewidth=1, label="robot")
        axes.set_ylabel(rf"$v_{name}$ [m/s]")
    legend_below(figure, panels[:1], columns=3)
    return figure


def duration_figure(run: ClosedLoop) -> Figure:
    """Draw the wall time of each control step on a logarithmic axis with the sampling time."""
    figure = new_figure(8.0, 4.2)
    axes = figure.add_subplot()
    _begin(axes, run)
    figure.suptitle(_title(run, "time for each control step"))
    milliseconds = 1e3 * run.seconds
    median, tail = np.quantile(milliseconds, [0.5, 0.99])
    axes.axhline(1e3 * DT, color=OBSTACLE, linewidth=2, label=f"sampling time {1e3 * DT:.0f} ms")
    axes.axhline(tail, color=HALF_PLANE, linestyle="--", label=f"99 % below {tail:.1f} ms")
    axes.axhline(median, color=PLAN, linestyle="--", label=f"median {median:.1f} ms")
    axes.plot(
        run.times[:-1],
        milliseconds,
        ".",
        color=ROBOT,
        markersize=4,
        clip_on=False,
        label="one step",
    )
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_ylabel("wall time [ms]")
    axes.set_xlabel("time [s]")
    legend_below(figure, [axes], columns=3)
    return figure


def _panels(run: ClosedLoop, subject: str) -> tuple[Figure, Sequence[Axes]]:
    """Two panels, one above the other, over the same time."""
    figure = new_figure(8.0, 5.2)
    figure.suptitle(_title(run, subject))
    upper = figure.add_subplot(2, 1, 1)
    lower = figure.add_subplot(2, 1, 2, sharex=upper)
    upper.tick_params(labelbottom=False)
    lower.set_xlabel("time [s]")
    for axes in (upper, lower):
        _begin(axes, run)
    return figure, (upper, lower)


def _begin(axes: Axes, run: ClosedLoop) -> None:
    tidy(axes)
    axes.set_xlim(0.0, run.times[-1])
    label: str | None = "obstacle's constraint active"
    for first, last in spans_of(active_steps(run)):
        axes.axvspan(
            run.times[first], run.times[last + 1], color=ACTIVE, alpha=0.35, lw=0, label=label
        )
        label = None


def _widen(axes: Axes, low: float, high: float) -> None:
    """Widen the vertical limits to `low` and `high`, so that rounding does not fill them."""
    bottom, top = axes.get_ylim()
    axes.set_ylim(min(low, bottom), max(high, top))
    axes.ticklabel_format(axis="y", useOffset=False)


def _title(run: ClosedLoop, subject: str) -> str:
    return f"{run.scenario.name}, N = {run.problem.horizon}: {subject}"
