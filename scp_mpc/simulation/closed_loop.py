"""The closed loop of III.F: measure, predict, solve, apply, disturb."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray
from scp_mpc.control.mpc import MPC
from scp_mpc.geometry.no_go import NoGoSets
from scp_mpc.models.linear import as_linear
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.scp.plan import Plan
from scp_mpc.settings import Settings
from scp_mpc.simulation.disturbance import Push
from scp_mpc.simulation.scenarios import DT, STEPS, Scenario


class Controller(Protocol):
    """What plans at each step: `MPC`, or something around it."""

    @property
    def settings(self) -> Settings:
        """How it plans."""
        ...

    def step(
        self, y: ArrayLike, x_ref: ArrayLike, obstacles: Sequence[ObstaclePrediction], /
    ) -> Plan:
        """Return the plan for this control step."""
        ...


@dataclass(frozen=True, eq=False)
class ClosedLoop:
    """A finished run, K steps long.

    Attributes:
        scenario: What was run.
        problem: What was solved at each step.
        settings: How it was solved.
        seed: Seed of the disturbance.
        states: (K+1, nx) true states.
        inputs: (K, nu) applied inputs.
        reference: (K+1, nx) reference states.
        obstacle: (K+1, 2) true positions of the obstacle [m].
        predictions: K predictions, one per step.
        plans: K plans, one per step.
        seconds: (K,) wall time of each call of `MPC.step`.
    """

    scenario: Scenario
    problem: Problem
    settings: Settings
    seed: int
    states: FloatArray
    inputs: FloatArray
    reference: FloatArray
    obstacle: FloatArray
    predictions: list[ObstaclePrediction]
    plans: list[Plan]
    seconds: FloatArray

    @property
    def steps(self) -> int:
        """Number of control steps K."""
        return len(self.plans)

    @property
    def times(self) -> FloatArray:
        """(K+1,) [s]."""
        return DT * np.arange(self.steps + 1, dtype=np.float64)

    @property
    def positions(self) -> FloatArray:
        """(K+1, 2) true positions of the robot [m]."""
        return self.states[:, self.problem.model.position]

    @property
    def tracking_errors(self) -> FloatArray:
        """(K+1,) distance from the reference position of the same time [m]."""
        error = (self.states - self.reference)[:, self.problem.model.position]
        return np.linalg.norm(error, axis=1)

    @property
    def distances(self) -> FloatArray:
        """(K+1,) distance between the true centres of robot and obstacle [m]."""
        return np.linalg.norm(self.positions - self.obstacle, axis=1)

    @property
    def clearances(self) -> FloatArray:
        """(K,) signed distance to the no-go set of each step at s = s_ref [m]."""
        problem = self.problem
        return np.array(
            [
                problem.no_go.clearance(NoGoSets.now([o], problem.robot_radius), p[None])[0, 0]
                for o, p in zip(self.predictions, self.positions, strict=False)
            ]
        )


def simulate(
    scenario: Scenario,
    problem: Problem | None = None,
    settings: Settings | None = None,
    steps: int = STEPS,
    seed: int = 0,
    advance: Callable[[], object] = lambda: None,
    controller: Callable[[Problem, Settings | None], Controller] = MPC,
) -> ClosedLoop:
    """Run a scenario in closed loop; the same seed gives the same states, bit for bit.

    Args:
        scenario: What to run.
        problem: What to solve; the scenario's own if None.
        settings: How to solve it.
        steps: Number of control steps K.
        seed: Seed of the disturbance.
        advance: Called after each step, for a progress bar.
        controller: What makes a controller of problem and settings.
    """
    problem = scenario.problem() if problem is None else problem
    mpc = controller(problem, settings)
    rng = scenario.generator(seed)
    still = np.zeros(problem.model.nx)
    wind = scenario.disturbance
    push: Push = lambda _: still  # noqa: E731
    if wind is not None:
        push = wind.begin(as_linear("problem.model", problem.model), rng)
    states, plans, predictions, seconds = [scenario.start()], [], [], []
    for k in range(steps):
        prediction = scenario.prediction(k)
        reference = scenario.states(k)
        began = perf_counter()
        plan = mpc.step(states[-1], reference, [prediction])
        seconds.append(perf_counter() - began)
        states.append(problem.model.step(states[-1], plan.u0) + push(plan.u0))
        plans.append(plan)
        predictions.append(prediction)
        advance()
    return ClosedLoop(
        scenario=scenario,
        problem=problem,
        settings=mpc.settings,
        seed=seed,
        states=np.array(states),
        inputs=np.array([plan.u0 for plan in plans]),
        reference=np.array([scenario.states(k)[0] for k in range(steps + 1)]),
        obstacle=np.array([scenario.obstacle.position(k * DT) for k in range(steps + 1)]),
        predictions=predictions,
        plans=plans,
        seconds=np.array(seconds),
    )
