"""Other solvers behind the same interface: PIQP, the rescue, and whatever qpsolvers knows.

They solve a program from scratch, to accuracy. PIQP (Schwan, Jiang, Kuhn and Jones, 2023), an
interior-point method that needs ten iterations whatever changed, is kept set up for the pattern;
the others are asked by name, for a second opinion. The only file that imports piqp and qpsolvers.

Notation:
    A_e x = b               rows with equal bounds
    l <= A_i x <= u         all others
"""

import warnings

import numpy as np
import piqp
import qpsolvers
from scipy import sparse

from scp_mpc.arrays import FloatArray, IntArray
from scp_mpc.qp.program import Backend, QuadraticProgram, bounded

_PRECISION = 1e-10
_POINTS = (piqp.PIQP_SOLVED, piqp.PIQP_MAX_ITER_REACHED)  # the exact solve tells good from bad
_FAR = 1e3  # a bound that is none: PIQP prints about infinite ones


class PIQP(Backend):
    """PIQP, set up once for the pattern and for which rows are equations; then only values change.

    Args:
        program: Whose values are read at each `load`; its rows with equal bounds must stay such.
        equations: (k,) those rows.
    """

    name = "piqp"

    def __init__(self, program: QuadraticProgram, equations: IntArray) -> None:
        """Set PIQP up."""
        self._program, m = program, len(program.lower)
        self._e, self._i = equations, np.setdiff1d(np.arange(m), equations)
        self._equations, self._e_places = _part(program.A, self._e)
        self._inequalities, self._i_places = _part(program.A, self._i)
        self._solver = piqp.SparseSolver()
        for name in ("eps_abs", "eps_rel", "eps_duality_gap_abs", "eps_duality_gap_rel"):
            setattr(self._solver.settings, name, _PRECISION)
        self._solver.settings.verbose = False
        # Bounds are finite at set-up, or PIQP would leave them out for ever.
        zero = np.zeros(len(self._i))
        given = program.P, program.q, self._equations, program.lower[self._e]
        self._solver.setup(*given, self._inequalities, zero - 1, zero + 1)

    def load(self, start: tuple[FloatArray, FloatArray]) -> None:  # noqa: ARG002
        """See the base class; the start is of no use."""
        program, e, i = self._program, self._e, self._i
        self._equations.data[:] = program.A.data[self._e_places]
        self._inequalities.data[:] = program.A.data[self._i_places]
        self._solver.update(
            program.P,
            program.q,
            self._equations,
            program.lower[e],
            self._inequalities,
            *bounded(program.lower[i], program.upper[i], _FAR),
        )

    def run(self, effort: int) -> tuple[FloatArray, FloatArray] | None:  # noqa: ARG002
        """See the base class."""
        if self._solver.solve() not in _POINTS:
            return None
        result, y = self._solver.result, np.empty(len(self._program.lower))
        y[self._e], y[self._i] = result.y, result.z_u - result.z_l
        return np.array(result.x), y


class Named(Backend):
    """Any solver of qpsolvers that takes sparse matrices and returns multipliers.

    Args:
        program: Whose values are read at each `load`.
        name: What qpsolvers calls it.
        equations: (k,) rows with equal bounds.
    """

    def __init__(self, program: QuadraticProgram, name: str, equations: IntArray) -> None:
        """Remember all three."""
        self.name, self._program = name, program
        self._e, self._i = equations, np.setdiff1d(np.arange(len(program.lower)), equations)

    def load(self, start: tuple[FloatArray, FloatArray]) -> None:
        """See the base class: values are read when they are solved for."""

    def run(self, effort: int) -> tuple[FloatArray, FloatArray] | None:  # noqa: ARG002
        """See the base class."""
        program, rows = self._program, self._program.A.tocsr()
        lower, upper = program.lower[self._i], program.upper[self._i]
        above, below = np.isfinite(upper), np.isfinite(lower)
        inner = rows[self._i]
        G = sparse.vstack([inner[above], -inner[below]], format="csc")
        h = np.concatenate([upper[above], -lower[below]])
        problem = qpsolvers.Problem(
            program.P, program.q, G, h, rows[self._e].tocsc(), program.lower[self._e]
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            solution = qpsolvers.solve_problem(problem, self.name)
        if not solution.found or solution.x is None or solution.z is None or solution.y is None:
            return None
        y, inner_y = np.zeros(len(program.lower)), np.zeros(len(self._i))
        inner_y[above] += solution.z[: above.sum()]
        inner_y[below] -= solution.z[above.sum() :]
        y[self._e], y[self._i] = solution.y, inner_y
        return np.array(solution.x), y


def installed() -> list[str]:
    """Names of the solvers that can be asked, besides OSQP and PIQP."""
    return sorted(set(qpsolvers.available_solvers) - {"osqp", "piqp"})


def known() -> list[str]:
    """Names of all solvers that qpsolvers has an interface to."""
    solvers = qpsolvers.dense_solvers + qpsolvers.sparse_solvers
    return sorted({*solvers, *_KNOWN.split()} - {"osqp", "piqp"})


# What qpsolvers has interfaces to and packages for, installed or not.
_KNOWN = "clarabel copt cvxopt daqp ecos gurobi highs hpipm jaxopt_osqp kvxopt mosek nppro proxqp"
_KNOWN += " qpalm qpax quadprog scs sip"


def _part(A: sparse.csc_matrix, indices: IntArray) -> tuple[sparse.csc_matrix, IntArray]:
    """Some rows of A as a matrix of their own, and where its values stand in A's."""
    numbered = sparse.csc_matrix((np.arange(A.nnz), A.indices, A.indptr), shape=A.shape)
    part = numbered[indices]
    places = part.data.astype(np.intp)
    return sparse.csc_matrix((A.data[places], part.indices, part.indptr), part.shape), places
