"""The report's four scenarios as named, seeded data that everything else shares."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.control.reference import CircularReference
from scp_mpc.geometry.margin import MarginSpec
from scp_mpc.models.double_integrator import DoubleIntegrator
from scp_mpc.obstacles.circular import CircularObstacle
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.obstacles.predictors import Predictor, ReportPredictor
from scp_mpc.problem import Problem
from scp_mpc.simulation.disturbance import CorrelatedDisturbance, Disturbance

DT = 0.2  # [s]
STEPS = 600  # 120 s


@dataclass(frozen=True)
class Scenario:
    """One experiment: who moves how, over which horizon, and what disturbs the robot.

    Attributes:
        name: Key in `SCENARIOS`.
        title: What the report calls it.
        horizon: N.
        disturbance: What acts on the robot, unknown to the controller; None for nothing.
        obstacle: True motion of the obstacle.
        predictor: What the controller makes of it.
        reference: What the robot is to track.
    """

    name: str
    title: str
    horizon: int
    disturbance: Disturbance | None = None
    obstacle: CircularObstacle = field(default_factory=CircularObstacle)
    predictor: Predictor = field(default_factory=ReportPredictor)
    reference: CircularReference = field(default_factory=CircularReference)

    def problem(
        self,
        inflation: Literal["exact", "axes"] = "axes",
        margin: MarginSpec | None = None,
        nodes_per_interval: int = 1,
    ) -> Problem:
        """The report's problem (III.A, III.E), with s_min = s_ref and samples only, as printed."""
        return Problem(
            model=DoubleIntegrator(dt=DT, dim=2),
            horizon=self.horizon,
            Q=[0.2, 0.05, 0.2, 0.05],
            R=[0.001, 0.001],
            u_min=-3.0,
            u_max=3.0,
            robot_radius=0.15,
            margin=margin,
            inflation=inflation,
            max_obstacles=1,
            nodes_per_interval=nodes_per_interval,
        )

    def start(self) -> FloatArray:
        """State (4,) on the reference at time 0: [8, 0, 0, 4.16]."""
        return self.states(0)[0]

    def states(self, step: int) -> FloatArray:
        """Reference (N+1, 4) from a step on."""
        return self.reference.states(step * DT, self.horizon, DT)

    def prediction(self, step: int) -> ObstaclePrediction:
        """What the controller is told about the obstacle at a step."""
        time = step * DT
        position, velocity = self.obstacle.position(time), self.obstacle.velocity(time)
        return self.predictor.predict(position, velocity, self.obstacle.radius, self.horizon, DT)

    def predictions(self, step: int) -> list[ObstaclePrediction]:
        """The same, as what `MPC.step` takes."""
        return [self.prediction(step)]

    def generator(self, seed: int) -> np.random.Generator:
        """A generator of its own for each scenario, so that none depends on the others' order."""
        return np.random.default_rng([seed, *self.name.encode()])


SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        Scenario("scenario-1", "Perfect model", horizon=30),
        Scenario("scenario-2", "Reduced horizon", horizon=8),
        Scenario(
            "scenario-3",
            "Correlated noise, reduced horizon",
            horizon=8,
            disturbance=CorrelatedDisturbance(),
        ),
        Scenario(
            "scenario-4",
            "Correlated noise, long horizon",
            horizon=30,
            disturbance=CorrelatedDisturbance(),
        ),
    )
}
