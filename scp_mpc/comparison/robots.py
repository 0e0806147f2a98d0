"""Closed loops of all robots: time per step, relative to the double integrator among five.

The machine may be shared: ratios within one run say more than milliseconds. Besides the wall time
of each call of `MPC.step` there is its thread's own time, which does not count what others take.
"""

import gc
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter, thread_time
from typing import Any

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.comparison.progress import progress
from scp_mpc.control.mpc import MPC
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.settings import Settings
from scp_mpc.simulation.circuits import Circuit
from scp_mpc.simulation.contact import FINE, robot_path
from scp_mpc.simulation.crowds import Crowd
from scp_mpc.simulation.scenarios import SCENARIOS, Scenario

NAME = "robots"  # of the files
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
        if isinstance(self.world, Circuit):
            return self.world.clearance(step, path)
        obstacles = self.world.obstacles if isinstance(self.world, Crowd) else [self.world.obstacle]
        problem, fractions = self.problem, np.linspace(0.0, 1.0, len(path))
        times = problem.model.dt * (step + fractions)
        gaps = [
            np.linalg.norm(path - np.array([o.position(t) for t in times]), axis=-1) - o.radius
            for o in obstacles
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
        table = [
            _row(course, multi_start, steps, advance)
            for course in courses
            for multi_start in (True, False)
        ]
    for row in table:
        for clock in ("wall", "thread"):
            for key in ("median", "p99"):
                row[f"{clock}_{key}_ratio"] = row[clock][key] / table[0][clock][key]
    return table


def markdown(table: Sequence[dict[str, Any]]) -> str:
    """The table in Markdown; ratios are those of the thread's time."""
    head = (
        "| Robot | N | Obstacles | Points | Multi-start | Median [ms] | p99 [ms] | Max [ms] "
        "| Thread: median, p99 [ms] | Median ratio | p99 ratio | Certified, no slack "
        "| Iterations: median, max | Clearance [m] |\n"
        "|:--|--:|--:|--:|:--|--:|--:|--:|--:|--:|--:|--:|--:|--:|"
    )
    return "\n".join([head, *map(_line, table)])


def _row(
    course: Course, multi_start: bool, steps: int, advance: Callable[[], object]
) -> dict[str, Any]:
    problem, world, x = course.problem, course.world, course.world.start()
    given: Callable[[int], tuple[FloatArray, list[ObstaclePrediction]]] = lambda k: (  # noqa: E731
        world.states(k),
        world.predictions(k),
    )
    settings = Settings(multi_start=multi_start)
    MPC(problem, settings).step(x, *given(0))
    mpc, plans, wall, thread, gaps = MPC(problem, settings), [], [], [], []
    gc.collect()
    gc.freeze()
    try:
        for k in range(steps):
            x_ref, obstacles = given(k)
            began, worked = perf_counter(), thread_time()
            plan = mpc.step(x, x_ref, obstacles)
            thread.append(thread_time() - worked)
            wall.append(perf_counter() - began)
            after = problem.model.step(x, plan.u0)
            path = robot_path(problem.model, np.array([x, after]), plan.u0[None])[0]
            gaps.append(course.clearance(k, path[:: FINE // 8]))
            plans.append((plan.status.name, plan.iterations))
            x = after
            advance()
    finally:
        gc.unfreeze()
    statuses = Counter(status for status, _ in plans)
    iterations = [count for _, count in plans]
    return {
        "robot": course.name,
        "horizon": problem.horizon,
        "obstacles": problem.max_obstacles,
        "points": problem.nodes_per_interval,
        "multi_start": multi_start,
        "steps": steps,
        "wall": _summary(wall),
        "thread": _summary(thread),
        "statuses": dict(statuses),
        "iterations": [float(np.median(iterations)), max(iterations)],
        "clearance": min(gaps),
    }


def _summary(seconds: Sequence[float]) -> dict[str, float]:
    """Milliseconds."""
    t = 1e3 * np.array(seconds)
    return {
        "median": float(np.median(t)),
        "p99": float(np.percentile(t, 99)),
        "max": float(t.max()),
    }


def _line(row: dict[str, Any]) -> str:
    thread = row["thread"]
    cells = (
        *(row[key] for key in ("robot", "horizon", "obstacles", "points")),
        "on" if row["multi_start"] else "off",
        *(f"{row['wall'][key]:.2f}" for key in ("median", "p99", "max")),
        f"{thread['median']:.2f}, {thread['p99']:.2f}",
        *(f"{row[f'thread_{key}_ratio']:.2f}" for key in ("median", "p99")),
        f"{row['statuses'].get('CONVERGED', 0)} of {row['steps']}",
        "{:g}, {}".format(*row["iterations"]),
        f"{row['clearance']:.2f}",
    )
    return "| " + " | ".join(map(str, cells)) + " |"
