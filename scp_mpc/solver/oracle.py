"""Any QP solver that qpsolvers knows: a slow, obvious second opinion.

It sets the other solver up afresh at each call, which is right for tests and comparisons and too
slow for the loop, where `rescue.py` stands.
"""

import warnings
from time import perf_counter
from typing import Any

import numpy as np
import qpsolvers
from scipy import sparse

from scp_mpc.errors import InvalidArgumentError
from scp_mpc.solver.program import QuadraticProgram
from scp_mpc.solver.qp import QPSolution, QPStatus


class Oracle:
    """Solves a program from scratch with another solver and translates its multipliers.

    Args:
        solver: Name that `qpsolvers` gives the solver.
        options: Passed on to it.

    Raises:
        InvalidArgumentError: The solver is unknown or not installed.
    """

    def __init__(self, solver: str, **options: Any) -> None:
        """Check at construction that the solver is there."""
        if solver not in qpsolvers.available_solvers:
            there = ", ".join(qpsolvers.available_solvers)
            raise InvalidArgumentError("solver", f"{solver!r} is none of the installed: {there}")
        self._solver, self._options = solver, options
        self._dense = solver not in qpsolvers.sparse_solvers

    def solve(self, program: QuadraticProgram) -> QPSolution:
        """Solve `program`; rows with equal bounds become equations, infinite bounds vanish."""
        began = perf_counter()
        rows = program.A.tocsr()
        same = program.lower == program.upper
        above = np.flatnonzero(~same & np.isfinite(program.upper))
        below = np.flatnonzero(~same & np.isfinite(program.lower))
        equal = np.flatnonzero(same)
        problem = qpsolvers.Problem(
            self._matrix(program.P),
            program.q,
            self._matrix(sparse.vstack([rows[above], -rows[below]], format="csc")),
            np.concatenate([program.upper[above], -program.lower[below]]),
            self._matrix(rows[equal].tocsc()),
            program.lower[equal],
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the outcome is in `found`
            found = qpsolvers.solve_problem(problem, self._solver, **self._options)
        x, y = np.full(len(program.q), np.nan), np.full(len(program.lower), np.nan)
        status = QPStatus.FAILED
        if found.found and found.x is not None and found.y is not None and found.z is not None:
            status = QPStatus.SOLVED
            x, y = np.array(found.x), np.zeros(len(program.lower))
            y[equal] = found.y
            y[above] += found.z[: len(above)]
            y[below] -= found.z[len(above) :]
        return QPSolution(x, y, status, 0, perf_counter() - began, self._solver)

    def _matrix(self, matrix: sparse.csc_matrix) -> Any:
        return matrix.toarray() if self._dense else matrix
