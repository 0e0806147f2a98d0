"""OSQP, the solver of the programs by default: the only file that imports osqp.

ADMM is asked for the active set, not for digits: a fixed number of iterations from a warm start,
no tests for termination, no adaptation. What makes that quick is the scaling, done by hand here:
variables in units in which the Hessian's diagonal is one, and rows of length one. OSQP (Stellato,
Banjac, Goulart, Bemporad and Boyd, 2020) prints, or goes on with old data, where it is given
nonsense; so what goes in is checked, and what comes out is looked at by status first.
"""

import numpy as np
import osqp
from scipy import sparse

from scp_mpc.arrays import FloatArray, IntArray
from scp_mpc.errors import BoundsError, NotFiniteError
from scp_mpc.qp.program import Backend, QuadraticProgram, bounded
from scp_mpc.settings import QPSettings

_FAR = 1e3  # a bound that is none, in rows of length one: nearer than infinity, which costs more
_POINTS = (
    osqp.SolverStatus.OSQP_SOLVED,
    osqp.SolverStatus.OSQP_SOLVED_INACCURATE,
    osqp.SolverStatus.OSQP_MAX_ITER_REACHED,
)


class OSQP(Backend):
    """Sets OSQP up once for a program's pattern; later calls only rewrite values.

    Args:
        program: Whose values are read at each `load`.
        settings: OSQP's.

    Attributes:
        iterations: ADMM iterations since the last `load`.
    """

    name = "osqp"
    noise = 1e-12  # ADMM projects: the multiplier of a constraint that is not active is zero

    def __init__(self, program: QuadraticProgram, settings: QPSettings) -> None:
        """Set OSQP up on scaled copies."""
        self._program, self.stages = program, settings.stages
        self._steps, self._runs = settings.rho, 0
        diagonal = program.P.diagonal()
        self._columns = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        row, column = program.P.indices, _column_of(program.P)
        self._upper = np.flatnonzero(row <= column)  # OSQP takes the upper triangle
        row, column = row[self._upper], column[self._upper]
        self._weights = self._columns[row] * self._columns[column]
        self._row, self._A = program.A.indices, self._columns[_column_of(program.A)]
        self._m, self._rhos = len(program.lower), settings.rho
        self._P, self._q = program.P.data.copy(), program.q.copy()
        self.iterations = self._runs = 0
        data, lower, upper = self._scaled()
        solver = osqp.OSQP(algebra="builtin")
        solver.setup(
            sparse.csc_matrix(
                (self._P[self._upper] * self._weights, (row, column)), program.P.shape
            ),
            self._columns * self._q,
            sparse.csc_matrix((data, program.A.indices, program.A.indptr), program.A.shape).copy(),
            lower,
            upper,
            verbose=False,
            scaling=0,
            rho=settings.rho[0],
            sigma=settings.sigma,
            alpha=settings.alpha,
            adaptive_rho=0,
            check_termination=0,
            polishing=False,
            eps_prim_inf=1e-15,  # there is a better test, and this one leaves no point behind
            eps_dual_inf=1e-15,
        )
        # The extension behind the interface: it says whether it took what it was given, where
        # the interface does not, and it takes a tenth of the time.
        self._core = solver._solver
        self._settings = self._core.get_settings()

    def load(self, start: tuple[FloatArray, FloatArray]) -> None:
        """See the base class."""
        program, core = self._program, self._core
        if not np.isfinite(program.A.data).all():
            _refuse(program.A.data)
        data, lower, upper = self._scaled()
        room = upper - lower
        if not (room.min() >= 0 and np.isfinite(room).all()):
            _refuse(lower, upper)
        x, y = start[0] / self._columns, start[1] / self._rows
        if not (np.isfinite(x).all() and np.isfinite(y).all()):
            _refuse(x, y)
        if self._runs > 1:
            core.update_rho(self._rhos[0])
        failed = 0
        if not np.array_equal(program.q, self._q):
            if not np.isfinite(program.q).all():
                _refuse(program.q)
            self._q = program.q.copy()
            failed |= core.update_data_vec(q=self._columns * self._q, l=None, u=None)
        failed |= core.update_data_vec(q=None, l=lower, u=upper)
        P = None
        if not np.array_equal(program.P.data, self._P):
            if not np.isfinite(program.P.data).all():
                _refuse(program.P.data)
            self._P = program.P.data.copy()
            P = self._P[self._upper] * self._weights
        failed |= core.update_data_mat(P_x=P, P_i=None, A_x=data, A_i=None)
        if failed:
            raise ArithmeticError(f"OSQP did not take the program: {failed}")
        core.warm_start(x, y)
        self.iterations = self._runs = 0

    def run(self, effort: int) -> tuple[FloatArray, FloatArray] | None:
        """See the base class; effort counts ADMM iterations."""
        core = self._core
        if self._runs:
            core.update_rho(self._rhos[min(self._runs, len(self._rhos) - 1)])
        self._runs += 1
        self._settings.max_iter = effort
        core.update_settings(self._settings)
        core.solve()
        self.iterations += effort
        if core.info.status_val not in _POINTS:  # x holds 2143289344.0 then, which is finite
            return None
        x, y = self._columns * core.solution.x, self._rows * core.solution.y
        return x, y

    def _scaled(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Values of A and the bounds in rows of length one."""
        program = self._program
        data = program.A.data * self._A
        length2 = np.bincount(self._row, data * data, self._m)
        self._rows = 1.0 / np.sqrt(np.where(length2 > 0, length2, 1.0))
        data *= self._rows[self._row]
        return data, *bounded(self._rows * program.lower, self._rows * program.upper, _FAR)


def _column_of(matrix: sparse.csc_matrix) -> IntArray:
    """Column of each stored entry."""
    return np.repeat(np.arange(matrix.shape[1]), np.diff(matrix.indptr))


def _refuse(*vectors: FloatArray) -> None:
    """Say what is wrong: OSQP would keep NaN for ever, and go on with old data otherwise."""
    for vector in vectors:
        if not np.isfinite(vector).all():
            at = int(np.argmin(np.isfinite(vector)))
            raise NotFiniteError("program", f"{vector[at]} at index {at} is not finite")
    lower, upper = vectors
    at = int(np.argmax(lower > upper))
    raise BoundsError("lower", f"{lower[at]} exceeds upper = {upper[at]} at row {at}")
