"""The rescue: an interior-point solver for the few programs that OSQP does not finish.

Active-set changes cost ADMM hundreds to thousands of iterations; an interior-point method needs
ten, whatever changed. It starts cold and goes through `qpsolvers`, which sets it up afresh.
"""

from time import perf_counter

import numpy as np
import qpsolvers
from scipy import sparse

from scp_mpc.errors import InvalidArgumentError
from scp_mpc.settings import QPSettings
from scp_mpc.solver.program import QuadraticProgram
from scp_mpc.solver.qp import QPSolution, QPStatus

_PRECISION = 1e-12
_OPTIONS: dict[str, dict[str, float]] = {
    "piqp": dict.fromkeys(
        ("eps_abs", "eps_rel", "eps_duality_gap_abs", "eps_duality_gap_rel"), _PRECISION
    ),
    "clarabel": dict.fromkeys(("tol_gap_abs", "tol_gap_rel", "tol_feas"), _PRECISION),
}


class RescueSolver:
    """Solves a program from scratch with another solver and translates its multipliers.

    Raises:
        InvalidArgumentError: The solver is unknown or not installed.
    """

    def __init__(self, settings: QPSettings) -> None:
        """Check at construction that the solver is there, not in the middle of a drive."""
        name = settings.rescue
        if name not in _OPTIONS or name not in qpsolvers.sparse_solvers:
            there = ", ".join(s for s in _OPTIONS if s in qpsolvers.sparse_solvers)
            raise InvalidArgumentError("qp.rescue", f"{name!r} is none of the installed: {there}")
        self._name = name

    def solve(self, program: QuadraticProgram) -> QPSolution:
        """Solve `program`; rows with equal bounds become equations, infinite bounds vanish."""
        began = perf_counter()
        rows = program.A.tocsr()
        equal = program.lower == program.upper
        above = np.flatnonzero(~equal & np.isfinite(program.upper))
        below = np.flatnonzero(~equal & np.isfinite(program.lower))
        equal = np.flatnonzero(equal)
        problem = qpsolvers.Problem(
            program.P,
            program.q,
            sparse.vstack([rows[above], -rows[below]], format="csc"),
            np.concatenate([program.upper[above], -program.lower[below]]),
            rows[equal].tocsc(),
            program.lower[equal],
        )
        found = qpsolvers.solve_problem(problem, self._name, **_OPTIONS[self._name])
        x, y = np.full(len(program.q), np.nan), np.full(len(program.lower), np.nan)
        status = QPStatus.FAILED
        if found.found and found.x is not None and found.y is not None and found.z is not None:
            status = QPStatus.SOLVED
            x, y = np.array(found.x), np.zeros(len(program.lower))
            y[equal] = found.y
            y[above] += found.z[: len(above)]
            y[below] -= found.z[len(above) :]
        return QPSolution(x, y, status, 0, perf_counter() - began, self._name)
