"""The SCP iterations of one control step: where the plans went, and how the numbers fell."""

from itertools import count

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator

from scp_mpc.arrays import FloatArray
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.geometry.no_go import NoGoSets
from scp_mpc.report.canvas import (
    HALF_PLANE,
    LIMIT,
    OBSTACLE,
    REFERENCE,
    ROBOT,
    as_map,
    legend_below,
    new_figure,
    tidy,
)
from scp_mpc.report.outline import outline
from scp_mpc.scp.history import Record
from scp_mpc.scp.plan import Plan
from scp_mpc.settings import Settings

_OUTLINES = 4  # of one obstacle at most
_EDGE, _DEPTH = 0.08, 0.025  # of the plan's extent: half a half-plane's edge, and its shading
_SPAN = 20.0  # between the largest and the smallest cost, from which their axis is logarithmic
_VISIBLE = 1e-3  # [m] at which the violation's axis ends at least


def history_figure(plan: Plan, tolerance: float = Settings.tolerance) -> Figure:
    """Draw the iterations that led to a plan: in the plane, and number by number.

    Args:
        plan: Of a planar robot, made with `Settings(history=True)`.
        tolerance: KKT residual at which it was certified.

    Raises:
        InvalidArgumentError: The plan keeps no iterations, or is not planar.
    """
    if not plan.history:
        raise InvalidArgumentError(
            "plan", "no iterations are kept: Settings(history=True), and an obstacle in the way"
        )
    if plan.step.problem.model.dim != 2:
        raise InvalidArgumentError("plan", f"{plan.step.problem.model.dim} dimensions are not two")
    figure = new_figure(13.0, 7.0)
    figure.suptitle(
        f"{len(plan.history)} SCP iterations, N = {plan.step.problem.horizon}: "
        f"{plan.status.name.lower()}, cost {plan.cost:.3g}, KKT residual {plan.kkt.worst:.0e}"
    )
    grid = figure.add_gridspec(5, 2, width_ratios=(1.5, 1.0))
    plane = figure.add_subplot(grid[:, 0])
    first = figure.add_subplot(grid[0, 1])
    rest = [figure.add_subplot(grid[row, 1], sharex=first) for row in range(1, 5)]
    colors = _colors(len(plan.history))
    _draw_plane(plane, plan, colors)
    _draw_numbers([first, *rest], plan.history, colors, tolerance)
    legend_below(figure, (plane, first, *rest), columns=4)
    return figure


def _colors(number: int) -> FloatArray:
    """Light to dark, also without colour vision."""
    return np.asarray(colormaps["cividis"](np.linspace(0.85, 0.0, number)))


def _draw_plane(axes: Axes, plan: Plan, colors: FloatArray) -> None:
    as_map(axes)
    step, history = plan.step, plan.history
    axes.plot(
        *step.x_ref[:, step.problem.model.position].T, "+", color=REFERENCE, label="reference"
    )
    for k, record, color in zip(count(1), history, colors, strict=False):
        last = k == len(history)
        axes.plot(
            *_centres(plan, record).T,
            linestyle="-" if record.accepted else ":",
            color=color,
            marker="." if last else None,
            linewidth=2.0 if last else 1.4,
            zorder=3,
            label=f"plan of iteration {k}" if last or k == 1 else None,
        )
    for index, centre in enumerate(step.nodes.now(step.x0)):
        label = None if index else "robot now"
        disc = Circle(
            tuple(centre), step.problem.robot_radius, color=ROBOT, alpha=0.6, zorder=4, label=label
        )
        axes.add_patch(disc)
    _draw_obstacles(axes, plan)
    _draw_half_planes(axes, history)
    axes.set_title("In the plane", fontsize=11)


def _centres(plan: Plan, record: Record) -> FloatArray:
    """The plan's way: of a longer robot, the middle of its discs."""
    d, here = plan.step.problem.model.dim, plan.step.nodes.now(plan.step.x0)
    nodes = record.positions[1:].reshape(-1, plan.step.nodes.discs, d)
    return np.concatenate([here[None], nodes]).mean(axis=1)


