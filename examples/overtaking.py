"""A car overtakes on a two-lane road: python -m examples.overtaking [file.gif].

A kinematic bicycle, covered by three discs, comes up behind a slower car, a box, while two others
come the other way, three discs each. The road runs along the second axis; x = 0 is the right lane.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from examples.drawing import Trace, draw_instants, draw_plane, write_gif
from scp_mpc import MPC, KinematicBicycle, PathReference, Polytope, Problem, Settings
from scp_mpc import Path as Way
from scp_mpc.simulation import Body, Run, Scene, simulate

DT, N, INF = 0.2, 25, np.inf
LANE = 3.6  # [m] wide; the left one is at x = -LANE
LONG, WIDE = 4.4, 1.8  # [m] of a car
DISCS, RADIUS = (-1.5, 0.0, 1.5), 1.17  # [m] along a car; they reach its corners
SPEED, SLOW = 14.0, 7.0  # [m/s] what the car would like to drive, and what the one ahead does
ONCOMING = ((92.0, -10.0), (330.0, -11.0))  # [m] where they are at first, [m/s] and their speeds

problem = Problem(
    KinematicBicycle(DT, wheelbase=2.7, rear=1.35),  # x = [px, py, heading, speed, steering angle]
    horizon=N,
    Q=[0.06, 0.04, 2.0, 0.05, 0.5],
    R=[0.05, 2.0],  # u = [acceleration, steering rate]
    u_min=[-5.0, -0.5],
    u_max=[2.5, 0.5],
    du_min=[-1.5, -0.2],
    du_max=[1.5, 0.2],
    x_min=[-LANE - 0.75, -INF, -INF, 0.0, -0.3],
    x_max=[0.75, INF, INF, 16.0, 0.3],
    robot_radius=RADIUS,
    discs=DISCS,
    max_obstacles=1 + len(DISCS) * len(ONCOMING),
)


def oncoming(y: float, speed: float) -> Body:
    """A disc of a car that may change its speed by 0.35 m/s, one standard deviation."""
    along = 0.1 + 0.35 * DT * np.arange(N + 1)
    Sigma = np.array([np.diag([0.12**2, sigma**2]) for sigma in along])
    return Body(lambda t: [-LANE, y + speed * t], RADIUS, covariances=Sigma, name=f"from {y} m")


def scene() -> Scene:
    """The car at 13 m/s, the slow one 28 m ahead, the others on the left."""
    road = Way.polyline([[0.0, -20.0], [0.0, 600.0]])
    follow = PathReference(road, speed=SPEED, model=problem.model, horizon=N)
    sigma = 0.05 + 0.03 * DT * np.arange(N + 1)
    slow = Body(
        lambda t: [0.0, 28.0 + SLOW * t],
        0.0,
        shape=Polytope.box([WIDE, LONG]),
        covariances=sigma[:, None, None] ** 2 * np.eye(2),
        name="slow",
    )
    discs = [oncoming(y + d, speed) for y, speed in ONCOMING for d in DISCS]
    return Scene([0.0, 0.0, np.pi / 2, 13.0, 0.0], lambda _t, x: follow.states(x), [slow, *discs])


def drive(steps: int = 50) -> Run:
    """Drive."""
    return simulate(
        MPC(problem, Settings(multi_start_interval=2, deadline=None)), scene(), steps=steps
    )


def draw(axes: Axes, run: Run, k: int) -> None:
    """A road from above, that moves with the car."""
    axes.set_facecolor("0.93")
    for edge in (-1.5 * LANE, 0.5 * LANE):
        axes.axvline(edge, color="0.2", linewidth=2)
    axes.axvline(-0.5 * LANE, color="0.45", linewidth=1.2, dashes=(8, 8))
    outline = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [LONG / 2, WIDE / 2]
    draw_plane(axes, run, k, outline)
    y = run.positions[k, 1]
    axes.set(xlim=(-1.5 * LANE - 0.8, 0.5 * LANE + 0.8), ylim=(y - 14, y + 34))


def traces(run: Run) -> list[Trace]:
    """Quantities over time, with their bounds."""
    x, u, (low, high) = run.states, run.inputs, (problem.x_min, problem.x_max)
    return [
        ("speed [m/s]", x[:, 3], (low[3], high[3])),
        ("steering [rad]", x[:, 4], (low[4], high[4])),
        ("acceleration [m/s²]", u[:, 0], (problem.u_min[0], problem.u_max[0])),
        ("x of the car's middle [m]", x[:, 0], (low[0], high[0])),
    ]


def picture(run: Run, steps: Sequence[int] = (5, 15, 20, 24, 28, 36)) -> Figure:
    """A few instants, and the traces."""
    return draw_instants(run, draw, steps, traces(run), (13.0, 12.0), share=6.8)


def animate(run: Run, path: Path) -> Path:
    """Write a GIF."""
    return write_gif(run, draw, traces(run)[:2], path, beside=True)


if __name__ == "__main__":
    run = drive()
    path = animate(run, Path(sys.argv[1] if len(sys.argv) > 1 else "overtaking.gif"))
    print(f"Smallest clearance {run.clearances.min():.2f} m. See {path}.")
