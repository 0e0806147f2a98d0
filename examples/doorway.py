"""A robot goes through a door that people come out of: python -m examples.doorway [file.gif].

Walls, table and column are polygons that the robot knows, rounded by 5 cm. The people are seen with
errors of 5 cm, tracked and predicted; where they want to go it does not know.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from examples.drawing import Trace, draw_instants, draw_plane, write_gif
from scp_mpc import MPC, PathReference, Polytope, Problem, Settings, SpeedLimits, Unicycle
from scp_mpc import Path as Way
from scp_mpc.geometry import StageRisk
from scp_mpc.simulation import Body, Run, Scene, TrackedSensor, simulate
from scp_mpc.tracking import TrackerSettings

DT, N, INF = 0.15, 20, np.inf
ROOM = (12.0, 7.0)  # [m]
PERSON = 0.25  # [m] radius
WALLS = (
    Polytope([[6.0, -0.2], [6.3, -0.2], [6.3, 2.7], [6.0, 2.7]]),
    Polytope([[6.0, 4.5], [6.3, 4.5], [6.3, 7.2], [6.0, 7.2]]),
    Polytope([[3.3, 1.3], [4.1, 0.9], [4.8, 1.5], [4.4, 2.6], [3.6, 2.4]]),
    Polytope.box([0.7, 0.7], angle=0.6, centre=[8.6, 4.3]),
)
PEOPLE = (  # [m/s], and points of their ways [m]
    (1.0, [(9.4, 3.0), (7.2, 3.6), (6.1, 3.6), (4.8, 3.5), (0.8, 5.8)]),
    (1.1, [(11.5, 2.2), (7.5, 3.5), (6.1, 3.6), (4.6, 3.9), (1.0, 1.2)]),
    (0.8, [(9.6, 0.4), (9.75, 3.5), (9.9, 6.6)]),
    (0.7, [(2.5, 6.6), (2.4, 3.5), (2.3, 0.4)]),
    (0.6, [(10.6, 6.4), (10.4, 3.7), (10.2, 1.0)]),
)

problem = Problem(
    Unicycle(DT),  # x = [px, py, heading, speed], u = [acceleration, turn rate]
    horizon=N,
    Q=[1.0, 1.0, 0.3, 0.2],
    R=[0.05, 0.05],
    u_min=[-1.5, -1.5],
    u_max=[1.0, 1.5],
    du_min=[-0.6, -0.8],
    du_max=[0.6, 0.8],
    x_min=[0.3, 0.3, -INF, -0.3],
    x_max=[ROOM[0] - 0.3, ROOM[1] - 0.3, INF, 1.5],
    robot_radius=0.28,
    margin=StageRisk(0.05),
    max_obstacles=len(WALLS) + len(PEOPLE),
)


def walking(speed: float, points: list[tuple[float, float]]) -> Body:
    """A person."""
    way = Way.spline(points)
    return Body(lambda t: way.positions(speed * t), PERSON)


def scene() -> Scene:
    """The robot at rest on the lower left, about to go through the door to the upper right."""
    way = Way.spline([[0.8, 1.4], [2.8, 2.6], [6.15, 3.6], [8.8, 4.2], [11.2, 5.6]])
    limits = SpeedLimits(1.1, lateral=0.6, longitudinal=0.6)
    follow = PathReference(way, speed=limits, model=problem.model, horizon=N)
    bodies = [Body(np.zeros(2), 0.05, shape=wall) for wall in WALLS]
    bodies += [walking(*person) for person in PEOPLE]
    dx, dy = way.tangents(0.0)
    start = [*way.positions(0.0), np.arctan2(dy, dx), 0.0]
    return Scene(start, lambda _t, x: follow.states(x), bodies)


def drive(steps: int = 100, seed: int = 0) -> Run:
    """Drive; nobody is told of who has not been seen twice, because then a velocity is known."""
    return simulate(
        MPC(problem, Settings(multi_start_interval=4, deadline=None)),
        scene(),
        sensor=TrackedSensor(noise=0.05, tracking=TrackerSettings(confirmations=2)),
        steps=steps,
        seed=seed,
    )


def draw(axes: Axes, run: Run, k: int) -> None:
    """A room from above."""
    draw_plane(axes, run, k)
    axes.set(xlim=(0, ROOM[0]), ylim=(0, ROOM[1]))


def traces(run: Run) -> list[Trace]:
    """Quantities over time, with their bounds."""
    return [
        ("speed [m/s]", run.states[:, 3], (problem.x_min[3], problem.x_max[3])),
        ("turn rate [rad/s]", run.inputs[:, 1], (problem.u_min[1], problem.u_max[1])),
    ]


def picture(run: Run, steps: Sequence[int] = (15, 35, 60)) -> Figure:
    """A few instants, and the traces."""
    return draw_instants(run, draw, steps, traces(run), (14.0, 7.5))


def animate(run: Run, path: Path) -> Path:
    """Write a GIF."""
    return write_gif(run, draw, traces(run), path)


if __name__ == "__main__":
    run = drive()
    path = animate(run, Path(sys.argv[1] if len(sys.argv) > 1 else "doorway.gif"))
    print(f"Smallest clearance {run.clearances.min():.3f} m. See {path}.")
