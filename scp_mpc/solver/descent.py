"""Where one run of the sequential convex programming ended."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

from scp_mpc.solver.iterate import Iterate
from scp_mpc.solver.plan import Status
from scp_mpc.solver.program import KKTResiduals


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


def judge(residuals: KKTResiduals, slack: float, tolerance: float) -> Status:
    """Return the status of a plan with the given residuals and largest slack [m]."""
    inside = max(residuals.feasibility, slack) > tolerance
    if residuals.worst <= tolerance:
        return Status.SOFTENED if inside else Status.CONVERGED
    return Status.VIOLATING if inside else Status.FEASIBLE
