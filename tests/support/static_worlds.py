"""Random worlds of discs and boxes, a drive through them, and a judge that knows the truth alone.

The judge shares no code with the package: distances to discs and boxes by hand, nine instants in
each interval, the robot's motion from its own equations.
"""

import numpy as np

from scp_mpc import MPC, DoubleIntegrator, ObstaclePrediction, Polytope, Problem, Unicycle

GOAL = 8.0  # [m] ahead


class World:
    """Some obstacles, standing or moving straight on, and a robot."""

    def __init__(self, seed, moving=False):
        rng = np.random.default_rng(seed)
        self.dt, self.horizon = float(rng.choice([0.1, 0.2])), int(rng.choice([10, 20, 30]))
        self.inflation = str(rng.choice(["exact", "axes"]))
        self.kind, self.radius = str(rng.choice(["point", "unicycle"])), rng.uniform(0.15, 0.4)
        self.things = []
        while not self.things or rng.random() < 0.7:
            at, turn = rng.uniform([1.2, -3.0], [7.0, 3.0]), rng.uniform(0, np.pi)
            velocity = rng.uniform(-1, 1, 2) * moving * (rng.random() < 0.7)
            half = rng.uniform(0.1, 1.2, 2) if rng.random() < 0.4 else None
            thing = (at, velocity, turn, half, 0.05 if half is not None else rng.uniform(0.1, 0.8))
            if self.gap(np.zeros(2), 0.0, thing) > self.radius + 0.3:
                self.things.append(thing)

    @staticmethod
    def gap(p, time, thing):
        """Distance of a point to a disc or a rounded box, negative inside."""
        at, velocity, turn, half, radius = thing
        y = p - at - time * velocity
        if half is None:
            return np.hypot(*y) - radius
        c, s = np.cos(turn), np.sin(turn)
        q = np.abs([c * y[0] + s * y[1], -s * y[0] + c * y[1]]) - half
        return np.hypot(*np.maximum(q, 0)) + min(q.max(), 0) - radius

    def predictions(self, time):
        """What is known for certain, from a time on."""
        stages = self.dt * np.arange(self.horizon + 1)[:, None]
        told = []
        for at, velocity, turn, half, radius in self.things:
            means, shape = at + (time + stages) * velocity, None
            if half is not None:
                c, s = np.cos(turn), np.sin(turn)
                corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
                shape = Polytope(corners @ np.array([[c, s], [-s, c]]))
            told.append(ObstaclePrediction(means, np.zeros((2, 2)), radius, shape=shape))
        return told

    def problem(self):
        """The robot on its way to the goal."""
        point = self.kind == "point"
        return Problem(
            DoubleIntegrator(self.dt) if point else Unicycle(self.dt),
            horizon=self.horizon,
            Q=[1.0, 0.1, 1.0, 0.1] if point else [1.0, 1.0, 0.01, 0.1],
            R=[0.05, 0.05],
            u_min=-2.0,
            u_max=2.0,
            robot_radius=self.radius,
            max_obstacles=len(self.things),
            inflation=self.inflation,
        )

    def between(self, x, u, share):
        """Where the robot is within an interval, from its equations of motion."""
        h = share * self.dt
        if self.kind == "point":
            return x[[0, 2]] + h * x[[1, 3]] + h * h / 2 * u
        fine = np.linspace(0, h, 33)
        course, speed = x[2] + fine * u[1], x[3] + fine * u[0]
        way = np.stack([speed * np.cos(course), speed * np.sin(course)], axis=1)
        return x[:2] + np.trapezoid(way, fine, axis=0)

    def drive(self, seconds=12.0):
        """Whether each step was ok, the least gap in continuous time, and the speed there."""
        problem = self.problem()
        mpc, goal = MPC(problem), np.zeros(4)
        goal[0], x, ok, least = GOAL, np.zeros(4), [], np.inf
        for k in range(int(seconds / self.dt)):
            plan = mpc.step(x, goal, self.predictions(k * self.dt))
            ok.append(plan.ok)
            for share in np.linspace(0, 1, 9):
                p, time = self.between(x, plan.u0, share), (k + share) * self.dt
                least = min(least, *(self.gap(p, time, t) - self.radius for t in self.things))
            x = problem.model.step(x, plan.u0)
        return ok, least