def _draw_obstacles(axes: Axes, plan: Plan) -> None:
    """The no-go sets where they push the plan, or along the horizon if they do not."""
    step, iterate = plan.step, plan.iterate
    for j, obstacle in enumerate(step.obstacles):
        nodes = np.flatnonzero(iterate.touched[j])
        if not len(nodes):
            nodes = np.arange(step.nodes.size)
        shown = np.linspace(0, len(nodes) - 1, min(_OUTLINES, len(nodes)))
        nodes = nodes[shown.round().astype(np.intp)]
        sets = NoGoSets.pairs(
            step.means[j, nodes + 1], step.covariances[j, nodes + 1], step.radii[j, nodes]
        )
        inflation, s = step.problem.inflation, float(iterate.s[j])
        edges = [outline(sets, (k, 0), s, inflation, obstacle.shape) for k in range(len(nodes))]
        body = PolyCollection(
            edges,
            facecolor=(*to_rgb(OBSTACLE), 0.08),
            edgecolor=OBSTACLE,
            label=None if j else "no-go set where it pushes",
        )
        axes.add_collection(body)
        axes.plot(
            *step.means[j].T,
            "--",
            color=OBSTACLE,
            marker="o",
            markevery=[0],
            linewidth=1.0,
            markersize=4,
            label=None if j else "obstacle, now and expected",
        )
    axes.autoscale_view()


def _draw_half_planes(axes: Axes, history: tuple[Record, ...]) -> None:
    """Those that hold the solution of the last accepted iteration back, shaded where forbidden."""
    last = next((r for r in reversed(history) if r.accepted), history[-1])
    if not len(last.normals):
        return
    extent = float(np.ptp(last.positions, axis=0).max())
    length = np.linalg.norm(last.normals, axis=1, keepdims=True)
    n = last.normals / length
    feet = last.points - last.values[:, None] / length * n
    along = _EDGE * extent * np.stack([-n[:, 1], n[:, 0]], axis=1)
    edges = np.stack([feet - along, feet + along], axis=1)
    strips = np.concatenate([edges, edges[:, ::-1] - _DEPTH * extent * n[:, None]], axis=1)
    axes.add_collection(PolyCollection(list(strips), facecolor=HALF_PLANE, alpha=0.3))
    for index, edge in enumerate(edges):
        label = None if index else "active half-plane of the last iteration"
        axes.plot(*edge.T, color=HALF_PLANE, linewidth=1.8, zorder=4, label=label)


def _draw_numbers(
    panels: list[Axes], history: tuple[Record, ...], colors: FloatArray, tolerance: float
) -> None:
    k = np.arange(1, len(history) + 1)
    accepted = np.array([record.accepted for record in history])
    cost, violation, residual, change, admm = np.array(
        [[r.cost, r.violation, r.residual, r.step, r.iterations] for r in history]
    ).T
    costs, violations, residuals, changes, bars = panels
    for axes, values in zip(panels[:4], (cost, violation, residual, change), strict=True):
        axes.plot(k, values, color=REFERENCE, linewidth=1.0, zorder=1)
        axes.scatter(k[accepted], values[accepted], c=colors[accepted], zorder=3, clip_on=False)
        axes.scatter(
            k[~accepted],
            values[~accepted],
            facecolors="white",
            edgecolors=colors[~accepted],
            zorder=3,
            clip_on=False,
            label=None if accepted.all() else "rejected (plan dotted)",
        )
    costs.set_title("Number by number", fontsize=11)
    costs.set_ylabel("cost")
    if cost.min() > 0 and cost.max() > _SPAN * cost.min():
        costs.set_yscale("log")
    else:
        costs.ticklabel_format(useOffset=False)
    violations.set_ylabel("violation\n[m]")
    violations.set_ylim(0.0, 1.15 * max(float(violation.max()), _VISIBLE))
    residuals.set_ylabel("KKT\nresidual")
    residuals.set_yscale("log")
    residuals.axhline(tolerance, color=LIMIT, linestyle="--", linewidth=1.0, label="tolerance")
    changes.set_ylabel("change of\ninputs")
    changes.set_yscale("log")
    bars.bar(k, admm, color=colors, width=0.6)
    bars.set_ylabel("ADMM\niterations")
    bars.set_xlabel("SCP iteration")
    bars.xaxis.set_major_locator(MaxNLocator(integer=True))
    bars.set_xlim(0.4, len(history) + 0.6)
    for axes in (costs, residuals, changes):
        axes.margins(y=0.15)
    for axes in panels:
        tidy(axes)
        axes.tick_params(labelbottom=axes is bars)
    panels[0].figure.align_ylabels(panels)
