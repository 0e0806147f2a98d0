"""A finished run: what happened, and how close the robot came to what.

Between two control steps the robot follows its model with the input held, and bodies go straight;
both are looked at `FINE` + 1 times in each interval.

Notation:
    K   control steps       M   bodies      d   dimension of the workspace
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from scp_mpc.arrays import BoolArray, FloatArray
from scp_mpc.geometry.polytopes import Polytopes
from scp_mpc.models.model import Model
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.scp.plan import Plan
from scp_mpc.settings import Settings
from scp_mpc.simulation.contact import FINE
from scp_mpc.simulation.scene import Body, Scene


@dataclass(frozen=True, eq=False)
class Run:
    """A finished run, K control steps long.

    Attributes:
        scene: What was driven through.
        problem: What was solved at each step.
        settings: How it was solved.
        seed: What the noise was drawn with; None for a generator of the caller's.
        version: Of the library.
        states: (K+1, nx) true states.
        measured: (K, nx) states as the controller was told.
        inputs: (K, nu) applied.
        references: K references, (nx,) or (N+1, nx).
        bodies: (K+1, M, d) true positions [m], NaN where absent.
        predictions: K lists of what the controller was told.
        plans: K plans.
        sensing: (K,) wall time of the sensor [s].
        seconds: (K,) wall time of the controller [s].
    """

    scene: Scene
    problem: Problem
    settings: Settings
    seed: int | None
    version: str
    states: FloatArray
    measured: FloatArray
    inputs: FloatArray
    references: list[FloatArray]
    bodies: FloatArray
    predictions: list[list[ObstaclePrediction]]
    plans: list[Plan]
    sensing: FloatArray
    seconds: FloatArray

    @property
    def steps(self) -> int:
        """Number of control steps K."""
        return len(self.plans)

    @property
    def times(self) -> FloatArray:
        """(K+1,) [s]."""
        return self.problem.model.dt * np.arange(self.steps + 1, dtype=np.float64)

    @property
    def positions(self) -> FloatArray:
        """(K+1, d) of the robot [m]."""
        return self.states[:, self.problem.model.position]

    @property
    def ok(self) -> BoolArray:
        """(K,) whether each plan was."""
        return np.array([plan.ok for plan in self.plans], dtype=np.bool_)

    @property
    def tracking_errors(self) -> FloatArray:
        """(K,) distances from the reference position of the same time [m]."""
        place = self.problem.model.position
        asked = np.array([np.atleast_2d(x_ref)[0] for x_ref in self.references])
        return np.linalg.norm((self.states[:-1] - asked)[:, place], axis=1)

    @cached_property
    def clearances(self) -> FloatArray:
        """(K, M) smallest true distance of robot and body within each interval [m].

        Negative where they overlap; infinite where the body is absent at either end.
        """
        least = [self.gaps(body).min(axis=0) for body in range(len(self.scene.bodies))]
        return np.array(least).T.reshape(self.steps, -1)

    def gaps(self, body: int) -> FloatArray:
        """(FINE+1, K) true distances of robot and one body within each interval [m].

        Infinite where it is absent at either end.
        """
        what, share = self.scene.bodies[body], np.linspace(0.0, 1.0, FINE + 1)[:, None, None]
        begin, end = self.bodies[:-1, body], self.bodies[1:, body]
        there = ~np.isnan(begin + end).any(axis=1)
        way = begin[there] + share * (end - begin)[there]
        discs = disc_centres(self.problem.model, self._within[:, there], self.problem.discs)
        nearest = separation(what, discs - way[:, :, None])[0].min(axis=2)
        gaps = np.full((FINE + 1, self.steps), np.inf)
        gaps[:, there] = nearest - what.radius - self.problem.robot_radius
        return gaps

    @cached_property
    def path(self) -> FloatArray:
        """(FINE+1, K, d) positions of the robot within each interval [m]."""
        return self._within[..., self.problem.model.position]

    @cached_property
    def _within(self) -> FloatArray:
        """(FINE+1, K, nx) states within each interval; what pushes the robot acts at its end."""
        share = np.linspace(0.0, 1.0, FINE + 1)[:, None]
        states = self.problem.model.advance(self.states[None, :-1], self.inputs[None], share)
        states[-1] = self.states[1:]
        return states


def separation(body: Body, away: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances (...) from a body without its radius [m], and unit normals (..., d) off it.

    Args:
        body: Any.
        away: (..., d) points less the body's position [m].
    """
    if body.shape is None:
        distance = np.linalg.norm(away, axis=-1)
        return distance, away / np.maximum(distance, 1e-12)[..., None]
    still = ObstaclePrediction.static(1, np.zeros(away.shape[-1]), 0.0, shape=body.shape)
    shapes = Polytopes.of([still])
    assert shapes is not None
    nearest = shapes.nearest(away.reshape(1, -1, away.shape[-1]))
    return nearest.distance.reshape(away.shape[:-1]), nearest.normal.reshape(away.shape)


def disc_centres(model: Model, states: FloatArray, discs: FloatArray) -> FloatArray:
    """Centres (..., n, d) of discs at offsets (n,) along the heading [m], for states (..., nx)."""
    centre = states[..., None, model.position]
    if model.heading is None:
        return centre
    theta = states[..., model.heading, None]
    ahead = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
    body: FloatArray = centre + discs[:, None] * ahead
    return body
