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
    noise = 0.0  # ADMM projects: the multiplier of a constraint that is not active is zero

    def __init__(self, program: QuadraticProgram, settings: QPSettings) -> None:
        """Set OSQP up on scaled copies."""
        self._program, self.stages = program, settings.stages
        self._steps, self._runs = settings.rho, 0
        diagonal = program.P.diagonal()
        self._columns = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        row, column = program.P.indices, _column_of(program.P)
        self._upper = np.flatnonzero(row <= column)  # OSQP takes the upper triangle
        row, column = row[self._upper], column[self._upper]
        self._P = self._columns[row] * self._columns[column]
        self._known = program.P.data.copy()
        self._row, self._A = program.A.indices, self._columns[_column_of(program.A)]
        self._m, self.iterations = len(program.lower), 0
        self._solver = osqp.OSQP(algebra="builtin")
        self._settings = {
            "verbose": False,
            "scaling": 0,
            "rho": settings.rho[0],
            "sigma": settings.sigma,
            "alpha": settings.alpha,
            "adaptive_rho": 0,
            "check_termination": 0,
            "polishing": False,
            "eps_prim_inf": 1e-15,  # there is a better test, and this one leaves no point behind
            "eps_dual_inf": 1e-15,
            "max_iter": 1,
        }
        data, lower, upper_ = self._scaled()
        A = sparse.csc_matrix((data, program.A.indices, program.A.indptr), program.A.shape)
        P = sparse.csc_matrix(
            (program.P.data[self._upper] * self._P, (row, column)), program.P.shape
        )
        q = self._columns * program.q
        self._solver.setup(P, q, A.copy(), lower, upper_, **self._settings)

    def load(self, start: tuple[FloatArray, FloatArray]) -> None:
        """See the base class."""
        program, solver = self._program, self._solver
        data, lower, upper = self._scaled()
        q = self._columns * program.q
        _check(q, data, lower, upper)
        if self._runs > 1:
            solver.update_settings(rho=self._steps[0])
        values = {"q": q, "l": lower, "u": upper, "Ax": data}
        if not np.array_equal(program.P.data, self._known):
            self._known = program.P.data.copy()
            values["Px"] = self._known[self._upper] * self._P
        solver.update(**values)
        x, y = start[0] / self._columns, start[1] / self._rows
        _check(x, y)
        solver.warm_start(x=x, y=y)
        self.iterations = 0
        self._runs = 0

    def run(self, effort: int) -> tuple[FloatArray, FloatArray] | None:
        """See the base class; effort counts ADMM iterations."""
        solver = self._solver
        if self._runs:
            solver.update_settings(rho=self._steps[min(self._runs, len(self._steps) - 1)])
        self._runs += 1
        solver.update_settings(max_iter=effort)
        result = solver.solve(raise_error=False)
        self.iterations += effort
        if result.info.status_val not in _POINTS:  # x holds 2143289344.0 then, which is finite
            return None
        x, y = self._columns * result.x, self._rows * result.y
        return (x, y) if np.isfinite(x.sum() + y.sum()) else None

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


def _check(*vectors: FloatArray) -> None:
    """OSQP would keep NaN for ever, and go on with old data where bounds contradict each other."""
    for vector in vectors:
        if not np.isfinite(vector.sum()):
            at = int(np.argmin(np.isfinite(vector)))
            raise NotFiniteError("program", f"{vector[at]} at index {at} is not finite")
    if len(vectors) == 4 and (vectors[2] > vectors[3]).any():
        at = int(np.argmax(vectors[2] > vectors[3]))
        raise BoundsError("lower", f"{vectors[2][at]} exceeds upper = {vectors[3][at]} at row {at}")
