"""A replay at a glance: everybody's paths, the closest meetings, the clearance over time."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from scp_mpc.arrays import FloatArray
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
from scp_mpc.simulation.meetings import Meeting
from scp_mpc.simulation.replay import Replay

_SHOWN = 8  # meetings; more of them hide each other
_HIGHEST = 4.0  # [m] clearance beyond which nobody is near


def replay_figure(run: Replay, meetings: Sequence[Meeting]) -> Figure:
    """Draw a finished replay; `meetings` as `find_meetings` returns them."""
    figure = new_figure(12.5, 6.6)
    done = sum(o.reached for o in run.passes)
    touched = sum(meeting.touched for meeting in meetings)
    figure.suptitle(
        f"{run.times[-1] - run.times[0]:.0f} s among {len(meetings)} recorded people, who do not "
        f"react: {done} passes, {touched} touched"
    )
    grid = figure.add_gridspec(1, 2, width_ratios=(1.0, 1.15))
    ways, clearance = figure.add_subplot(grid[0]), figure.add_subplot(grid[1])
    _draw_ways(ways, run, meetings)
    _draw_clearance(clearance, run, meetings)
    legend_below(figure, (ways, clearance), columns=4)
    return figure


def _draw_ways(axes: Axes, run: Replay, meetings: Sequence[Meeting]) -> None:
    as_map(axes)
    for index, (_, path) in enumerate(run.recording.paths.values()):
        label = None if index else "people"
        axes.plot(*path.T, color=REFERENCE, linewidth=0.5, alpha=0.7, label=label)
    axes.plot(*run.positions.T, color=ROBOT, linewidth=0.8, label="robot")
    line = run.passes[0].crossing
    axes.plot(
        *np.stack([line.start, line.goal]).T, "s--", color=LIMIT, linewidth=1, markersize=5,
        label="start, goal and the straight line",
    )  # fmt: skip
    people = run.people()
    for index, meeting in enumerate(meetings[:_SHOWN]):
        color = OBSTACLE if meeting.touched else PLAN
        robot, person = run.positions[meeting.step], people[meeting.name][meeting.step]
        axes.add_patch(Circle(tuple(robot), run.problem.robot_radius, color=ROBOT, zorder=4))
        axes.add_patch(Circle(tuple(person), run.radius, color=color, zorder=3, alpha=0.8))
        axes.annotate(
            str(index + 1),
            person,
            ha="center",
            va="center",
            color="white",
            fontsize=8,
            fontweight="bold",
            zorder=5,
        )
    axes.set_title("all paths; numbered: the closest meetings", fontsize=11)


def _draw_clearance(axes: Axes, run: Replay, meetings: Sequence[Meeting]) -> None:
    tidy(axes)
    nearest = nearest_clearance(run)
    axes.plot(run.times, nearest, color=ROBOT, linewidth=0.7, label="clearance to the nearest")
    axes.axhline(0.0, color=LIMIT, linewidth=1)
    for touched, color, label in (
        (False, PLAN, "closest to one person, clear"),
        (True, OBSTACLE, "closest to one person, touched"),
    ):
        some = [meeting for meeting in meetings if meeting.touched is touched]
        some = [meeting for meeting in some if meeting.clearance < _HIGHEST]
        if some:
            axes.plot(
                [meeting.time for meeting in some],
                [meeting.clearance for meeting in some],
                "o",
                color=color,
                markersize=4,
                label=label,
            )
    for index, meeting in enumerate(meetings[:_SHOWN]):
        axes.annotate(
            str(index + 1),
            (meeting.time, meeting.clearance),
            xytext=(0, -11),
            textcoords="offset points",
            ha="center",
            fontsize=9,
        )
    ends = [run.times[o.last] for o in run.passes if o.reached]
    axes.plot(
        ends,
        np.full(len(ends), _HIGHEST),
        "|",
        color=HALF_PLANE,
        markersize=9,
        label="goal reached",
    )
    lowest = min((meeting.clearance for meeting in meetings), default=0.0)
    axes.set_ylim(min(-0.3, lowest - 0.25), _HIGHEST + 0.1)
    axes.set_xlim(run.times[0], run.times[-1])
    axes.set_xlabel("time [s]")
    axes.set_ylabel("clearance between discs [m]")
    axes.set_title("clearance; a pass ends at each tick above", fontsize=11)


def nearest_clearance(run: Replay) -> FloatArray:
    """Clearance (K+1,) between the discs of robot and nearest person [m]; NaN with nobody there."""
    people = np.stack(list(run.people().values()))
    distances = np.linalg.norm(people - run.positions, axis=-1)
    alone = np.isnan(distances).all(axis=0)
    nearest = np.where(np.isnan(distances), np.inf, distances).min(axis=0)
    return np.where(alone, np.nan, nearest - run.problem.robot_radius - run.radius)
