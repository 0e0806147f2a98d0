"""The control steps of one closed-loop run, so that every solver gets the same problems."""

from collections.abc import Callable
from dataclasses import dataclass

from scp_mpc.arrays import FloatArray
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.settings import Settings
from scp_mpc.simulation.closed_loop import simulate
from scp_mpc.simulation.scenarios import Scenario
from scp_mpc.solver.iterate import Iterate
from scp_mpc.solver.scp import SCP


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
    scenario: Scenario,
    steps: int,
    seed: int = 0,
    problem: Problem | None = None,
    settings: Settings | None = None,
    advance: Callable[[], object] = lambda: None,
) -> list[RecordedStep]:
    """Run the controller in closed loop and keep what it solved; arguments as for `simulate`."""
    run = simulate(scenario, problem, settings, steps, seed, advance)
    first = SCP(run.problem, settings).solve(run.states[0], scenario.states(0))
    guesses = [first.iterate] + [plan.iterate.shifted(run.problem.model) for plan in run.plans]
    return [
        RecordedStep(x0, scenario.states(k), (obstacle,), guess)
        for k, (x0, obstacle, guess) in enumerate(
            zip(run.states, run.predictions, guesses, strict=False)
        )
    ]
