"""The SCP iterations of one control step: where the plans went, and how the numbers fell."""

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
from scp_mpc.report.outline import half_plane_strips, outline
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
    mosaic = figure.subplot_mosaic("P1;P2;P3;P4;P5", width_ratios=(1.5, 1.0))
    plane, *panels = mosaic.values()
    # Light to dark, also without colour vision.
    colors = np.asarray(colormaps["cividis"](np.linspace(0.85, 0.0, len(plan.history))))
    _draw_plane(plane, plan, colors)
    _draw_numbers(panels, plan.history, colors, tolerance)
    legend_below(figure, (plane, *panels), columns=4)
    return figure


def _draw_plane(axes: Axes, plan: Plan, colors: FloatArray) -> None:
    as_map(axes)
    step, history, d = plan.step, plan.history, plan.step.problem.model.dim
    asked = step.x_ref[:, step.problem.model.position]
    axes.plot(*asked.T, "+", color=REFERENCE, label="reference")
    here = step.nodes.now(step.x0)
    for k, (record, color) in enumerate(zip(history, colors, strict=True), 1):
        last = k == len(history)
        # Of a longer robot, the middle of its discs.
        nodes = record.positions[1:].reshape(-1, step.nodes.discs, d)
        axes.plot(
            *np.concatenate([here[None], nodes]).mean(axis=1).T,
            linestyle="-" if record.accepted else ":",
            color=color,
            marker="." if last else None,
            linewidth=2.0 if last else 1.4,
            zorder=3,
            label=f"plan of iteration {k}" if last or k == 1 else None,
        )
    radius, blue = step.problem.robot_radius, {"color": ROBOT, "alpha": 0.6, "zorder": 4}
    for centre in here:
        axes.add_patch(Circle(tuple(centre), radius, **blue, label="robot now"))
    _draw_obstacles(axes, plan)
    _draw_half_planes(axes, history)
    axes.set_title("In the plane", fontsize=11)


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
        edges = [outline(sets, k, s, inflation, obstacle.shape) for k in range(len(nodes))]
        pale = (*to_rgb(OBSTACLE), 0.08)
        body = PolyCollection(edges, facecolor=pale, edgecolor=OBSTACLE)
        body.set_label("no-go set where it pushes")
        axes.add_collection(body)
        (way,) = axes.plot(*step.means[j].T, "--o", color=OBSTACLE, linewidth=1.0, markersize=4)
        way.set(markevery=[0], label="obstacle, now and expected")
    axes.autoscale_view()


def _draw_half_planes(axes: Axes, history: tuple[Record, ...]) -> None:
    """Those that hold the solution of the last accepted iteration back, shaded where forbidden."""
    last = next((r for r in reversed(history) if r.accepted), history[-1])
    if not len(last.normals):
        return
    extent = float(np.ptp(last.positions, axis=0).max())
    size = _EDGE * extent, _DEPTH * extent
    strips = half_plane_strips(last.points, last.normals, last.values, *size)
    axes.add_collection(PolyCollection(list(strips), facecolor=HALF_PLANE, alpha=0.3))
    label = "active half-plane of the last iteration"
    for strip in strips:
        axes.plot(*strip[:2].T, color=HALF_PLANE, linewidth=1.8, zorder=4, label=label)


def _draw_numbers(
    panels: list[Axes], history: tuple[Record, ...], colors: FloatArray, tolerance: float
) -> None:
    k = np.arange(1, len(history) + 1)
    accepted = np.array([record.accepted for record in history])
    label = "" if accepted.all() else "rejected (plan dotted)"
    rows = [[r.cost, r.violation, r.residual, r.step, r.iterations] for r in history]
    *values, admm = np.array(rows).T
    names = ("cost", "violation\n[m]", "KKT\nresidual", "change of\ninputs")
    costs, violations, residuals, changes, bars = panels
    for axes, name, y in zip(panels, names, values, strict=False):
        axes.plot(k, y, color=REFERENCE, linewidth=1.0, zorder=1)
        axes.scatter(k[accepted], y[accepted], c=colors[accepted], zorder=3, clip_on=False)
        hollow = axes.scatter(k[~accepted], y[~accepted], zorder=3, clip_on=False, label=label)
        hollow.set(facecolor="white", edgecolor=colors[~accepted])
        axes.set_ylabel(name)
        axes.margins(y=0.15)
    costs.set_title("Number by number", fontsize=11)
    cost, violation, *_ = values
    if cost.min() > 0 and cost.max() > _SPAN * cost.min():
        costs.set_yscale("log")
    else:
        costs.ticklabel_format(useOffset=False)
    violations.set_ylim(0.0, 1.15 * max(float(violation.max()), _VISIBLE))
    residuals.set_yscale("log")
    residuals.axhline(tolerance, color=LIMIT, linestyle="--", linewidth=1.0, label="tolerance")
    changes.set_yscale("log")
    bars.bar(k, admm, color=colors, width=0.6)
    bars.set_ylabel("ADMM\niterations")
    bars.set_xlabel("SCP iteration")
    bars.xaxis.set_major_locator(MaxNLocator(integer=True))
    bars.set_xlim(0.4, len(history) + 0.6)
    for axes in panels[:-1]:
        axes.sharex(bars)
        axes.tick_params(labelbottom=False)
    for axes in panels:
        tidy(axes)
    bars.figure.align_ylabels(panels)
