"""The rescue: an interior-point solver for the few programs that OSQP does not finish.

Active-set changes cost ADMM hundreds to thousands of iterations; an interior-point method needs
ten, whatever changed. PIQP (Schwan, Jiang, Kuhn and Jones, 2023) is kept set up for the pattern.

Notation:
    A_e x = b               rows with equal bounds
    l <= A_i x <= u         rows with a finite bound; those without any are left out
"""

from dataclasses import dataclass
from time import perf_counter

import numpy as np
import piqp
from scipy import sparse

from scp_mpc.arrays import FloatArray, IntArray
from scp_mpc.solver.program import QuadraticProgram
from scp_mpc.solver.qp import QPSolution, QPStatus

_PRECISION = 1e-12
_INFINITY = 1e30  # PIQP's own
_KEPT = 2  # divisions of the rows that stay set up: firm and soft


@dataclass(frozen=True, eq=False)
class _Rows:
    """Some rows of A as a matrix of their own, with the places of its values in A's."""

    indices: IntArray
    matrix: sparse.csc_matrix
    places: IntArray

    @classmethod
    def of(cls, A: sparse.csc_matrix, indices: IntArray) -> "_Rows":
        numbered = sparse.csc_matrix((np.arange(A.nnz), A.indices, A.indptr), shape=A.shape)
        part = numbered[indices]
        places = part.data.astype(np.intp)
        matrix = sparse.csc_matrix((A.data[places], part.indices, part.indptr), part.shape)
        return cls(indices, matrix, places)

    def read(self, data: FloatArray) -> sparse.csc_matrix:
        self.matrix.data[:] = data[self.places]
        return self.matrix


class RescueSolver:
    """PIQP, set up once for each division of the rows; later only values change."""

    def __init__(self, program: QuadraticProgram) -> None:
        """Remember the program, whose values are read at each solve."""
        self._program = program
        self._known: dict[bytes, tuple[piqp.SparseSolver, _Rows, _Rows]] = {}

    def solve(self) -> QPSolution:
        """Solve the program as it stands, from a cold start."""
        began = perf_counter()
        program = self._program
        solver, equations, inequalities = self._set_up()
        e, i = equations.indices, inequalities.indices
        solver.update(
            None,
            program.q,
            equations.read(program.A.data),
            program.lower[e],
            inequalities.read(program.A.data),
            np.maximum(program.lower[i], -_INFINITY),
            np.minimum(program.upper[i], _INFINITY),
        )
        status = _STATUS.get(solver.solve(), QPStatus.FAILED)
        x, y = np.full(len(program.q), np.nan), np.full(len(program.lower), np.nan)
        if status is QPStatus.SOLVED:
            result = solver.result
            x, y = np.array(result.x), np.zeros(len(program.lower))
            y[e], y[i] = result.y, result.z_u - result.z_l
        iterations = int(solver.result.info.iter)
        return QPSolution(x, y, status, iterations, perf_counter() - began, "piqp")

    def _set_up(self) -> tuple[piqp.SparseSolver, _Rows, _Rows]:
        program = self._program
        same = program.lower == program.upper
        bounded = ~same & (np.isfinite(program.lower) | np.isfinite(program.upper))
        key = same.tobytes() + bounded.tobytes()
        if key not in self._known:
            while len(self._known) >= _KEPT:
                del self._known[next(iter(self._known))]
            parts = [_Rows.of(program.A, np.flatnonzero(mask)) for mask in (same, bounded)]
            solver = piqp.SparseSolver()
            for name in ("eps_abs", "eps_rel", "eps_duality_gap_abs", "eps_duality_gap_rel"):
                setattr(solver.settings, name, _PRECISION)
            solver.settings.verbose = False
            zero = np.zeros(len(parts[1].indices))
            solver.setup(
                program.P,
                program.q,
                parts[0].matrix,
                program.lower[parts[0].indices],
                parts[1].matrix,
                zero - 1,
                zero + 1,
            )
            self._known[key] = solver, *parts
        return self._known[key]


_STATUS = {
    piqp.PIQP_SOLVED: QPStatus.SOLVED,
    piqp.PIQP_PRIMAL_INFEASIBLE: QPStatus.INFEASIBLE,
}
