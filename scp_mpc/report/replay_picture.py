"""A replay as pictures: at a glance, and the thickest of the crowd as an animated GIF."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.report.animation import OnePaletteWriter
from scp_mpc.report.canvas import (
    HALF_PLANE,
    LIMIT,
    OBSTACLE,
    PLAN,
    REFERENCE,
    ROBOT,
    as_map,
    legend_below,
    new_figure,
    tidy,
)
from scp_mpc.report.outline import no_go_outline
from scp_mpc.simulation.events import Meeting, find_meetings
from scp_mpc.simulation.run import Run
from scp_mpc.simulation.there_and_back import arrivals, crossing_of

_SHOWN = 8  # meetings, and people whose no-go sets are drawn; more of them hide each other
_HIGHEST = 4.0  # [m] clearance beyond which nobody is near
_DPI = 80
_FRAMES_PER_SECOND = 8
_FRAMES = 80
_NEAR = 3.0  # [m] from the robot
_FADING = ((1 / 3, 0.6), (2 / 3, 0.4), (1.0, 0.22))  # share of the horizon, opacity
_TRAIL = 20  # control steps of the robot's path behind it
_LONGER, _SHORTER = 7.4, 4.6  # [inch] of the map's longer side, and of any side at least
_AROUND = 1.0  # [m] beyond where nearly everybody is


def replay_figure(run: Run) -> Figure:
    """Draw everybody's paths, the closest meetings, and the clearance over time."""
    meetings, ends = find_meetings(run), run.times[arrivals(run)]
    figure = new_figure(12.5, 6.6)
    figure.suptitle(
        f"{run.times[-1]:.0f} s among {len(meetings)} recorded people, who do not react: "
        f"{len(ends)} passes, {sum(meeting.touched for meeting in meetings)} touched"
    )
    ways, clearance = figure.subplots(1, 2, width_ratios=(1.0, 1.15))
    _draw_ways(ways, run, meetings[:_SHOWN])
    _draw_clearance(clearance, run, meetings)
    high = np.full(len(ends), _HIGHEST)
    clearance.plot(ends, high, "|", color=HALF_PLANE, markersize=9, label="goal reached")
    legend_below(figure, (ways, clearance), columns=4)
    return figure


def _draw_ways(axes: Axes, run: Run, meetings: Sequence[Meeting]) -> None:
    as_map(axes)
    axes.plot(run.bodies[..., 0], run.bodies[..., 1], color=REFERENCE, linewidth=0.5, alpha=0.7)
    axes.lines[0].set_label("people")
    axes.plot(*run.positions.T, color=ROBOT, linewidth=0.8, label="robot")
    _draw_ends(axes, run)
    for number, meeting in enumerate(meetings, 1):
        person = run.bodies[meeting.step, meeting.body]
        color = OBSTACLE if meeting.touched else PLAN
        robot = Circle(run.positions[meeting.step], run.problem.robot_radius, color=ROBOT, zorder=4)
        axes.add_patch(robot)
        radius = run.scene.bodies[meeting.body].radius
        axes.add_patch(Circle(person, radius, color=color, zorder=3, alpha=0.8))
        axes.annotate(str(number), person, ha="center", va="center", color="white", zorder=5)
    axes.set_title("all paths; numbered: the closest meetings", fontsize=11)


def _draw_clearance(axes: Axes, run: Run, meetings: Sequence[Meeting]) -> None:
    tidy(axes)
    nearest = run.clearances.min(axis=1)
    axes.plot(run.times[:-1], nearest, color=ROBOT, linewidth=0.7, label="nearest person")
    axes.axhline(0.0, color=LIMIT, linewidth=1)
    for touched, color, how in ((False, PLAN, "clear"), (True, OBSTACLE, "touched")):
        some = [(o.time, o.clearance) for o in meetings if o.touched is touched]
        if some:
            label = f"closest to one person, {how}"
            axes.plot(*np.transpose(some), "o", color=color, markersize=4, label=label)
    for number, o in enumerate(meetings[:_SHOWN], 1):
        if o.clearance < _HIGHEST:  # a text beyond the axes takes their place
            axes.text(o.time, o.clearance - 0.07, str(number), ha="center", va="top", fontsize=9)
    axes.set_ylim(min(-0.3, nearest.min() - 0.25), _HIGHEST + 0.1)
    axes.set_xlim(0.0, run.times[-1])
    axes.set_xlabel("time [s]")
    axes.set_ylabel("clearance between discs [m]")
    axes.set_title("clearance; a pass ends at each tick above", fontsize=11)


