"""The control steps of one closed-loop run, so that every solver gets the same problems."""

from collections.abc import Callable
from dataclasses import dataclass

from scp_mpc.arrays import FloatArray
from scp_mpc.control.mpc import MPC
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.scp.iterate import Iterate
from scp_mpc.scp.solver import SCP
from scp_mpc.settings import Settings
from scp_mpc.simulation.crowds import Crowd
from scp_mpc.simulation.scenarios import Scenario
from scp_mpc.simulation.simulate import simulate


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
    mpc = MPC(problem, Settings(deadline=None) if settings is None else settings)
    if isinstance(scenario, Crowd):
        run = simulate(mpc, scenario, steps=steps, advance=advance)
    else:
        run = scenario.run(mpc, steps, seed, advance)
    first = SCP(problem, settings).solve(run.states[0], run.references[0]).iterate
    guesses = [first, *(plan.iterate.shifted(problem.model) for plan in run.plans[:-1])]
    given = zip(run.states[:-1], run.references, run.predictions, guesses, strict=True)
    return [RecordedStep(x, x_ref, tuple(told), guess) for x, x_ref, told, guess in given]
