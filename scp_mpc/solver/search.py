"""What both descents on the condensed problem share: linear robots' and nonlinear ones'."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import FloatArray, IntArray
from scp_mpc.settings import Settings
from scp_mpc.solver.active_set import CondensedProgram, Held
from scp_mpc.solver.certificate import Point
from scp_mpc.solver.condensed_step import CondensedStep, Yielding
from scp_mpc.solver.conflicts import Conflicts
from scp_mpc.solver.descent import Descent, hopeless
from scp_mpc.solver.iterate import NEGLIGIBLE
from scp_mpc.solver.sides import Passing, same_way

_ALIKE = 0.01  # relative difference of cost of plans that may become the same
SURPLUS = 0.01  # of the tolerance: worth one more iteration, whose convergence is quadratic
ROUNDING = 1e-9  # violation of a linearised constraint that is none


@dataclass(frozen=True, eq=False)
class End:
    """Where the descent about some pairs ended.

    Attributes:
        point: The plan, with its residuals.
        active: (nf + K,) its active set.
        cap: Largest force on a pair: finite where they may yield.
        iterations: Convex programs solved.
    """

    point: Point
    active: IntArray
    cap: float
    iterations: int


class Search(ABC):
    """Descends about some pairs of obstacle and point in one control step.

    Args:
        step: The control step.
        conflicts: The pairs; None for none.
        settings: How to solve.
        goal: Give up when it is plain that this plan will not be reached; None to go on.
    """

    def __init__(
        self,
        step: CondensedStep,
        conflicts: Conflicts | None,
        settings: Settings,
        goal: Descent | None = None,
    ) -> None:
        """Begin without slack: nothing may yield."""
        self._step, self._conflicts, self._goal = step, conflicts, goal
        self._tolerance = settings.tolerance
        self._yields = Yielding.NOBODY

    @abstractmethod
    def descend(
        self,
        y: FloatArray,
        active: IntArray,
        limit: int,
        began: float = 0.0,
        guess: FloatArray | None = None,
    ) -> End | None:
        """Descend from y (ny,), for at most `limit` programs; None if given up or unsolved.

        `began` is when the step's clock showed the work for the first one to begin; `guess` (N, nx)
        are deviations that the inputs in y may lead to.
        """

    @property
    def _cap(self) -> float:
        yields = self._yields is Yielding.EVERYBODY
        return self._step.problem.slack_weight if yields else np.inf

    def _solved(
        self, A: FloatArray, b: FloatArray, active: IntArray
    ) -> tuple[CondensedProgram, Held] | None:
        """Solve the convex program with half-spaces A v >= b.

        Where it has no solution, the states' bounds give way, from now on, and then the obstacles;
        these only if nobody else found a plan without slack.
        """
        step = self._step
        firm = self._conflicts is None or (self._goal is not None and self._goal.status.ok)
        for yields in step.ladder(firm):
            if yields < self._yields:
                continue
            if yields > self._yields and step.watch.remaining < 0:
                break  # it was the time that ran out
            program = self._program(A, b, yields)
            held = step.solve(program, active)
            if held is not None:
                self._yields = yields
                return program, held
        return None

    def _program(self, A: FloatArray, b: FloatArray, yields: Yielding) -> CondensedProgram:
        return self._step.program(A, b, yields)

    def _vain(self, iteration: int, point: Point, goal: Descent) -> bool:
        """Whether a descent is too far above the goal, or about to end just there."""
        if hopeless(iteration, point.cost, goal):
            return True
        conflicts, pushed = self._conflicts, point.pushed
        if conflicts is None or pushed is None:
            return False
        if abs(point.cost - goal.cost) > _ALIKE * goal.cost:
            return False
        count = self._step.data.count
        sampling, other = self._step.data.sampling, goal.iterate
        pushes = conflicts.table(pushed.force > NEGLIGIBLE, count, sampling.points)
        mine = Passing(self._step.path(point.y)[1:], pushes)
        theirs = sampling.positions(other.states, other.inputs)
        return same_way(self._step.data, mine, Passing(theirs, other.touched[:count]))
