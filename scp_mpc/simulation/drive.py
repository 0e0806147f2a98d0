"""Drives: any robot among any bodies, in closed loop, and how close it came to each of them.

At each control step: look (reference and predictions), solve, apply. The bodies go their own way
and do not react.

Notation:
    K           control steps
    p (K, F, d) centres of the robot's discs at F equal fractions of each interval [m]
"""

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Protocol

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.control.mpc import MPC
from scp_mpc.geometry.polytopes import Polytopes
from scp_mpc.models.model import Model
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.scp.plan import Plan
from scp_mpc.settings import Settings
from scp_mpc.simulation.contact import FINE

Look = Callable[[int, FloatArray], tuple[FloatArray, list[ObstaclePrediction]]]


class World(Protocol):
    """A scene to drive through: what is asked for, and what is in the way."""

    @property
    def steps(self) -> int:
        """Number of control steps K."""
        ...

    def problem(self) -> Problem:
        """What to solve at each step."""
        ...

    def start(self) -> FloatArray:
        """State (nx,) at time 0."""
        ...

    def begin(self, problem: Problem, seed: int) -> tuple[list[ObstaclePrediction], Look]:
        """Return the true bodies, and what the robot is told at step k in state x (nx,).

        A body's `means` (K+1, d) are where it is at each step; it goes straight in between.
        """
        ...


@dataclass(frozen=True, eq=False)
class Drive:
    """A finished drive, K steps long.

    Attributes:
        problem: What was solved at each step.
        bodies: What was in the way: `means` (K+1, d) are true positions.
        states: (K+1, nx).
        inputs: (K, nu), as applied.
        references: K references (N+1, nx).
        predictions: K lists of what the robot was told.
        plans: K plans.
        seconds: (K,) wall time of each call of `MPC.step`.
    """

    problem: Problem
    bodies: list[ObstaclePrediction]
    states: FloatArray
    inputs: FloatArray
    references: list[FloatArray]
    predictions: list[list[ObstaclePrediction]]
    plans: list[Plan]
    seconds: FloatArray

    @property
    def times(self) -> FloatArray:
        """(K+1,) [s]."""
        return self.problem.model.dt * np.arange(len(self.states), dtype=np.float64)

    @property
    def positions(self) -> FloatArray:
        """(K+1, d) of the robot [m]."""
        return self.states[:, self.problem.model.position]

    def clearances(self) -> FloatArray:
        """(bodies, K) smallest true distance between robot and body within each interval [m].

        Looked at 32 times in each: negative where they overlap.
        """
        problem, share = self.problem, np.linspace(0.0, 1.0, FINE + 1)
        states = problem.model.advance(
            self.states[None, :-1], self.inputs[None], share[:, None]
        )  # (F, K, nx)
        discs = disc_centres(problem.model, states, problem.discs)  # (F, K, n, d)
        return np.stack([self._clearance(body, discs, share) for body in self.bodies])

    def _clearance(
        self, body: ObstaclePrediction, discs: FloatArray, share: FloatArray
    ) -> FloatArray:
        begin, end = body.means[:-1], body.means[1:]
        there = begin + share[:, None, None] * (end - begin)
        gap = discs - there[:, :, None]
        if body.shape is None:
            distance = np.linalg.norm(gap, axis=-1)
        else:
            shapes = Polytopes.of([body])
            assert shapes is not None
            flat = gap.reshape(1, -1, gap.shape[-1])
            distance = shapes.distance(flat).reshape(gap.shape[:-1])
        nearest: FloatArray = distance.min(axis=(0, 2)) - body.radius - self.problem.robot_radius
        return nearest


def disc_centres(model: Model, states: FloatArray, discs: FloatArray) -> FloatArray:
    """Centres (..., n, d) of discs at offsets (n,) along the heading [m], for states (..., nx)."""
    centre = states[..., None, model.position]
    if model.heading is None:
        return centre
    theta = states[..., model.heading, None]
    ahead = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    body: FloatArray = centre + discs[:, None] * ahead
    return body


def drive(world: World, settings: Settings | None = None, seed: int = 0) -> Drive:
    """Drive through a world in closed loop; the same seed gives the same states, bit for bit."""
    problem = world.problem()
    mpc = MPC(problem, settings)
    bodies, look = world.begin(problem, seed)
    states, seconds = [world.start()], []
    references, predictions, plans = [], [], []
    for k in range(world.steps):
        x_ref, told = look(k, states[-1])
        began = perf_counter()
        plan = mpc.step(states[-1], x_ref, told)
        seconds.append(perf_counter() - began)
        states.append(problem.model.step(states[-1], plan.u0))
        references.append(x_ref)
        predictions.append(told)
        plans.append(plan)
    return Drive(
        problem,
        bodies,
        np.array(states),
        np.array([plan.u0 for plan in plans]),
        references,
        predictions,
        plans,
        np.array(seconds),
    )
