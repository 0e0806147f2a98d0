"""The closest encounter of a run as an animated GIF."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from scp_mpc.report.canvas import as_map
from scp_mpc.report.encounters import find_encounters
from scp_mpc.report.scene import Scene
from scp_mpc.simulation.closed_loop import ClosedLoop

_DPI = 80
_FRAMES_PER_SECOND = 10
_COLORS = 64
_BEFORE, _AFTER = 28, 20  # control steps around the closest one
_CLOSE_UP = 4.5  # [m] half the width of the close-up


def write_animation(run: ClosedLoop, path: Path) -> Path:
    """Write the closest encounter of a run as a GIF, one frame for each control step.

    On the left the whole circle, on the right the place of the encounter.
    """
    closest = min(find_encounters(run), key=lambda o: run.distances[o.closest]).closest
    steps = range(max(closest - _BEFORE, 0), min(closest + _AFTER, run.steps))
    figure, scenes = _stage(run, steps.start, closest)
    title = figure.text(0.06, 0.945, "", fontsize=12)
    writer = OnePaletteWriter(fps=_FRAMES_PER_SECOND)
    with writer.saving(figure, str(path), _DPI):
        for k in steps:
            status = run.plans[k].status
            title.set_text(f"{run.times[k]:5.1f} s   {status.name}: {status.value}")
            for scene in scenes:
                scene.show(k)
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


def _stage(run: ClosedLoop, start: int, closest: int) -> tuple[Figure, list[Scene]]:
    """A figure with a fixed layout, so that nothing moves but the scene."""
    figure = Figure(figsize=(11.2, 6.2), dpi=_DPI)
    FigureCanvasAgg(figure)
    whole, close = figure.subplots(1, 2)
    figure.subplots_adjust(left=0.06, right=0.985, bottom=0.17, top=0.92, wspace=0.13)
    scenes = [Scene(whole, run, start, half_planes=0), Scene(close, run, start, half_planes=4)]
    reach = float(np.abs(np.concatenate([run.positions, run.obstacle])).max()) + 1.0
    middle = (run.positions[closest] + run.obstacle[closest]) / 2
    for axes, centre, half_width in ((whole, np.zeros(2), reach), (close, middle, _CLOSE_UP)):
        as_map(axes)
        axes.set_xlim(centre[0] - half_width, centre[0] + half_width)
        axes.set_ylim(centre[1] - half_width, centre[1] + half_width)
    handles, labels = close.get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=5, frameon=False, fontsize=11)
    return figure, scenes
