"""The report's four scenarios as named, seeded scenes that everything else shares."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.control.mpc import MPC
from scp_mpc.control.reference import CircularReference
from scp_mpc.geometry.margin import MarginSpec
from scp_mpc.models.double_integrator import DoubleIntegrator
from scp_mpc.obstacles.circular import CircularObstacle
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.obstacles.predictors import Predictor, ReportPredictor
from scp_mpc.problem import Problem
from scp_mpc.settings import Settings
from scp_mpc.simulation.disturbance import CorrelatedDisturbance, Disturbance
from scp_mpc.simulation.plant import ModelPlant
from scp_mpc.simulation.run import Run
from scp_mpc.simulation.scene import Body, Scene
from scp_mpc.simulation.simulate import Controller, simulate

DT = 0.2  # [s]
STEPS = 600  # 120 s


@dataclass(frozen=True)
class Scenario(Scene):
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
        return self.x_ref(0.0)[0]

    @cached_property
    def bodies(self) -> tuple[Body, ...]:
        """The obstacle."""
        return (Body(self.obstacle.position, self.obstacle.radius),)

    def x_ref(self, time: float, x: FloatArray | None = None) -> FloatArray:  # noqa: ARG002
        """Reference (N+1, 4) from a time on, wherever the robot is."""
        return self.reference.states(time, self.horizon, DT)

    def predictions(self, time: float, dt: float, horizon: int) -> list[ObstaclePrediction]:
        """What the predictor makes of the obstacle's position and velocity at a time."""
        o = self.obstacle
        return [self.predictor.predict(o.position(time), o.velocity(time), o.radius, horizon, dt)]

    def run(
        self,
        controller: Controller | None = None,
        steps: int = STEPS,
        seed: int = 0,
        advance: Callable[[], object] = lambda: None,
    ) -> Run:
        """Run the closed loop of III.F; the same seed gives the same states, bit for bit.

        Args:
            controller: What plans; `MPC` without a deadline if None.
            steps: Number of control steps K.
            seed: Seed of the disturbance.
            advance: Called after each step, for a progress bar.
        """
        if controller is None:
            controller = MPC(self.problem(), Settings(deadline=None))
        plant, rng = ModelPlant(controller.problem.model, self.disturbance), self.generator(seed)
        run = simulate(controller, self, plant=plant, steps=steps, seed=rng, advance=advance)
        return replace(run, seed=seed)

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
