"""The thickest of the crowd in a replay as an animated GIF."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from scp_mpc.report.animation import OnePaletteWriter
from scp_mpc.report.canvas import LIMIT, OBSTACLE, PLAN, ROBOT, as_map
from scp_mpc.report.outline import no_go_outline
from scp_mpc.simulation.replay import Replay

_DPI = 80
_FRAMES_PER_SECOND = 8
_FRAMES = 80
_NEAR = 3.0  # [m] from the robot
_FADING = (0.6, 0.4, 0.22)  # opacity of the no-go sets, from the first stage shown to the last
_MOST_SETS = 8  # people whose no-go sets are drawn, the nearest; more of them hide each other
_TRAIL = 20  # control steps of the robot's path behind it
_LONGER, _SHORTER = 7.4, 4.6  # [inch] of the map's longer side, and of any side at least
_LEFT, _RIGHT, _BELOW, _ABOVE = 0.7, 0.15, 1.25, 0.4  # [inch] around it
_AROUND = 1.0  # [m] beyond the middle nine tenths of where people are


def write_replay_animation(run: Replay, path: Path) -> Path:
    """Write the control steps with most people around the robot as a GIF, one frame for each."""
    steps = animated_steps(run)
    figure, axes = _stage(run)
    title = axes.set_title("", fontsize=11, loc="left")
    scene = _Crowd(axes, run)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=2, frameon=False, fontsize=10)
    writer = OnePaletteWriter(fps=_FRAMES_PER_SECOND)
    with writer.saving(figure, str(path), _DPI):
        for k in steps:
            title.set_text(f"{run.times[k]:6.1f} s   {run.statuses[k].name}")
            scene.show(k)
            writer.grab_frame()
    return path


def animated_steps(run: Replay) -> range:
    """The control steps in a row during which most people are near the robot."""
    count = min(_FRAMES, run.steps)
    people = np.stack(list(run.people().values()))[:, : run.steps]
    distances = np.linalg.norm(people - run.positions[: run.steps], axis=-1)
    near = np.concatenate([[0], np.cumsum((distances < _NEAR).sum(axis=0))])
    begin = int(np.argmax(near[count:] - near[: len(near) - count]))
    return range(begin, begin + count)


class _Crowd:
    """The artists: created once, moved from frame to frame."""

    def __init__(self, axes: Axes, run: Replay) -> None:
        self._run, self._people = run, np.stack(list(run.people().values()))
        present = (~np.isnan(self._people[..., 0])).sum(axis=0).max(initial=1)
        stages = np.linspace(run.problem.horizon / len(_FADING), run.problem.horizon, len(_FADING))
        self._stages = [int(stage) for stage in stages.round()]
        slots = min(max((len(told) for told in run.predictions), default=0), _MOST_SETS)
        self._sets = [[_outline(axes, alpha) for alpha in _FADING] for _ in range(slots)]
        if slots:
            seconds = ", ".join(f"{stage * run.problem.model.dt:g}" for stage in self._stages)
            self._sets[0][0].set_label(f"no-go sets in {seconds} s, of the {slots} nearest")
        line = run.passes[0].crossing
        axes.plot(
            *np.stack([line.start, line.goal]).T, "s", color=LIMIT, markersize=6, label="ends"
        )
        (self._path,) = axes.plot([], [], color=ROBOT, linewidth=1.5, label="travelled")
        (self._plan,) = axes.plot([], [], ".-", color=PLAN, linewidth=1.2, label="planned")
        self._discs = [Circle((np.nan, np.nan), run.radius, color=OBSTACLE) for _ in range(present)]
        self._robot = Circle((np.nan, np.nan), run.problem.robot_radius, color=ROBOT, zorder=5)
        for index, disc in enumerate([*self._discs, self._robot]):
            disc.set_label("people" if index == 0 else None)
            axes.add_patch(disc)
        self._robot.set_label("robot")

    def show(self, k: int) -> None:
        """Move everything to where it is at control step k."""
        run = self._run
        self._robot.center = tuple(run.positions[k])
        self._path.set_data(*run.positions[max(k - _TRAIL, 0) : k + 1].T)
        self._plan.set_data(*run.plans[k].T)
        places = self._people[:, k][~np.isnan(self._people[:, k, 0])]
        for index, disc in enumerate(self._discs):
            disc.set_visible(index < len(places))
            if index < len(places):
                disc.center = tuple(places[index])
        told, size = run.predictions[k], run.problem.size.reference
        for index, patches in enumerate(self._sets):
            for patch, stage in zip(patches, self._stages, strict=True):
                patch.set_visible(index < len(told))
                if index < len(told):
                    patch.set_xy(no_go_outline(run.problem, told[index], stage, size))


def _outline(axes: Axes, opacity: float) -> Polygon:
    patch = Polygon(np.zeros((4, 2)), color=OBSTACLE, alpha=opacity, fill=False, linewidth=1.0)
    axes.add_patch(patch)
    return patch


def _stage(run: Replay) -> tuple[Figure, Axes]:
    """A figure with a fixed layout around where people are."""
    places = np.concatenate([*run.recording.positions, run.positions])
    low, high = np.quantile(places, [0.01, 0.99], axis=0) + [[-_AROUND], [_AROUND]]
    size = _LONGER * (high - low) / (high - low).max()
    whole = np.maximum(size, _SHORTER) + [_LEFT + _RIGHT, _BELOW + _ABOVE]
    figure = Figure(figsize=tuple(whole.tolist()), dpi=_DPI)
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    figure.subplots_adjust(
        left=_LEFT / whole[0],
        right=1 - _RIGHT / whole[0],
        bottom=_BELOW / whole[1],
        top=1 - _ABOVE / whole[1],
    )
    as_map(axes)
    axes.set_xlim(low[0], high[0])
    axes.set_ylim(low[1], high[1])
    return figure, axes
