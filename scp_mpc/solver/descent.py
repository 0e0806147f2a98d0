"""Where one run of the sequential convex programming ended."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

from scp_mpc.arrays import BoolArray, FloatArray
from scp_mpc.solver.iterate import Iterate
from scp_mpc.solver.plan import Status
from scp_mpc.solver.program import KKTResiduals

_PATIENCE = 3  # iterations before a rival is given up
_FAR = 1.1  # share of the goal's merit above which it is


@dataclass(frozen=True, eq=False)
class Descent:
    """A plan with its certificate.

    Attributes:
        make: Makes the iterate; most rivals are never asked for theirs.
        cost: Objective, slack not included.
        merit: Cost and the penalty on the slack.
        residuals: KKT residuals of the original problem.
        status: How it ended.
        iterations: Convex subproblems solved.
    """

    make: Callable[[], Iterate]
    cost: float
    merit: float
    residuals: KKTResiduals
    status: Status
    iterations: int

    @cached_property
    def iterate(self) -> Iterate:
        """The primal-dual point."""
        return self.make()

    def beats(self, other: "Descent", lead: float) -> bool:
        """Whether this end is safe and the other is not, or its merit is better by `lead`."""
        if self.status.ok != other.status.ok:
            return self.status.ok
        return self.merit < other.merit - lead


@dataclass(frozen=True, eq=False)
class Glimpse:
    """What one program about a path leads to.

    Attributes:
        merit: Cost and penalty on the slack; infinite if there is no solution without slack.
        touched: (J, C) which obstacles push it, at which points.
        path: (C, d) its positions.
        make: Makes the iterate.
    """

    merit: float
    touched: BoolArray
    path: FloatArray
    make: Callable[[], Iterate]

    @cached_property
    def iterate(self) -> Iterate:
        """Where to descend from."""
        return self.make()


def hopeless(iterations: int, merit: float, goal: Descent) -> bool:
    """Whether a descent is so far above a goal, after so many iterations, that it will not beat it.

    The cost falls from one subproblem to the next, by less each time.
    """
    return goal.status.ok and iterations >= _PATIENCE and merit > _FAR * goal.merit


def judge(residuals: KKTResiduals, slack: float, tolerance: float) -> Status:
    """Return the status of a plan with the given residuals and largest slack [m]."""
    inside = not (residuals.feasibility <= tolerance and slack <= tolerance)  # or NaN
    if residuals.worst <= tolerance and slack == slack:
        return Status.SOFTENED if inside else Status.CONVERGED
    return Status.VIOLATING if inside else Status.FEASIBLE
