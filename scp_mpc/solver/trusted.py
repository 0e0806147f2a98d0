"""A quadratic program's solution that can be trusted: OSQP, checked, else the rescue solver."""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.settings import QPSettings
from scp_mpc.solver.program import KKTResiduals, QuadraticProgram
from scp_mpc.solver.qp import OSQPSolver, QPSolution
from scp_mpc.solver.rescue import RescueSolver
from scp_mpc.solver.stopwatch import Lap

_USABLE = 1e-3  # KKT residual beyond which a point is no solution


class TrustedSolver:
    """Returns only points that check out against the program's own data.

    A point at the wanted accuracy ends the search. Where nobody gets there, a feasible one that is
    nearly optimal is better than none: the certificate of the original problem tells them apart.

    Attributes:
        finished: How many programs each solver finished since `reset_counts`.
    """

    def __init__(self, program: QuadraticProgram, settings: QPSettings) -> None:
        """Set up OSQP for the pattern of `program`, whose values are read at each solve."""
        self._program = program
        self._accuracy, self._cold = settings.accuracy, settings.cold
        self._osqp = OSQPSolver(program, settings)
        self._rescue = None if not settings.rescue else RescueSolver(program)
        self.finished: Counter[str] = Counter()

    def solve(
        self, x: FloatArray, y: FloatArray, residual: float = 0.0, lap: Lap | None = None
    ) -> QPSolution | None:
        """Solve the program as it stands, warm-started at x and y; None if nobody could.

        Args:
            x: (n,) start.
            y: (m,) its multipliers.
            residual: KKT residual of the start; a bad one is left to the rescue at once.
            lap: Adds up the seconds spent in the solvers.
        """
        best, best_residual = None, _USABLE
        for solution in self._attempts(x, y, residual > self._cold):
            if lap is not None:
                lap.seconds += solution.seconds
            residuals = self._residuals(solution)
            if residuals.feasibility <= self._accuracy and residuals.worst < best_residual:
                best, best_residual = solution, residuals.worst
            if best_residual <= self._accuracy:
                break
        if best is not None:
            self.finished[best.solver] += 1
        return best

    def reset(self) -> None:
        """Forget everything that earlier programs left behind."""
        self._osqp.reset()

    def reset_counts(self) -> None:
        """Start counting programs anew."""
        self.finished = Counter()

    def _attempts(self, x: FloatArray, y: FloatArray, cold: bool) -> Iterator[QPSolution]:
        if cold and self._rescue is not None:
            yield self._rescue.solve()
        program = self._program
        self._osqp.update(program.q, program.A.data, program.lower, program.upper)
        yield self._osqp.solve(x, y)
        if not cold and self._rescue is not None:
            yield self._rescue.solve()

    def _residuals(self, solution: QPSolution) -> KKTResiduals:
        if not solution.has_point:
            return KKTResiduals(np.inf, np.inf, np.inf)
        return self._program.residuals(solution.x, solution.y)
