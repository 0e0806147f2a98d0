"""Pictures of runs: the plane at an instant, quantities over time with their bounds, and GIFs.

Robot blue, plan green, reference and what stands still grey; bodies orange, and so are the no-go
sets a third, two thirds and the whole of the horizon ahead. Dashed lines are bounds.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from scp_mpc.arrays import FloatArray
from scp_mpc.report.animation import OnePaletteWriter
from scp_mpc.report.canvas import LIMIT, OBSTACLE, PLAN, REFERENCE, ROBOT, new_figure, tidy
from scp_mpc.report.outline import no_go_outline
from scp_mpc.simulation import Run
from scp_mpc.simulation.run import disc_centres

Draw = Callable[[Any, Run, int], object]  # axes, run, control step
Trace = tuple[str, FloatArray, tuple[float, ...]]  # label, one value per control step, bounds


def draw_plane(axes: Axes, run: Run, k: int, outline: FloatArray | None = None) -> None:
    """Draw a planar robot, its plan and what is in its way at control step k.

    Args:
        axes: Where to draw.
        run: What to draw.
        k: Control step, less than K.
        outline: (nv, 2) the robot's corners in its own frame [m]; its discs if None.
    """
    problem, model, x = run.problem, run.problem.model, run.states[k]
    for body, position in zip(run.scene.bodies, run.bodies[k], strict=True):
        colour = OBSTACLE if callable(body.position) else "0.55"
        if body.shape is None:
            axes.add_patch(Circle(position, body.radius, color=colour, zorder=4))
        else:
            axes.add_patch(Polygon(body.shape.vertices + position, color=colour, zorder=4))
    s = problem.size_for(problem.max_obstacles, 1)
    for told in run.predictions[k]:
        if told.covariances.any():
            for share, alpha in ((1 / 3, 0.5), (2 / 3, 0.3), (1, 0.16)):
                edge = no_go_outline(problem, told, round(share * problem.horizon), s)
                axes.plot(*edge.T, color=OBSTACLE, alpha=alpha, linewidth=1.2)
    axes.plot(*run.references[k][:, model.position].T, color=REFERENCE, linewidth=4, alpha=0.6)
    axes.plot(*run.positions[: k + 1].T, color=ROBOT, linewidth=1.8)
    axes.plot(*run.plans[k].X[:, model.position].T, ".-", color=PLAN, markersize=5, zorder=6)
    fill = ROBOT if outline is None else "none"
    for centre in disc_centres(model, x, problem.discs):
        disc = Circle(centre, problem.robot_radius, facecolor=fill, edgecolor=ROBOT, zorder=5)
        axes.add_patch(disc)
    if model.heading is not None:
        p, c, s = x[model.position], np.cos(x[model.heading]), np.sin(x[model.heading])
        if outline is None:
            nose = p + problem.robot_radius * np.array([c, s])
            axes.plot(*np.stack([p, nose], axis=1), color="white", linewidth=1.6, zorder=6)
        else:
            axes.add_patch(Polygon(p + outline @ [[c, s], [-s, c]], color=ROBOT, zorder=5))
    axes.set_aspect("equal")
    axes.set(xlabel="x [m]", ylabel="y [m]")


def draw_traces(cells: Sequence[Any], run: Run, traces: Sequence[Trace]) -> list[Axes]:
    """Draw quantities over time into cells of a grid, from the top down."""
    panels: list[Axes] = []
    for cell, (label, values, bounds) in zip(cells, traces, strict=True):
        axes = cell.get_gridspec().figure.add_subplot(cell, sharex=panels[0] if panels else None)
        tidy(axes)
        axes.plot(run.times[: len(values)], values, color=ROBOT, linewidth=1.6)
        for bound in bounds:
            axes.axhline(bound, color=LIMIT, linestyle="--", linewidth=0.9)
        axes.set_title(label, loc="left", fontsize=9.5, pad=3)
        axes.margins(y=0.12)
        axes.tick_params(labelbottom=cell is cells[-1])
        panels.append(axes)
    panels[-1].set_xlabel("time [s]")
    return panels


def draw_instants(
    run: Run,
    draw: Draw,
    steps: Sequence[int],
    traces: Sequence[Trace],
    size: tuple[float, float],
    share: float = 3.4,
    projection: str | None = None,
) -> Figure:
    """Return a figure of a few control steps side by side, and traces below.

    Args:
        run: What to draw.
        draw: Draws one control step.
        steps: Which of them.
        traces: Quantities over time.
        size: Of the figure [inch].
        share: Height of the steps, that of a trace being 0.8.
        projection: "3d" in space.
    """
    figure, n = new_figure(*size), len(traces)
    grid = figure.add_gridspec(1 + n, len(steps), height_ratios=[share] + [0.8] * n)
    for column, k in enumerate(steps):
        axes = figure.add_subplot(grid[0, column], projection=projection)
        draw(axes, run, k)
        axes.set_title(f"{run.times[k]:.1f} s")
    draw_traces([grid[1 + row, :] for row in range(n)], run, traces)
    return figure


def write_gif(
    run: Run,
    draw: Draw,
    traces: Sequence[Trace],
    path: Path,
    *,
    beside: bool = False,
    projection: str | None = None,
) -> Path:
    """Write a run as a GIF, one frame per control step, traces below the scene or beside it."""
    figure, n = new_figure(6.0, 6.0), len(traces)
    if beside:
        grid = figure.add_gridspec(n, 2, width_ratios=[1, 1.5])
        axes = figure.add_subplot(grid[:, 0])
        panels = draw_traces([grid[row, 1] for row in range(n)], run, traces)
    else:
        grid = figure.add_gridspec(1 + n, 1, height_ratios=[3.4] + [0.9] * n)
        axes = figure.add_subplot(grid[0, 0], projection=projection)
        panels = draw_traces([grid[1 + row, 0] for row in range(n)], run, traces)
    present = [panel.axvline(0.0, color=PLAN, linewidth=1.6) for panel in panels]
    writer = OnePaletteWriter(fps=round(1 / run.problem.model.dt))
    with writer.saving(figure, str(path), dpi=80):
        for k in range(run.steps):
            axes.clear()
            draw(axes, run, k)
            axes.set_title(f"{run.times[k]:4.1f} s", fontsize=11)
            for line in present:
                line.set_xdata([run.times[k], run.times[k]])
            if k == 0:
                figure.canvas.draw()
                figure.set_layout_engine("none")  # nothing moves but the scene
            writer.grab_frame()
    return path