def write_replay_animation(run: Run, path: Path) -> Path:
    """Write the control steps with most people around the robot as a GIF, one frame for each."""
    everywhere = np.concatenate([run.bodies.reshape(-1, 2), run.positions])
    low, high = np.nanquantile(everywhere, [0.01, 0.99], axis=0) + [[-_AROUND], [_AROUND]]
    size = np.maximum(_LONGER * (high - low) / (high - low).max(), _SHORTER) + [0.9, 1.7]
    figure, steps = new_figure(*size), animated_steps(run)
    axes = figure.subplots()
    as_map(axes)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    writer = OnePaletteWriter(fps=_FRAMES_PER_SECOND)
    with writer.saving(figure, str(path), _DPI):
        for k in steps:
            for artist in (*axes.lines, *axes.patches):
                artist.remove()
            _draw_step(axes, run, k)
            if k == steps[0]:
                legend_below(figure, [axes], columns=2)
                figure.draw_without_rendering()
                figure.set_layout_engine(None)  # nothing moves but the scene
            writer.grab_frame()
    return path


def animated_steps(run: Run) -> range:
    """The control steps in a row during which most people are near the robot."""
    count = min(_FRAMES, run.steps)
    distances = np.linalg.norm(run.bodies - run.positions[:, None], axis=-1)[:-1]
    near = np.concatenate([[0], np.cumsum((distances < _NEAR).sum(axis=1))])
    begin = int(np.argmax(near[count:] - near[:-count]))
    return range(begin, begin + count)


def _draw_step(axes: Axes, run: Run, k: int) -> None:
    plan, problem = run.plans[k], run.problem
    axes.set_title(f"{run.times[k]:6.1f} s   {plan.status.name}", fontsize=11, loc="left")
    for share, alpha in _FADING:
        stage = round(share * problem.horizon)
        label = f"no-go sets in {stage * problem.model.dt:g} s, of the {_SHOWN} nearest"
        for told in _nearest(run, k):
            around = no_go_outline(problem, told, stage, problem.size.reference)
            axes.plot(*around.T, color=OBSTACLE, alpha=alpha, linewidth=1.0, label=label)
    _draw_ends(axes, run)
    behind = run.positions[max(k - _TRAIL, 0) : k + 1]
    axes.plot(*behind.T, color=ROBOT, linewidth=1.5, label="travelled")
    ahead = plan.X[:, problem.model.position]
    axes.plot(*ahead.T, ".-", color=PLAN, linewidth=1.2, label="planned")
    for body, place in zip(run.scene.bodies, run.bodies[k], strict=True):
        if not np.isnan(place).any():
            axes.add_patch(Circle(place, body.radius, color=OBSTACLE, label="people", zorder=4))
    here, radius = run.positions[k], problem.robot_radius
    axes.add_patch(Circle(here, radius, color=ROBOT, label="robot", zorder=4))


def _nearest(run: Run, k: int) -> list[ObstaclePrediction]:
    """Those of whom the robot was told that were nearest to it at a step."""
    here = run.positions[k]
    told = sorted(run.predictions[k], key=lambda o: float(np.linalg.norm(o.means[0] - here)))
    return told[:_SHOWN]


def _draw_ends(axes: Axes, run: Run) -> None:
    line = crossing_of(run)
    ends = np.stack([line.start, line.goal])
    axes.plot(*ends.T, "s--", color=LIMIT, linewidth=1, markersize=5, label="start and goal")
