"""Closed loops of all robots: time per step, relative to the double integrator among five.

    python benchmarks/run.py --only robots --out out/bench

The machine may be shared: ratios within one run say more than milliseconds.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.circuits import Circuit
from benchmarks.figures import BLUE, VERMILION, canvas, legend_below, plain
from benchmarks.progress import progress
from benchmarks.tables import table
from benchmarks.timing import closed_loop, milliseconds
from scp_mpc.arrays import FloatArray
from scp_mpc.problem import Problem
from scp_mpc.settings import Settings
from scp_mpc.simulation.contact import FINE, robot_path
from scp_mpc.simulation.crowds import Crowd
from scp_mpc.simulation.scenarios import SCENARIOS, Scenario

NAME = "robots"  # of the files
_COLOURS = {True: VERMILION, False: BLUE}
_YARDSTICK = "double integrator 2-D, crowd of 5"


@dataclass(frozen=True)
class Course:
    """A named world with the problem to solve in it."""

    name: str
    world: Scenario | Crowd | Circuit
    nodes_per_interval: int = 1

    @property
    def problem(self) -> Problem:
        """What is solved; circuits have the library's points between the samples."""
        if isinstance(self.world, Circuit):
            return self.world.problem
        return self.world.problem("exact", nodes_per_interval=self.nodes_per_interval)

    def clearance(self, step: int, path: FloatArray) -> float:
        """Smallest true distance [m] along one interval; path (T, d) at equal fractions of it."""
        problem = self.problem
        times = problem.model.dt * (step + np.linspace(0.0, 1.0, len(path)))
        gaps = [
            np.linalg.norm(path - np.array([body.at(t) for t in times]), axis=-1) - body.radius
            for body in self.world.bodies
        ]
        return float(np.min(gaps)) - problem.robot_radius


COURSES = (
    Course(_YARDSTICK, Crowd(30, 5)),
    Course("double integrator 2-D, scenario 1", SCENARIOS["scenario-1"]),
    Course("double integrator 2-D, crowd of 12", Crowd(30, 12)),
    Course("double integrator 2-D, crowd of 50", Crowd(30, 50)),
    *(Course(f"double integrator 2-D, crowd of {M}", Crowd(30, M), 4) for M in (5, 12, 50)),
    Course("double integrator 3-D", Circuit("double integrator 3-D", 30, 12), 4),
    Course("unicycle", Circuit("unicycle", 30, 5), 4),
    Course("unicycle, dense", Circuit("unicycle", 30, 5, dense=True), 4),
    Course("bicycle", Circuit("bicycle", 30, 5), 4),
    Course("bicycle, dense", Circuit("bicycle", 30, 5, dense=True), 4),
    Course("planar quadrotor", Circuit("planar quadrotor", 20, 5), 4),
    Course("quadrotor", Circuit("quadrotor", 20, 5), 4),
)


def rows(steps: int, courses: Sequence[Course] | None = None) -> list[dict[str, Any]]:
    """Run everything in this process; one row per course and setting, the yardstick's first.

    Args:
        steps: Control steps of each closed loop.
        courses: `COURSES` if None.
    """
    courses = COURSES if courses is None else courses
    with progress(2 * len(courses) * steps) as advance:
        found = [
            _row(course, multi_start, steps, advance)
            for course in courses
            for multi_start in (True, False)
        ]
    for row in found:
        for clock in ("wall", "thread"):
            for key in ("median", "p99"):
                row[f"{clock}_{key}_ratio"] = row[clock][key] / found[0][clock][key]
    return found


def markdown(found: Sequence[dict[str, Any]]) -> str:
    """The table in Markdown; ratios are those of the thread's time."""
    names = (
        "Robot | N | Obstacles | Nodes | Multi-start | Median [ms] | p99 [ms] | Max [ms] "
        "| Thread: median, p99 [ms] | Median ratio | p99 ratio | Certified, no slack "
        "| Iterations: median, max | Clearance [m]"
    )
    return table(names, "lrrrlrrrrrrrrr", map(_cells, found))


def figure(found: Sequence[dict[str, Any]]) -> Figure:
    """Draw a row per course: multi-start at every step, and one start."""
    names = list(dict.fromkeys(map(_name, found)))
    drawing, (axes,) = canvas(11.0, 1.6 + 0.45 * len(names))
    for multi_start, shift in ((True, -0.15), (False, 0.15)):
        part = [row for row in found if row["multi_start"] is multi_start]
        y = np.array([names.index(_name(row)) for row in part]) + shift
        median = [row["wall"]["median"] for row in part]
        p99 = [row["wall"]["p99"] for row in part]
        colour, label = _COLOURS[multi_start], "multi-start" if multi_start else "one start"
        axes.hlines(y, median, p99, color=colour, linewidth=2.0)
        axes.plot(median, y, "o", color=colour, label=f"{label}: median")
        axes.plot(p99, y, "|", color=colour, markersize=12, label=f"{label}: p99")
    plain(axes, "x", size=11)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set_xlabel("time per control step [ms]", fontsize=13)
    legend_below(drawing, axes, 4)
    return drawing


def _row(
    course: Course, multi_start: bool, steps: int, advance: Callable[[], object]
) -> dict[str, Any]:
    problem = course.problem
    run = list(
        closed_loop(
            course.world, problem, Settings(multi_start=multi_start, deadline=None), steps, advance
        )
    )
    gaps = []
    for k, step in enumerate(run):
        after = problem.model.step(step.x, step.plan.u0)
        path = robot_path(problem.model, np.array([step.x, after]), step.plan.u0[None])[0]
        gaps.append(course.clearance(k, path[:: FINE // 8]))
    iterations = [step.plan.iterations for step in run]
    return {
        "robot": course.name,
        "horizon": problem.horizon,
        "obstacles": problem.max_obstacles,
        "points": problem.nodes_per_interval,
        "multi_start": multi_start,
        "steps": steps,
        "wall": milliseconds([step.wall for step in run]),
        "thread": milliseconds([step.thread for step in run]),
        "statuses": dict(Counter(step.plan.status.name for step in run)),
        "iterations": [float(np.median(iterations)), max(iterations)],
        "clearance": min(gaps),
    }


def _cells(row: dict[str, Any]) -> tuple[object, ...]:
    thread = row["thread"]
    return (
        *(row[key] for key in ("robot", "horizon", "obstacles", "points")),
        "on" if row["multi_start"] else "off",
        *(f"{row['wall'][key]:.2f}" for key in ("median", "p99", "max")),
        f"{thread['median']:.2f}, {thread['p99']:.2f}",
        *(f"{row[f'thread_{key}_ratio']:.2f}" for key in ("median", "p99")),
        f"{row['statuses'].get('CONVERGED', 0)} of {row['steps']}",
        "{:g}, {}".format(*row["iterations"]),
        f"{row['clearance']:.2f}",
    )


def _name(row: dict[str, Any]) -> str:
    return f"{row['robot']}, N = {row['horizon']}, {row['points']} node(s)"
