"""The robot's way in the plane, with the no-go sets at the moments that matter."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from scp_mpc.arrays import FloatArray
from scp_mpc.report.canvas import (
    OBSTACLE,
    REFERENCE,
    ROBOT,
    as_map,
    legend_below,
    new_figure,
)
from scp_mpc.report.encounters import find_encounters
from scp_mpc.report.outline import no_go_outline
from scp_mpc.simulation.closed_loop import ClosedLoop
from scp_mpc.simulation.scenarios import DT

_MOST_ENCOUNTERS = 8  # more of them hide each other
_LABEL = np.array([2.8, 1.0])  # [m] room for a label
_HALO = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 1.0}
_BEFORE_AND_AFTER = (-1.6, -0.8, 0.0, 0.8)  # [s] from the smallest distance


def trajectory_figure(run: ClosedLoop) -> Figure:
    """Draw the whole run and, beside it, the closest encounter moment by moment.

    Every no-go set is that of its own step, sized by the s of that step's plan.
    """
    figure = new_figure(11.0, 6.4)
    name = f"{run.scenario.name}: {run.scenario.title.lower()}, N = {run.problem.horizon}"
    figure.suptitle(name, fontsize=13)
    whole, close = figure.add_subplot(1, 2, 1), figure.add_subplot(1, 2, 2)
    _draw_whole(whole, run)
    _draw_closest(close, run)
    legend_below(figure, [whole], columns=4)
    return figure


def _draw_whole(axes: Axes, run: ClosedLoop) -> None:
    as_map(axes)
    _draw_ways(axes, run, slice(None))
    reach = float(np.abs(np.concatenate([run.positions, run.obstacle])).max()) + 0.8
    for index, encounter in enumerate(find_encounters(run)[:_MOST_ENCOUNTERS]):
        k = encounter.closest
        outline = _draw_moment(axes, run, k, 0.0, labelled=index == 0)
        outwards = _unit(run.obstacle[k])
        label = ((outline @ outwards).max() + 0.7) * outwards
        axes.text(
            label[0],
            label[1],
            f"{run.times[k]:.1f} s",
            ha=_anchor(outwards[0], "left", "right"),
            va=_anchor(outwards[1], "bottom", "top"),
            bbox=_HALO,
        )
        reach = max(reach, float((np.abs(label) + _LABEL).max()))
    axes.set_xlim(-reach, reach)
    axes.set_ylim(-reach, reach)
    axes.set_title(f"{run.times[-1]:g} s; no-go sets where the robot is closest", fontsize=11)


def _draw_closest(axes: Axes, run: ClosedLoop) -> None:
    as_map(axes)
    closest = min(find_encounters(run), key=lambda o: run.distances[o.closest]).closest
    steps = [closest + round(offset / DT) for offset in _BEFORE_AND_AFTER]
    steps = [k for k in steps if 0 <= k < run.steps]
    window = slice(max(steps[0] - 5, 0), min(steps[-1] + 5, run.steps) + 1)
    _draw_ways(axes, run, window)
    corners = []
    for index, k in enumerate(steps):
        robot, obstacle = run.positions[k], run.obstacle[k]
        corners += [_draw_moment(axes, run, k, (len(steps) - 1 - index) * 0.22), robot[None]]
        radially = np.sign(np.linalg.norm(robot) - np.linalg.norm(obstacle)) or 1.0
        axes.annotate(
            f"{run.times[k]:.1f} s",
            robot,
            xytext=tuple(radially * _unit(robot) * (30, 18)),
            textcoords="offset points",
            ha="center",
            va="center",
            bbox=_HALO,
        )
    points = np.concatenate(corners)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    reach = np.ptp(points, axis=0).max() / 2 + 0.7
    axes.set_xlim(middle[0] - reach, middle[0] + reach)
    axes.set_ylim(middle[1] - reach, middle[1] + reach)
    axes.set_title(
        f"closest encounter, at {run.distances[closest]:.2f} m; earlier is paler", fontsize=11
    )


def _draw_ways(axes: Axes, run: ClosedLoop, window: slice) -> None:
    """The reference lies under the obstacle's track, which is the same circle in the report."""
    reference = run.reference[window][:, run.problem.model.position]
    axes.plot(*reference.T, color=REFERENCE, linewidth=5, alpha=0.6, label="reference")
    axes.plot(*run.obstacle[window].T, ":", color=OBSTACLE, linewidth=2, label="obstacle's track")
    axes.plot(*run.positions[window].T, color=ROBOT, linewidth=1.2, label="robot's path")


def _draw_moment(
    axes: Axes, run: ClosedLoop, k: int, paleness: float, labelled: bool = False
) -> FloatArray:
    """Draw the robot, the obstacle and its no-go set of step k; return the set's outline."""
    outline = no_go_outline(run.problem, run.predictions[k], 0, float(run.plans[k].s[0]))
    ink, blue = _pale(OBSTACLE, paleness), _pale(ROBOT, paleness)
    axes.add_patch(
        Polygon(
            outline,
            facecolor=(*to_rgb(ink), 0.12),
            edgecolor=ink,
            linewidth=1.2,
            label="no-go set" if labelled else None,
        )
    )
    obstacle, robot = run.scenario.obstacle.radius, run.problem.robot_radius
    axes.add_patch(Circle(tuple(run.obstacle[k]), obstacle, color=ink, zorder=3))
    axes.add_patch(Circle(tuple(run.positions[k]), robot, color=blue, zorder=4))
    return outline


def _unit(vector: FloatArray) -> FloatArray:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def _anchor(component: float, ahead: str, behind: str) -> str:
    """Where a text is held so that it extends outwards."""
    return ahead if component > 0.38 else behind if component < -0.38 else "center"


def _pale(color: str, share: float) -> tuple[float, float, float]:
    """Mix a colour with white."""
    r, g, b = (share + (1 - share) * part for part in to_rgb(color))
    return r, g, b
