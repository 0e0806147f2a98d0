"""The control steps of one closed-loop run, so that every solver gets the same problems."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.control.mpc import MPC
from scp_mpc.models.linear import LinearModel, as_linear
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.scp.iterate import Iterate
from scp_mpc.scp.solver import SCP
from scp_mpc.settings import Settings
from scp_mpc.simulation.crowds import Crowd
from scp_mpc.simulation.disturbance import Push
from scp_mpc.simulation.scenarios import Scenario


@dataclass(frozen=True, eq=False)
class RecordedStep:
    """What a solver was given at one control step.

    Attributes:
        x0: (nx,) state.
        x_ref: (N+1, nx) reference.
        obstacles: Predictions.
        guess: The controller's nominal before this step: its last plan, shifted. At the first
            step, the plan that ignores the obstacles.
    """

    x0: FloatArray
    x_ref: FloatArray
    obstacles: tuple[ObstaclePrediction, ...]
    guess: Iterate


def record(
    scenario: Scenario | Crowd,
    steps: int,
    seed: int = 0,
    problem: Problem | None = None,
    settings: Settings | None = None,
    advance: Callable[[], object] = lambda: None,
) -> list[RecordedStep]:
    """Run the controller in closed loop and keep what it solved.

    Args:
        scenario: What to run.
        steps: Number of control steps.
        seed: Seed of the scenario's disturbance, if it has one.
        problem: What to solve; the scenario's own if None.
        settings: How to solve it.
        advance: Called after each step, for a progress bar.
    """
    problem = scenario.problem() if problem is None else problem
    mpc = MPC(problem, settings)
    x, push = scenario.start(), _push(scenario, seed, as_linear("problem.model", problem.model))
    guess = SCP(problem, settings).solve(x, scenario.states(0)).iterate
    recorded = []
    for k in range(steps):
        x_ref, obstacles = scenario.states(k), tuple(scenario.predictions(k))
        recorded.append(RecordedStep(x, x_ref, obstacles, guess))
        plan = mpc.step(x, x_ref, obstacles)
        x = problem.model.step(x, plan.u0) + push(plan.u0)
        guess = plan.iterate.shifted(problem.model)
        advance()
    return recorded


def _push(scenario: Scenario | Crowd, seed: int, model: LinearModel) -> Push:
    if isinstance(scenario, Crowd) or scenario.disturbance is None:
        still = np.zeros(model.nx)
        return lambda _: still
    return scenario.disturbance.begin(model, scenario.generator(seed))
