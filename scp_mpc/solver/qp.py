"""OSQP behind one guarded class: the only file that imports it.

OSQP 1.1 accepts wrong lengths, crossed bounds and strided arrays without a word and then solves
something else; NaN stays in its iterates; an infeasible program returns 2143289344.0. This class
checks what goes in, branches on the status of what comes out, and knows nothing of control.
"""

from dataclasses import dataclass
from enum import Enum
from time import perf_counter

import numpy as np
import osqp
from numpy.typing import ArrayLike
from scipy import sparse

from scp_mpc.arrays import FloatArray
from scp_mpc.errors import BoundsError, NotFiniteError, ShapeError
from scp_mpc.settings import QPSettings
from scp_mpc.solver.program import QuadraticProgram

_INFINITY = 1e30  # OSQP's own


class QPStatus(Enum):
    """How a solver left a quadratic program."""

    SOLVED = "the solver's own criteria were met"
    INFEASIBLE = "the solver found a certificate of infeasibility"
    UNFINISHED = "the iterations ran out"
    FAILED = "the solver broke down"


@dataclass(frozen=True, eq=False)
class QPSolution:
    """A point, its multipliers, and where they come from. NaN unless there is a point."""

    x: FloatArray
    y: FloatArray
    status: QPStatus
    iterations: int
    seconds: float
    solver: str

    @property
    def has_point(self) -> bool:
        """Whether x and y hold finite numbers that belong to this program."""
        return self.status in (QPStatus.SOLVED, QPStatus.UNFINISHED)


