"""The condensed program's solver, an active-set method: the only file that imports daqp.

    minimise |v|^2 / 2   subject to   lower <= F v <= upper,   A v >= b

From the active set of the last plan a dual active-set method needs one or two changes, each a
rank-one update in compiled code (DAQP: Arnstrom, Bemporad and Axehill, 2022). What it returns is
taken only as a guess of the active set: `settle` then solves for exactly that set.

Notation:
    v       (nv,)       inputs and sizes in coordinates that make the Hessian the identity
    F       (nf, nv)    responses of the bounded entries, constant
    A       (K, nv)     responses of the half-spaces, new in every program
"""

from dataclasses import dataclass

import daqp
import numpy as np
from scipy.linalg.lapack import dposv

from scp_mpc.arrays import BoolArray, FloatArray, IntArray

_LOWER, _UPPER, _SOFT = 3, 1, 8  # DAQP's flags of a constraint: active at a bound, may yield
_SOLVED = (1, 2)  # DAQP's exit flags: optimal, optimal with slack
_FAR = 1e30  # DAQP's infinity
_YIELDING = 1e6  # metres per unit force beyond the cap: as good as a pure L1 penalty
_ACCURACY = 1e-9  # of a constraint, in its own unit
_RIDGE = 1e-12  # relative to the largest diagonal entry


@dataclass(frozen=True, eq=False)
class CondensedProgram:
    """minimise |v|^2 / 2 subject to least <= rows v <= most: bounds first, then half-spaces."""

    rows: FloatArray
    least: FloatArray
    most: FloatArray


@dataclass(frozen=True, eq=False)
class Held:
    """Point, forces and active set of a condensed program.

    Attributes:
        program: The program.
        v: (nv,) point.
        force: (nf + K,) on the bounds, positive at lower ones, then on the half-spaces, >= 0.
        active: (nf + K,) -1 at a lower bound or half-space, 1 at an upper bound, 0 elsewhere.
        capped: (nf + K,) half-spaces that yield at the largest force.
        rows: (k, nv) responses of the active constraints that hold with equality.
        indices: (k,) which they are.
        factor: (k, k) upper Cholesky factor of rows rows'.
    """

    program: CondensedProgram
    v: FloatArray
    force: FloatArray
    active: IntArray
    capped: BoolArray
    rows: FloatArray
    indices: IntArray
    factor: FloatArray

    def consistent(self, tolerance: float) -> bool:
        """Whether all forces push the right way and all constraints that do not yield hold."""
        if (self.force * self.active > 0).any():
            return False
        program, value = self.program, self.program.rows @ self.v
        low = (value < program.least - tolerance) & ~self.capped
        return not (low.any() or (value > program.most + tolerance).any())


class ActiveSetSolver:
    """Solves condensed programs with constant bounds and changing half-spaces.

    Args:
        F: (nf, nv) responses of the bounded entries.
    """

    def __init__(self, F: FloatArray) -> None:
        """Allocate room for the constraints."""
        self._bounds, n = F.shape
        self._rows = np.ascontiguousarray(F)
        self._identity, self._zero = np.eye(n), np.zeros(n)

    def solve(
        self,
        lower: FloatArray,
        upper: FloatArray,
        A: FloatArray,
        b: FloatArray,
        active: IntArray,
        cap: float = np.inf,
    ) -> Held | None:
        """Solve, beginning at an active set; None if there is no point, or no solution came.

        Args:
            lower: (nf,) bounds of F v.
            upper: (nf,) likewise.
            A: (K, nv) half-spaces.
            b: (K,) their right-hand sides.
            active: (nf + K,) guess of the active set.
            cap: Largest force on a half-space; finite where they may yield.
        """
        program = CondensedProgram(
            np.concatenate([self._rows, A]) if len(A) else self._rows,
            np.concatenate([lower, b]),
            np.concatenate([upper, np.full(len(b), _FAR)]),
        )
        sense = np.where(active < 0, _LOWER, active).astype(np.intc)
        if np.isfinite(cap):
            flag, force = self._yielding(program, sense, cap)
        else:
            _, _, flag, info = daqp.solve(
                self._identity,
                self._zero,
                program.rows,
                program.most,
                program.least,
                sense,
                primal_tol=_ACCURACY,
            )
            force = -info["lam"]
        if flag not in _SOLVED:
            return None
        capped = np.zeros(len(force), dtype=np.bool_)
        capped[self._bounds :] = force[self._bounds :] >= cap
        return settle(program, -np.sign(force).astype(np.intc), capped, cap)

    def glimpse(
        self, lower: FloatArray, upper: FloatArray, A: FloatArray, b: FloatArray
    ) -> tuple[FloatArray, BoolArray] | None:
        """Solve without a guess; return v (nv,) and which half-spaces (K,) push, or None."""
        rows = np.concatenate([self._rows, A])
        least, most = np.concatenate([lower, b]), np.concatenate([upper, np.full(len(b), _FAR)])
        v, _, flag, info = daqp.solve(self._identity, self._zero, rows, most, least)
        return (v, info["lam"][self._bounds :] != 0) if flag in _SOLVED else None

    def _yielding(
        self, program: CondensedProgram, sense: IntArray, cap: float
    ) -> tuple[int, FloatArray]:
        """Let the half-spaces yield at the force `cap`."""
        sense[self._bounds :] |= _SOFT
        model = daqp.Model()
        model.setup(
            self._identity, self._zero, program.rows, program.most, program.least, sense
        )
        model.settings = {"primal_tol": _ACCURACY}
        weight = np.full(len(program.rows), cap)
        softness = np.full(len(program.rows), _YIELDING)
        model.soft_weights(softness, softness, weight, weight)
        _, _, flag, info = model.solve()
        return flag, -info["lam"]


def settle(
    program: CondensedProgram, active: IntArray, capped: BoolArray, cap: float
) -> Held | None:
    """Solve for exactly this active set; None if its rows depend on each other."""
    rows = program.rows
    v, force = np.zeros(rows.shape[1]), np.zeros(len(rows))
    if capped.any():
        force[capped] = cap
        v = cap * rows[capped].sum(axis=0)
        indices = np.flatnonzero((active != 0) & ~capped)
    else:
        indices = active.nonzero()[0]
    own, factor = rows[indices], np.zeros((0, 0))
    if len(indices):
        wanted = np.where(active < 0, program.least, program.most)[indices] - own @ v
        factor, strength, info = dposv(own @ own.T, wanted)
        if info != 0:  # two rows may be the same
            gram = own @ own.T
            gram.flat[:: len(gram) + 1] += _RIDGE * gram.diagonal().max()
            factor, strength, info = dposv(gram, wanted)
            if info != 0:
                return None
        force[indices] = strength
        v = v + strength @ own
    return Held(program, v, force, active, capped, own, indices, factor)
