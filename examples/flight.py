"""A quadrotor flies among balls: python -m examples.flight [file.gif].

It follows a closed spline that rises and falls, and ten balls swing through it. Each is predicted
to go straight on, with a covariance that grows by the acceleration that nobody knows of.
"""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from examples.drawing import Trace, draw_instants, write_gif
from scp_mpc import MPC, ObstaclePrediction, PathReference, Problem, Quadrotor, Settings
from scp_mpc import Path as Way
from scp_mpc.arrays import FloatArray
from scp_mpc.geometry import Containment
from scp_mpc.report.canvas import OBSTACLE, PLAN, ROBOT
from scp_mpc.simulation import Body, Run, Scene, simulate

DT, N, INF = 0.1, 20, np.inf
BALLS, RADIUS = 10, 0.3  # how many, [m]
SPEED = 2.2  # [m/s] along the path
FAST, LEAN = 5.0, 0.7  # [m/s] along each axis, [rad] of roll and pitch at most

problem = Problem(
    Quadrotor(DT),  # x = [position, velocity, roll, pitch, yaw], u = [thrust per mass, body rates]
    horizon=N,
    Q=[2.0, 2.0, 2.0, 0.2, 0.2, 0.2, 0.1, 0.1, 0.5],
    R=[0.02, 0.1, 0.1, 0.1],
    u_min=[2.0, -4.0, -4.0, -2.0],
    u_max=[20.0, 4.0, 4.0, 2.0],
    x_min=[-INF, -INF, 0.4, -FAST, -FAST, -FAST, -LEAN, -LEAN, -INF],
    x_max=[INF, INF, 4.0, FAST, FAST, FAST, LEAN, LEAN, INF],
    robot_radius=0.25,
    margin=Containment(0.95),
    max_obstacles=BALLS,
)
turn = np.linspace(0.0, 2 * np.pi, 12, endpoint=False)
knots = np.stack([4 * np.cos(turn), 3 * np.sin(turn), 2.0 + 0.7 * np.sin(2 * turn)], axis=1)
way = Way.spline(knots, closed=True)


class Balls(Scene):
    """Balls of which the robot is told where they are and how fast."""

    def predictions(self, time: float, dt: float, horizon: int) -> list[ObstaclePrediction]:
        """Straight on."""
        stages = dt * np.arange(horizon + 1)[:, None]
        Sigma = (0.03 + 0.06 * stages[..., None]) ** 2 * np.diag([1.0, 1.0, 0.5])
        told = []
        for ball in self.bodies:
            velocity = (ball.at(time + 1e-3) - ball.at(time - 1e-3)) / 2e-3
            means = ball.at(time) + stages * velocity
            told.append(ObstaclePrediction(means, Sigma, ball.radius, name=ball.name))
        return told


def swinging(j: int, centre: FloatArray, swing: FloatArray, rate: float, phase: float) -> Body:
    """A ball that swings about a point."""
    return Body(lambda t: centre + swing * np.sin(rate * t + phase), RADIUS, name=j)


def scene(seed: int) -> Scene:
    """The robot hovers at the path's beginning; the balls' ways are drawn."""
    rng = np.random.default_rng(seed)
    centres = way.positions(way.length * (np.arange(BALLS) + 0.7) / BALLS)
    swings = rng.normal(size=(BALLS, 3)) * [1.0, 1.0, 0.6]
    swings *= 1.3 / np.linalg.norm(swings, axis=1, keepdims=True)
    rates, phases = rng.uniform(0.4, 0.8, BALLS), rng.uniform(0, 2 * np.pi, BALLS)
    balls = [swinging(j, centres[j], swings[j], rates[j], phases[j]) for j in range(BALLS)]
    follow = PathReference(way, speed=SPEED, model=problem.model, horizon=N)
    start = np.concatenate([way.positions(0.0), np.zeros(6)])
    return Balls(start, lambda _t, x: follow.states(x), balls)


def drive(steps: int = 110, seed: int = 0) -> Run:
    """Fly once round."""
    controller = MPC(problem, Settings(multi_start_interval=4, deadline=None))
    return simulate(controller, scene(seed), steps=steps, seed=seed)


def draw(axes: Any, run: Run, k: int) -> None:
    """In space; on the floor shadows and where balls may be at the horizon."""
    a, b = np.meshgrid(np.linspace(0, 2 * np.pi, 15), np.linspace(0, np.pi, 9))
    sphere = np.stack([np.sin(b) * np.cos(a), np.sin(b) * np.sin(a), np.cos(b)])
    angle = np.linspace(0, 2 * np.pi, 30)
    ring = np.stack([np.cos(angle), np.sin(angle), 0 * angle])
    shadow = {"color": "0.75", "linewidth": 1.2}
    bodies = [(p, RADIUS, OBSTACLE) for p in run.bodies[k]]
    for p, r, colour in [*bodies, (run.positions[k], problem.robot_radius, ROBOT)]:
        axes.plot_surface(*(p[:, None, None] + r * sphere), color=colour)
        floor = p * [1, 1, 0]
        axes.plot(*(floor[:, None] + r * ring), **shadow)
        axes.plot(*np.stack([floor, p - [0, 0, r]], axis=1), ":", **shadow)
    s = problem.size_for(BALLS, 1)
    for told in run.predictions[k]:
        reach = told.radius + s * told.largest_std[-1]
        edge = (told.means[-1] * [1, 1, 0])[:, None] + reach * ring
        axes.plot(*edge, color=OBSTACLE, alpha=0.35, linewidth=1.0)
    past = run.positions[: k + 1]
    axes.plot(*past.T, color=ROBOT, linewidth=1.8)
    axes.plot(*(past * [1, 1, 0]).T, **shadow)
    axes.plot(*run.plans[k].X[:, :3].T, ".-", color=PLAN, markersize=4)
    axes.set_box_aspect((11, 9, 4.2), zoom=1.15)  # as long as the limits: equal scales
    axes.set(xlim=(-5.5, 5.5), ylim=(-4.5, 4.5), zlim=(0, 4.2))
    axes.set(xticks=[-4, 0, 4], yticks=[-4, 0, 4], zticks=[0, 2, 4])
    axes.set(xlabel="x [m]", ylabel="y [m]", zlabel="z [m]")
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_pane_color("white")
    axes.view_init(elev=28, azim=-65 + 0.5 * k)


def traces(run: Run) -> list[Trace]:
    """Quantities over time, with their bounds."""
    thrust = (problem.u_min[0], problem.u_max[0])
    return [
        ("speed [m/s]", np.linalg.norm(run.states[:, 3:6], axis=1), ()),
        ("thrust per mass [m/s²]", run.inputs[:, 0], thrust),
    ]


def picture(run: Run, steps: Sequence[int] = (10, 45, 80)) -> Figure:
    """A few instants, and the traces."""
    return draw_instants(run, draw, steps, traces(run), (14.0, 8.5), projection="3d")


def animate(run: Run, path: Path) -> Path:
    """Write a GIF."""
    return write_gif(run, draw, traces(run), path, projection="3d")


if __name__ == "__main__":
    run = drive()
    path = animate(run, Path(sys.argv[1] if len(sys.argv) > 1 else "flight.gif"))
    print(f"Smallest clearance {run.clearances.min():.2f} m. See {path}.")