class OSQPSolver:
    """Sets OSQP up once for a program's pattern; later calls only rewrite values.

    One variable beyond the program's, fixed to 1 at a cost of -1, keeps a constraint active:
    without any, OSQP's polish writes to standard output even when told to be quiet.
    """

    def __init__(self, program: QuadraticProgram, settings: QPSettings) -> None:
        """Check the program and set up OSQP on copies of it."""
        self._n, self._m = len(program.q), len(program.lower)
        self._nnz = program.A.nnz
        self._settings = settings
        _check(program.q, "q", self._n)
        _check(program.A.data, "A", self._nnz)
        _check_bounds(program.lower, program.upper, self._m)
        anchor = sparse.csc_matrix([[1.0]])
        A = sparse.block_diag([program.A, anchor], format="csc")
        if A.nnz != self._nnz + 1:
            raise ShapeError("A", f"{self._nnz} stored entries became {A.nnz - 1}")
        self._first = {
            "P": sparse.block_diag([sparse.triu(program.P), 0 * anchor], format="csc"),
            "q": np.append(program.q, -1.0),
            "A": A,
            "l": np.append(np.maximum(program.lower, -_INFINITY), 1.0),
            "u": np.append(np.minimum(program.upper, _INFINITY), 1.0),
        }
        self.reset()

    def reset(self) -> None:
        """Return to the state after construction, bit for bit; call `update` next.

        Only a new set-up does: OSQP rescales its copies of P and A in place at every update.
        """
        settings = self._settings
        self._solver = osqp.OSQP(algebra="builtin")
        self._solver.setup(
            **{name: value.copy() for name, value in self._first.items()},
            verbose=False,
            polishing=True,
            rho=settings.rho,
            eps_abs=settings.eps,
            eps_rel=settings.eps,
            eps_prim_inf=1e-9,  # the default calls feasible programs infeasible
            eps_dual_inf=1e-9,
            scaling=2,  # every pass costs at every update; ten make no program easier here
            max_iter=settings.max_iterations,
            check_termination=settings.check_interval,
        )

    def update(self, q: ArrayLike, A_data: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> None:
        """Rewrite all values; the pattern stays. Nothing changes if anything is wrong.

        Raises:
            ShapeError: A vector has the wrong length.
            NotFiniteError: q or A_data holds NaN or infinity, or a bound holds NaN.
            BoundsError: A lower bound exceeds its upper bound.
        """
        q, A_data, lower, upper = (_contiguous(v) for v in (q, A_data, lower, upper))
        _check(q, "q", self._n)
        _check(A_data, "A_data", self._nnz)
        _check_bounds(lower, upper, self._m)
        self._solver.update(
            q=np.append(q, -1.0),
            l=np.append(np.maximum(lower, -_INFINITY), 1.0),
            u=np.append(np.minimum(upper, _INFINITY), 1.0),
            Ax=np.append(A_data, 1.0),
        )

    def solve(self, x: ArrayLike | None = None, y: ArrayLike | None = None) -> QPSolution:
        """Solve from the given point and multipliers, or from where the last solve ended."""
        if x is not None and y is not None:
            self.warm_start(x, y)
        began = perf_counter()
        result = self._solver.solve(raise_error=False)
        seconds = perf_counter() - began
        status = _status(result.info.status_val)
        solution = QPSolution(
            np.array(result.x[: self._n]),
            np.array(result.y[: self._m]),
            status,
            int(result.info.iter),
            seconds,
            "osqp",
        )
        finite = np.isfinite(solution.x).all() and np.isfinite(solution.y).all()
        if solution.has_point and finite:
            return solution
        self._forget()
        nothing = np.full(self._n, np.nan), np.full(self._m, np.nan)
        status = QPStatus.FAILED if solution.has_point else status
        return QPSolution(*nothing, status, solution.iterations, seconds, "osqp")

    def warm_start(self, x: ArrayLike, y: ArrayLike) -> None:
        """Start the next solve from x (n,) and y (m,); call it after `update`.

        Raises:
            ShapeError: Wrong length.
            NotFiniteError: NaN or infinity, which OSQP would keep for ever.
        """
        x, y = _contiguous(x), _contiguous(y)
        _check(x, "x", self._n)
        _check(y, "y", self._m)
        self._solver.warm_start(x=np.append(x, 1.0), y=np.append(y, 1.0))

    def _forget(self) -> None:
        """Drop the iterates and the adapted step size, which a failed solve may have spoilt."""
        self._solver.update_settings(rho=self._settings.rho)
        self._solver.warm_start(x=np.zeros(self._n + 1), y=np.zeros(self._m + 1))


def _status(value: int) -> QPStatus:
    codes = osqp.SolverStatus
    if value in (codes.OSQP_SOLVED, codes.OSQP_SOLVED_INACCURATE):
        return QPStatus.SOLVED
    if value == codes.OSQP_MAX_ITER_REACHED:
        return QPStatus.UNFINISHED
    if value in (codes.OSQP_PRIMAL_INFEASIBLE, codes.OSQP_PRIMAL_INFEASIBLE_INACCURATE):
        return QPStatus.INFEASIBLE
    return QPStatus.FAILED


def _contiguous(value: ArrayLike) -> FloatArray:
    return np.ascontiguousarray(value, dtype=np.float64)


def _check(vector: FloatArray, argument: str, size: int) -> None:
    if vector.shape != (size,):
        raise ShapeError(argument, f"shape {vector.shape} is not ({size},)")
    if not np.isfinite(vector).all():
        at = int(np.argmin(np.isfinite(vector)))
        raise NotFiniteError(argument, f"{vector[at]} at index {at} is not finite")


def _check_bounds(lower: FloatArray, upper: FloatArray, size: int) -> None:
    for argument, vector in (("lower", lower), ("upper", upper)):
        if vector.shape != (size,):
            raise ShapeError(argument, f"shape {vector.shape} is not ({size},)")
        if np.isnan(vector).any():
            raise NotFiniteError(argument, f"NaN at index {int(np.argmax(np.isnan(vector)))}")
    if (lower > upper).any():
        at = int(np.argmax(lower > upper))
        raise BoundsError("lower", f"{lower[at]} exceeds upper = {upper[at]} at row {at}")
