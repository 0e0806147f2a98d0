"""The closest encounter of a run as an animated GIF.

The artists are created once and moved from step to step, which is several times faster than
drawing anew.
"""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from scp_mpc.arrays import FloatArray
from scp_mpc.geometry.no_go import NoGoSets
from scp_mpc.report.canvas import HALF_PLANE, OBSTACLE, PLAN, REFERENCE, ROBOT, as_map, show_square
from scp_mpc.report.encounters import centre_distances, find_encounters
from scp_mpc.report.outline import half_plane_strips, no_go_outline
from scp_mpc.simulation.run import Run

_DPI = 80
_FRAMES_PER_SECOND = 10
_COLORS = 64
_BEFORE, _AFTER = 28, 20  # control steps around the closest one
_CLOSE_UP = 4.5  # [m] half the width of the close-up
_FADING = (1.0, 0.7, 0.5, 0.35, 0.2)  # opacity of the no-go sets along the horizon
_HALF_PLANES = 4  # at most
_HALF_LENGTH, _DEPTH = 1.2, 0.35  # [m] of a half-plane's edge and of its shading


def write_animation(run: Run, path: Path) -> Path:
    """Write the closest encounter of a run as a GIF, one frame for each control step.

    On the left the whole circle, on the right the place of the encounter.
    """
    closest = min(find_encounters(run), key=centre_distances(run).__getitem__)
    steps = range(max(closest - _BEFORE, 0), min(closest + _AFTER, run.steps))
    figure = Figure(figsize=(11.2, 6.2), dpi=_DPI)  # a fixed layout: nothing moves but the robot
    FigureCanvasAgg(figure)
    whole, close = figure.subplots(1, 2)
    figure.subplots_adjust(left=0.06, right=0.985, bottom=0.17, top=0.92, wspace=0.13)
    reach = float(np.abs([run.positions, run.bodies[:, 0]]).max()) + 1.0
    middle = (run.positions[closest] + run.bodies[closest, 0]) / 2
    show_square(whole, np.zeros(2), reach)
    show_square(close, middle, _CLOSE_UP)
    views = _View(whole, run, steps.start, 0), _View(close, run, steps.start, _HALF_PLANES)
    handles, labels = close.get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=5, frameon=False, fontsize=11)
    title = figure.text(0.06, 0.945, "", fontsize=12)
    writer = OnePaletteWriter(fps=_FRAMES_PER_SECOND)
    with writer.saving(figure, str(path), _DPI):
        for k in steps:
            status = run.plans[k].status
            title.set_text(f"{run.times[k]:5.1f} s   {status.name}: {status.value}")
            for view in views:
                view.show(k)
            writer.grab_frame()
    return path


class OnePaletteWriter(PillowWriter):
    """Gives all frames the same colours, so that what stands still costs nothing: half the size."""

    _frames: list[Any]

    def finish(self) -> None:
        """Take the palette from the frame in the middle, where everything is in sight."""
        palette = self._frames[len(self._frames) // 2].quantize(colors=_COLORS, method=2)
        self._frames = [frame.quantize(palette=palette, dither=0) for frame in self._frames]
        super().finish()


class _View:
    """The artists on one pair of axes: the path from a step on, some half-planes at most."""

    def __init__(self, axes: Axes, run: Run, start: int, half_planes: int) -> None:
        as_map(axes)
        self._run, self._start = run, start
        circle = np.array(run.references)[:, 0, run.problem.model.position]
        axes.plot(*circle.T, color=REFERENCE, linewidth=4, alpha=0.6, label="reference")
        self._stages = np.linspace(0, run.problem.horizon, len(_FADING)).round().astype(int)
        self._sets = [_polygon(axes, OBSTACLE, alpha, 1.2) for alpha in _FADING]
        self._sets[0].set(alpha=None, fill=True, facecolor=(*to_rgb(OBSTACLE), 0.15))
        self._sets[0].set_label("no-go sets, now and predicted")
        (self._path,) = axes.plot([], [], color=ROBOT, linewidth=1.5, label="travelled")
        (self._plan,) = axes.plot([], [], ".-", color=PLAN, lw=1.2, ms=5, label="planned")
        self._shades = [_polygon(axes, HALF_PLANE, 0.25) for _ in range(half_planes)]
        self._edges = axes.plot([], np.zeros((0, half_planes)), color=HALF_PLANE, linewidth=2.5)
        for edge in self._edges[:1]:
            edge.set_label("active half-planes")
        self._obstacle = Circle((0, 0), run.scene.bodies[0].radius, color=OBSTACLE, zorder=4)
        self._robot = Circle((0, 0), run.problem.robot_radius, color=ROBOT, zorder=5)
        axes.add_patch(self._obstacle)
        axes.add_patch(self._robot)

    def show(self, k: int) -> None:
        """Move everything to where it is at control step k."""
        run, plan = self._run, self._run.plans[k]
        self._robot.center = tuple(run.positions[k])
        self._obstacle.center = tuple(run.bodies[k, 0])
        self._path.set_data(*run.positions[self._start : k + 1].T)
        self._plan.set_data(*plan.X[:, run.problem.model.position].T)
        for patch, stage in zip(self._sets, self._stages, strict=True):
            told, s = run.predictions[k][0], float(plan.s[0])
            patch.set_xy(no_go_outline(run.problem, told, stage, s))
        strips = [*active_half_planes(run, k), *np.full((len(self._edges), 4, 2), np.nan)]
        for shade, edge, strip in zip(self._shades, self._edges, strips, strict=False):
            shade.set_xy(strip)
            edge.set_data(*strip[:2].T)


def _polygon(axes: Axes, color: str, opacity: float, width: float = 0.0) -> Polygon:
    """Filled if without an outline."""
    patch = Polygon(np.zeros((4, 2)), color=color, alpha=opacity, fill=not width, linewidth=width)
    axes.add_patch(patch)
    return patch


def active_half_planes(run: Run, k: int) -> FloatArray:
    """Return a strip (n, 4, 2) [m] of each half-plane that holds the plan of step k back.

    Half-planes are about the plan itself, so that their edges touch it; see `half_plane_strips`.
    """
    plan = run.plans[k]
    step, i = plan.step, np.flatnonzero(plan.iterate.touched[0])
    positions = step.nodes.positions(plan.X, plan.U)[i]
    sets = NoGoSets.pairs(step.means[0, i + 1], step.covariances[0, i + 1], step.radii[0, i])
    start = np.tile(step.here - step.means[0, 0], (len(i), 1))
    s = np.full(len(i), plan.iterate.s[0])
    spaces = run.problem.no_go.linearise(sets, positions[:, None], s, start)
    normals, values = spaces.normal[:, 0], spaces.value[:, 0]
    return half_plane_strips(positions, normals, values, _HALF_LENGTH, _DEPTH)
