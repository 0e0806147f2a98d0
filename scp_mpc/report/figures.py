"""Counterparts of the report's figures 1 to 14: which quantity of which scenario.

Yellow spans mark the steps at which the obstacle's constraint is active along the plan.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from matplotlib.ticker import FuncFormatter

from scp_mpc.arrays import FloatArray
from scp_mpc.report.canvas import (
    ACTIVE,
    HALF_PLANE,
    LIMIT,
    OBSTACLE,
    PLAN,
    REFERENCE,
    ROBOT,
    as_map,
    legend_below,
    new_figure,
    save,
    show_square,
    tidy,
)
from scp_mpc.report.encounters import centre_distances, find_encounters, scenario_of, spans_of
from scp_mpc.report.outline import no_go_outline
from scp_mpc.simulation.run import Run

_LEAST_SPAN = 0.05  # [standard deviations] around s_ref; s itself is known to about 0.01
_MOST_ENCOUNTERS = 8  # more of them hide each other
_LABEL = np.array([2.8, 1.0])  # [m] room for a label
_HALO = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1.0}
_BEFORE_AND_AFTER = (-1.6, -0.8, 0.0, 0.8)  # [s] from the smallest distance


def trajectory_figure(run: Run) -> Figure:
    """Draw the whole run and, beside it, the closest encounter moment by moment.

    Every no-go set is that of its own step, sized by the s of that step's plan.
    """
    figure, scenario = new_figure(11.0, 6.4), scenario_of(run)
    name = f"{scenario.name}: {scenario.title.lower()}, N = {run.problem.horizon}"
    figure.suptitle(name, fontsize=13)
    whole, close = figure.subplots(1, 2)
    _draw_whole(whole, run)
    _draw_closest(close, run)
    legend_below(figure, [whole], columns=4)
    return figure


def size_figure(run: Run) -> Figure:
    """Draw s between its bounds, and the slack where keeping to them was not possible."""
    times, margin = run.times[:-1], run.problem.size
    figure, (size, violation) = _panels(run, "size s of the no-go set, and slack", 2)
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


def input_figure(run: Run) -> Figure:
    """Draw the applied inputs between their bounds."""
    figure, panels = _panels(run, "applied inputs", 2)
    bounds = np.array([run.problem.u_min, run.problem.u_max]).T
    for axes, name, pair, u in zip(panels, "xy", bounds, run.inputs.T, strict=True):
        for bound in pair:
            axes.axhline(bound, color=LIMIT, linestyle="--", linewidth=1, label="bounds")
        axes.step(run.times[:-1], u, where="post", color=ROBOT, linewidth=1, label="input")
        axes.set_ylabel(rf"$a_{name}$ [m/s²]")
    legend_below(figure, panels[:1], columns=3)
    return figure


def velocity_figure(run: Run) -> Figure:
    """Draw the true velocities with the reference's."""
    figure, panels = _panels(run, "velocities", 2)
    asked = np.array(run.references)[:, 0]
    for axes, name, row in zip(panels, "xy", (1, 3), strict=True):
        v_ref, v = asked[:, row], run.states[:, row]
        axes.plot(run.times[:-1], v_ref, color=REFERENCE, linewidth=3, label="reference")
        axes.plot(run.times, v, color=ROBOT, linewidth=1, label="robot")
        axes.set_ylabel(rf"$v_{name}$ [m/s]")
    legend_below(figure, panels[:1], columns=3)
    return figure


def duration_figure(run: Run) -> Figure:
    """Draw the wall time of each control step on a logarithmic axis with the sampling time."""
    figure, (axes,) = _panels(run, "time for each control step", 1)
    times, limit = 1e3 * run.seconds, 1e3 * run.problem.model.dt
    median, tail = np.quantile(times, [0.5, 0.99])
    axes.axhline(limit, color=OBSTACLE, linewidth=2, label=f"sampling time {limit:.0f} ms")
    axes.axhline(tail, color=HALF_PLANE, linestyle="--", label=f"99 % below {tail:.1f} ms")
    axes.axhline(median, color=PLAN, linestyle="--", label=f"median {median:.1f} ms")
    axes.plot(run.times[:-1], times, ".", color=ROBOT, ms=4, clip_on=False, label="one step")
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_ylabel("wall time [ms]")
    legend_below(figure, [axes], columns=3)
    return figure


class ReportFigure(NamedTuple):
    """One figure: its number there, what it shows, the scenario's name, and what draws it."""

    number: int
    subject: str
    scenario: str
    draw: Callable[[Run], Figure]

    @property
    def file_name(self) -> str:
        """Name of the file, without directory."""
        return f"fig{self.number:02d}_{self.subject}_{self.scenario}.png"


FIGURES = (
    ReportFigure(1, "trajectory", "scenario-1", trajectory_figure),
    ReportFigure(2, "s", "scenario-1", size_figure),
    ReportFigure(3, "inputs", "scenario-1", input_figure),
    ReportFigure(4, "velocities", "scenario-1", velocity_figure),
    ReportFigure(5, "time", "scenario-1", duration_figure),
    ReportFigure(6, "time", "scenario-2", duration_figure),
    ReportFigure(7, "velocities", "scenario-2", velocity_figure),
    ReportFigure(8, "trajectory", "scenario-2", trajectory_figure),
    ReportFigure(9, "inputs", "scenario-2", input_figure),
    ReportFigure(10, "trajectory", "scenario-3", trajectory_figure),
    ReportFigure(11, "trajectory", "scenario-4", trajectory_figure),
    ReportFigure(12, "inputs", "scenario-4", input_figure),
    ReportFigure(13, "s", "scenario-4", size_figure),
    ReportFigure(14, "velocities", "scenario-4", velocity_figure),
)


