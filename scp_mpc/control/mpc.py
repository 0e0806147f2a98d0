"""Model predictive control: the solver with a memory of its last plan."""

from collections.abc import Sequence

from numpy.typing import ArrayLike

from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.settings import Settings
from scp_mpc.solver.iterate import Iterate
from scp_mpc.solver.plan import Plan
from scp_mpc.solver.scp import SCP


class MPC:
    """Receding-horizon controller: each step starts from the last plan, shifted by one stage.

    Args:
        problem: What to solve at each step.
        settings: How to solve it.
    """

    def __init__(self, problem: Problem, settings: Settings | None = None) -> None:
        """Set up the solver; there is no plan yet."""
        self._solver = SCP(problem, settings)
        self._last: Iterate | None = None
        self._steps_touching = 0

    @property
    def problem(self) -> Problem:
        """The problem solved at each step."""
        return self._solver.problem

    @property
    def settings(self) -> Settings:
        """The solver's settings."""
        return self._solver.settings

    def nominal(self) -> Iterate | None:
        """The guess from which the next step starts; None before the first step."""
        return None if self._last is None else self._shifted()

    def step(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction] = (),
    ) -> Plan:
        """Return the plan for this control step; apply `plan.u0`.

        Args:
            x0: (nx,) state now.
            x_ref: (N+1, nx) reference, or (nx,) to be held; row 0 is not weighted.
            obstacles: At most `max_obstacles` predictions over the same horizon.

        Raises:
            InvalidArgumentError: Or one of its subclasses. The controller is then as before.
        """
        challenge = self._steps_touching % self.settings.sides_interval == 0
        shifted = None if self._last is None else self._shifted
        plan = self._solver.solve_from(x0, x_ref, obstacles, shifted, challenge)
        self._last = plan.iterate
        self._steps_touching = self._steps_touching + 1 if plan.iterate.touches else 0
        return plan

    def _shifted(self) -> Iterate:
        assert self._last is not None
        return self._last.shifted(self.problem.model)

    def reset(self) -> None:
        """Forget the last plan: the next step is bit for bit that of a new controller."""
        self._last = None
        self._steps_touching = 0
