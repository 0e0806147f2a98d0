"""Figures and animations of drives: map and bounds side by side."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from scp_mpc.arrays import FloatArray
from scp_mpc.report.animation import OnePaletteWriter
from scp_mpc.report.canvas import OBSTACLE, PLAN, ROBOT, new_figure, tidy
from scp_mpc.report.drive_scene import PlanarScene, limit_lines
from scp_mpc.simulation.drive import Drive
from scp_mpc.simulation.overtaking import CAR, LANE

_DPI = 80
_SHADOW = "0.75"
Show = Callable[[int], object]


class Trace(NamedTuple):
    """One quantity over time: name with unit, values (K+1,) or (K,), lower and upper bound."""

    label: str
    values: FloatArray
    bounds: tuple[float, ...]


def trace_axes(axes: Axes, run: Drive, trace: Trace) -> Any:
    """Draw a trace with its bounds; return the marker of the present."""
    tidy(axes)
    values = trace.values
    if len(values) < len(run.times):
        values = np.append(values, values[-1])
    axes.plot(run.times, values, color=ROBOT, linewidth=1.6, drawstyle="default")
    limit_lines(axes, *trace.bounds)
    axes.set_title(trace.label, loc="left", fontsize=9.5, pad=3)
    axes.margins(y=0.12)
    (marker,) = axes.plot([], [], "o", color=PLAN, markersize=7)
    return marker, values


def with_traces(figure: Figure, run: Drive, traces: Sequence[Trace], cells: Sequence[Any]) -> Show:
    """Draw traces below each other; return what moves their markers."""
    marked = []
    for cell, trace in zip(cells, traces, strict=True):
        axes = figure.add_subplot(cell)
        marked.append(trace_axes(axes, run, trace))
        if trace is traces[-1]:
            axes.set_xlabel("time [s]")
        else:
            axes.tick_params(labelbottom=False)

    def show(k: int) -> None:
        for marker, values in marked:
            marker.set_data([run.times[k]], [values[k]])

    return show


def road_view(axes: Axes, run: Drive) -> Show:
    """A road from above, that moves with the car."""
    axes.set_facecolor("0.93")
    for edge in (-1.5 * LANE, 0.5 * LANE):
        axes.axvline(edge, color="0.2", linewidth=2)
    axes.axvline(-0.5 * LANE, color="0.45", linewidth=1.2, dashes=(8, 8))
    long, wide = CAR
    outline = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [long / 2, wide / 2]
    scene = PlanarScene(axes, run, outline=outline)
    axes.set_aspect("equal")
    axes.set_xlim(-1.5 * LANE - 0.8, 0.5 * LANE + 0.8)
    axes.set(xlabel="x [m]", ylabel="y [m]")

    def show(k: int) -> None:
        scene.show(k)
        y = run.positions[k, 1]
        axes.set_ylim(y - 14, y + 34)

    return show


def space_view(axes: Any, run: Drive) -> Show:
    """Balls and robot in space; on the floor shadows and where balls may be at the horizon."""
    turn, cap = np.meshgrid(np.linspace(0, 2 * np.pi, 15), np.linspace(0, np.pi, 9))
    ball = np.stack([np.sin(cap) * np.cos(turn), np.sin(cap) * np.sin(turn), np.cos(cap)])
    angle = np.linspace(0, 2 * np.pi, 30)
    drawn: list[Any] = []
    axes.set_box_aspect((11, 9, 4.2), zoom=1.15)
    axes.set(xlim=(-5.5, 5.5), ylim=(-4.5, 4.5), zlim=(0, 4.2))
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    axes.set(xticks=[-4, 0, 4], yticks=[-4, 0, 4], zticks=[0, 2, 4])

    def show(k: int) -> None:
        while drawn:
            drawn.pop().remove()
        bodies = [(b.means[k], b.radius, OBSTACLE) for b in run.bodies]
        bodies.append((run.positions[k], run.problem.robot_radius, ROBOT))
        for p, r, color in bodies:
            drawn.append(axes.plot_surface(*(p[:, None, None] + r * ball), color=color))
            x, y = p[0] + r * np.cos(angle), p[1] + r * np.sin(angle)
            drawn.append(axes.plot(x, y, 0 * x, color=_SHADOW, linewidth=1.2)[0])
            drawn.append(axes.plot([p[0]] * 2, [p[1]] * 2, [0, p[2] - r], ":", color=_SHADOW)[0])
        last = min(k, len(run.plans) - 1)
        for told in run.predictions[last]:
            (x, y), size = told.means[-1, :2], run.problem.size_for(run.problem.max_obstacles, 1)
            wide = told.radius + size * told.largest_std[-1]
            ring = x + wide * np.cos(angle), y + wide * np.sin(angle), 0 * angle
            drawn.append(axes.plot(*ring, color=OBSTACLE, alpha=0.35, linewidth=1.0)[0])
        way = run.positions[: k + 1]
        drawn.append(axes.plot(*way.T, color=ROBOT, linewidth=1.8)[0])
        drawn.append(axes.plot(*way[:, :2].T, 0 * way[:, 0], color=_SHADOW, linewidth=1.2)[0])
        plan = run.plans[last].X[:, run.problem.model.position]
        drawn.append(axes.plot(*plan.T, ".-", color=PLAN, markersize=4)[0])
        axes.view_init(elev=28, azim=-65 + 0.5 * k)

    return show


def room_view(axes: Axes, run: Drive, walls: int, room: Sequence[tuple[float, float]]) -> Show:
    """A room from above."""
    tidy(axes)
    scene = PlanarScene(axes, run, walls=walls)
    axes.set_aspect("equal")
    axes.set(xlim=room[0], ylim=room[1], xlabel="x [m]", ylabel="y [m]")
    return scene.show


def instants_figure(
    run: Drive,
    view: Callable[[Any, Drive], Show],
    instants: Sequence[int],
    traces: Sequence[Trace],
    size: tuple[float, float] = (13.0, 7.0),
    projection: str | None = None,
    share: float = 1.0,
) -> Figure:
    """A few instants side by side, and traces with their bounds below."""
    figure = new_figure(*size)
    grid = figure.add_gridspec(
        1 + len(traces), len(instants), height_ratios=[2.6 * share] + [0.8] * len(traces)
    )
    for column, k in enumerate(instants):
        axes = figure.add_subplot(grid[0, column], projection=projection)
        view(axes, run)(k)
        axes.set_title(f"{run.times[k]:.1f} s")
    with_traces(figure, run, traces, [grid[1 + row, :] for row in range(len(traces))])
    return figure


def write_drive_animation(
    run: Drive,
    view: Callable[[Any, Drive], Show],
    traces: Sequence[Trace],
    path: Path,
    *,
    beside: bool,
    projection: str | None = None,
    frames_per_second: int = 10,
    every: int = 1,
) -> Path:
    """Write a drive as a GIF: the view, and traces beside or below it with the present marked."""
    figure = Figure(figsize=(6.0, 6.0), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    n = len(traces)
    if beside:
        grid = figure.add_gridspec(n, 2, width_ratios=[1, 1.5])
        axes = figure.add_subplot(grid[:, 0])
        cells = [grid[row, 1] for row in range(n)]
    else:
        grid = figure.add_gridspec(1 + n, 1, height_ratios=[3.4] + [0.9] * n)
        axes = figure.add_subplot(grid[0, 0], projection=projection)
        cells = [grid[1 + row, 0] for row in range(n)]
    show = view(axes, run)
    mark = with_traces(figure, run, traces, cells)
    writer = OnePaletteWriter(fps=frames_per_second)
    with writer.saving(figure, str(path), _DPI):
        for k in range(0, len(run.plans), every):
            show(k)
            mark(k)
            axes.set_title(f"{run.times[k]:4.1f} s", fontsize=11)
            if k == 0:
                figure.canvas.draw()
                figure.set_layout_engine("none")  # nothing moves but the scene
            writer.grab_frame()
    return path