def write_figures(runs: Sequence[Run], directory: Path) -> list[Path]:
    """Write the figures of those scenarios that were run and return their files."""
    by_name = {scenario_of(run).name: run for run in runs}
    return [
        save(figure.draw(by_name[figure.scenario]), directory / figure.file_name)
        for figure in FIGURES
        if figure.scenario in by_name
    ]


def _draw_whole(axes: Axes, run: Run) -> None:
    _draw_ways(axes, run, slice(None))
    reach = float(np.abs([run.positions, run.bodies[:, 0]]).max()) + 0.8
    for index, k in enumerate(find_encounters(run)[:_MOST_ENCOUNTERS]):
        outline = _draw_moment(axes, run, k, 0.0, None if index else "no-go set")
        outwards = _unit(run.bodies[k, 0])
        label = ((outline @ outwards).max() + 0.7) * outwards
        ha, va = _anchor(outwards[0], "left", "right"), _anchor(outwards[1], "bottom", "top")
        axes.text(label[0], label[1], f"{run.times[k]:.1f} s", ha=ha, va=va, bbox=_HALO)
        reach = max(reach, float((np.abs(label) + _LABEL).max()))
    show_square(axes, np.zeros(2), reach)
    axes.set_title(f"{run.times[-1]:g} s; no-go sets where the robot is closest", fontsize=11)


def _draw_closest(axes: Axes, run: Run) -> None:
    distances = centre_distances(run)
    closest = min(find_encounters(run), key=distances.__getitem__)
    steps = [closest + round(offset / run.problem.model.dt) for offset in _BEFORE_AND_AFTER]
    steps = [k for k in steps if 0 <= k < run.steps]
    _draw_ways(axes, run, slice(max(steps[0] - 5, 0), min(steps[-1] + 5, run.steps) + 1))
    corners = []
    for index, k in enumerate(steps):
        robot, obstacle = run.positions[k], run.bodies[k, 0]
        corners += [_draw_moment(axes, run, k, (len(steps) - 1 - index) * 0.22), robot[None]]
        radially = np.sign(np.linalg.norm(robot) - np.linalg.norm(obstacle)) or 1.0
        text, away = f"{run.times[k]:.1f} s", tuple(radially * _unit(robot) * (30, 18))
        axes.annotate(
            text, robot, away, textcoords="offset points", ha="center", va="center", bbox=_HALO
        )
    points = np.concatenate(corners)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    show_square(axes, middle, np.ptp(points, axis=0).max() / 2 + 0.7)
    text = f"closest encounter, at {distances[closest]:.2f} m; earlier is paler"
    axes.set_title(text, fontsize=11)


def _draw_ways(axes: Axes, run: Run, window: slice) -> None:
    """The reference lies under the obstacle's track, which is the same circle in the report."""
    as_map(axes)
    circle = np.array(run.references)[window, 0, run.problem.model.position]
    track, path = run.bodies[window, 0], run.positions[window]
    axes.plot(*circle.T, color=REFERENCE, linewidth=5, alpha=0.6, label="reference")
    axes.plot(*track.T, ":", color=OBSTACLE, linewidth=2, label="obstacle's track")
    axes.plot(*path.T, color=ROBOT, linewidth=1.2, label="robot's path")


def _draw_moment(
    axes: Axes, run: Run, k: int, paleness: float, label: str | None = None
) -> FloatArray:
    """Draw the robot, the obstacle and its no-go set of step k; return the set's outline."""
    outline = no_go_outline(run.problem, run.predictions[k][0], 0, float(run.plans[k].s[0]))
    ink, blue = (tuple(paleness + (1 - paleness) * np.array(to_rgb(c))) for c in (OBSTACLE, ROBOT))
    face = (*ink, 0.12)
    axes.add_patch(Polygon(outline, facecolor=face, edgecolor=ink, linewidth=1.2, label=label))
    obstacle, robot = run.scene.bodies[0].radius, run.problem.robot_radius
    axes.add_patch(Circle(tuple(run.bodies[k, 0]), obstacle, color=ink, zorder=3))
    axes.add_patch(Circle(tuple(run.positions[k]), robot, color=blue, zorder=4))
    return outline


def _unit(vector: FloatArray) -> FloatArray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def _anchor(component: float, ahead: str, behind: str) -> str:
    """Where a text is held so that it extends outwards."""
    return ahead if component > 0.38 else behind if component < -0.38 else "center"


def _panels(run: Run, subject: str, number: int) -> tuple[Figure, list[Axes]]:
    """Panels, one above the other, over the same time."""
    figure = new_figure(8.0, 3.2 + number)
    figure.suptitle(f"{scenario_of(run).name}, N = {run.problem.horizon}: {subject}")
    panels = list(figure.subplots(number, sharex=True, squeeze=False)[:, 0])
    panels[-1].set_xlabel("time [s]")
    panels[0].set_xlim(0.0, run.times[-1])
    active = np.array([plan.iterate.touched.any() for plan in run.plans])
    label = "obstacle's constraint active"
    for axes in panels:
        tidy(axes)
        for k in spans_of(active):
            span = run.times[k[0]], run.times[k[-1] + 1]
            axes.axvspan(*span, color=ACTIVE, alpha=0.35, lw=0, label=label)
    return figure, panels


def _widen(axes: Axes, low: float, high: float) -> None:
    """Widen the vertical limits to `low` and `high`, so that rounding does not fill them."""
    bottom, top = axes.get_ylim()
    axes.set_ylim(min(low, bottom), max(high, top))
    axes.ticklabel_format(axis="y", useOffset=False)
