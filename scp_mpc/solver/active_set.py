"""The condensed program's solver, an active-set method: the only file that imports daqp.

    minimise |v|^2 / 2   subject to   lower <= F v <= upper,   A v >= b

From the active set of the last plan a dual active-set method needs one or two changes, each a
rank-one update in compiled code (DAQP: Arnstrom, Bemporad and Axehill, 2022). Where there are many
bounds, those that neither guess nor free plan touch are left out until a solution breaks them.
What DAQP returns is taken only as a guess of the active set: `_settled` then solves for exactly
that set.

Notation:
    v       (nv,)       inputs and sizes in coordinates that make the Hessian the identity
    F       (nf, nv)    responses of the bounded entries
    A       (K, nv)     responses of the half-spaces, new in every program
"""

from dataclasses import dataclass
from itertools import count
from time import perf_counter

import daqp
import numpy as np
from scipy.linalg.lapack import dposv, dpotrf

from scp_mpc.arrays import BoolArray, FloatArray, IntArray

_LOWER, _SOFT = 3, 8  # DAQP's flags of a constraint: active at its lower bound, may yield
_SOLVED = (1, 2)  # DAQP's exit flags: optimal, optimal with slack
_INFINITY = 1e30  # DAQP's own
_YIELDING = 1e6  # metres per unit force beyond the cap: as good as a pure L1 penalty
_ACCURACY = 1e-9  # of a constraint, in its own unit
_FEW = 4  # variables per row beyond which a program is solved in the span of its rows
_SMALL = 128  # number of bounds up to which all are taken at once
_ATTEMPTS = 3  # programs with ever more bounds before all of them are taken
_LEAST_TIME = 1e-6  # [s] DAQP takes zero for no limit
_RIDGE = 1e-12  # relative to the largest diagonal entry


@dataclass(frozen=True, eq=False)
class CondensedProgram:
    """The values of one program.

    Attributes:
        F: (nf, nv) responses of the bounded entries, in C's order.
        lower: (nf,) bounds of F v.
        upper: (nf,) likewise.
        A: (K, nv) half-spaces.
        b: (K,) their right-hand sides.
        cap: (nf + K,) largest force on each constraint: finite where it may yield. None where
            none may.
    """

    F: FloatArray
    lower: FloatArray
    upper: FloatArray
    A: FloatArray
    b: FloatArray
    cap: FloatArray | None = None

    def penalty(self, v: FloatArray) -> float:
        """What v (nv,) pays for constraints that yield."""
        if self.cap is None:
            return 0.0
        bounded = self.F @ v
        beyond = np.maximum(self.lower - bounded, bounded - self.upper)
        short = np.concatenate([beyond, self.b - self.A @ v])
        soft = np.isfinite(self.cap)
        return float(self.cap[soft] @ np.maximum(short[soft], 0.0))


@dataclass(frozen=True, eq=False)
class Held:
    """Point, forces and active set of a program; bounds first, then half-spaces.

    Attributes:
        v: (nv,) point.
        force: (nf + K,) positive at lower bounds and half-spaces.
        active: (nf + K,) -1 at a lower bound or half-space, 1 at an upper bound, 0 elsewhere.
        capped: (nf + K,) constraints that yield at the largest force.
        rows: (k, nv) responses of the active constraints that hold with equality.
        indices: (k,) which they are.
        factor: (k, k) upper Cholesky factor of rows rows'.
    """

    v: FloatArray
    force: FloatArray
    active: IntArray
    capped: BoolArray
    rows: FloatArray
    indices: IntArray
    factor: FloatArray


class ActiveSetSolver:
    """Solves condensed programs.

    Args:
        variables: nv.
    """

    def __init__(self, variables: int) -> None:
        """Prepare what all programs share."""
        self._identity, self._zero = np.eye(variables), np.zeros(variables)
        self._until = np.inf

    def limit(self, until: float) -> None:
        """Give up programs that are not solved at this time of `perf_counter`."""
        self._until = until

    def solve(self, program: CondensedProgram, active: IntArray) -> Held | None:
        """Solve, beginning at an active set; None if there is no point, or no solution came.

        Args:
            program: The program.
            active: (nf + K,) guess of the active set.
        """
        end = self._search(program, active)
        if end is None:
            return None
        force = end[1]
        if program.cap is None:
            capped = np.zeros(len(force), dtype=np.bool_)
        else:
            capped = np.abs(force) >= program.cap
        return self._settled(program, np.sign(-force).astype(np.intp), capped)

    def glimpse(
        self, program: CondensedProgram, active: IntArray
    ) -> tuple[FloatArray, BoolArray] | None:
        """Return only v (nv,) and which half-spaces (K,) push, or None.

        Args:
            program: The program.
            active: (nf,) guess of the active bounds.
        """
        guess = np.concatenate([active, np.zeros(len(program.b), dtype=np.intp)])
        end = self._search(program, guess)
        return None if end is None else (end[0], end[1][len(program.F) :] > 0)

    def consistent(self, program: CondensedProgram, held: Held, tolerance: float) -> bool:
        """Whether all forces push the right way and all constraints that do not yield hold."""
        if (held.force * held.active > 0).any():
            return False
        nf = len(program.F)
        bounded, gap = program.F @ held.v, program.A @ held.v - program.b
        broken = (bounded < program.lower - tolerance) | (bounded > program.upper + tolerance)
        if program.cap is not None:
            broken &= ~held.capped[:nf]
        return not (broken.any() or ((gap < -tolerance) & ~held.capped[nf:]).any())

    def _search(
        self, program: CondensedProgram, active: IntArray
    ) -> tuple[FloatArray, FloatArray] | None:
        """Let DAQP find v (nv,) and all forces (nf + K,), with the bounds that matter."""
        F, nf, K = program.F, len(program.F), len(program.b)
        lower, upper, cap = program.lower, program.upper, program.cap
        if not K and (lower <= 0).all() and (upper >= 0).all():
            return self._zero, np.zeros(nf)
        soft = None if cap is None else np.where(np.isfinite(cap), _SOFT, 0).astype(np.intc)
        within = (active[:nf] != 0) | (lower > 0) | (upper < 0) | (nf <= _SMALL)
        sense = np.where(active < 0, _LOWER, active).astype(np.intc)
        for attempt in count():
            if attempt == _ATTEMPTS:
                within[:] = True
            which = within.nonzero()[0]
            if not len(which) + K:
                return self._zero, np.zeros(nf)
            rows = np.concatenate([F[which], program.A])
            least = np.concatenate([lower[which], program.b])
            most = np.concatenate([upper[which], np.full(K, _INFINITY)])
            flags, most_force = np.concatenate([sense[which], sense[nf:]]), None
            if cap is not None and soft is not None:
                most_force = np.concatenate([cap[which], cap[nf:]])
                flags |= np.concatenate([soft[which], soft[nf:]])
            end = self._run(rows, least, most, flags, most_force)
            if end is None:
                return None
            v, given = end
            bounded = F @ v
            broken = (bounded < lower - _ACCURACY) | (bounded > upper + _ACCURACY)
            broken &= ~within
            if not broken.any():
                force = np.zeros(nf + K)
                force[which], force[nf:] = given[: len(which)], given[len(which) :]
                return v, force
            within |= broken
            sense[which], sense[nf:] = _signs(given[: len(which)]), _signs(given[len(which) :])
        raise AssertionError  # unreachable: with all bounds none is broken

    def _run(
        self,
        rows: FloatArray,
        least: FloatArray,
        most: FloatArray,
        sense: IntArray,
        cap: FloatArray | None,
    ) -> tuple[FloatArray, FloatArray] | None:
        """Let DAQP solve with these rows; return v and their forces."""
        wide = rows
        if _FEW * len(rows) < rows.shape[1]:
            # v lies in the span of few rows: solve in coordinates of an orthonormal basis of it.
            rows = _triangle(rows)
        n = rows.shape[1]
        identity = self._identity if rows is wide else np.eye(n)  # DAQP ignores strides
        zero = self._zero[:n]
        seconds = 0.0  # no limit
        if self._until < np.inf:
            seconds = max(self._until - perf_counter(), _LEAST_TIME)
        if cap is not None:
            model = daqp.Model()
            model.setup(identity, zero, rows, most, least, sense)
            model.settings = {"primal_tol": _ACCURACY, "time_limit": seconds}
            weight = np.where(np.isfinite(cap), cap, 0.0)
            softness = np.full(len(rows), _YIELDING)
            try:
                model.soft_weights(softness, softness, weight, weight)
                v, _, flag, info = model.solve()
            except RuntimeError:  # rows that are no numbers, or next to none
                return None
        else:
            v, _, flag, info = daqp.solve(
                identity, zero, rows, most, least, sense, primal_tol=_ACCURACY, time_limit=seconds
            )
        if flag not in _SOLVED:
            return None
        force = -info["lam"]
        return (v if rows is wide else force @ wide), force

    def _settled(
        self, program: CondensedProgram, active: IntArray, capped: BoolArray
    ) -> Held | None:
        """Solve for exactly this active set; None if its rows depend on each other."""
        nf = len(program.F)
        v, force = np.zeros(len(self._zero)), np.zeros(len(active))
        indices = active.nonzero()[0]
        if program.cap is not None and capped.any():
            force[capped] = -active[capped] * program.cap[capped]
            v = force[:nf] @ program.F + force[nf:] @ program.A
            indices = (active * ~capped).nonzero()[0]
        bounds, spaces = indices[indices < nf], indices[indices >= nf] - nf
        rows, factor = np.concatenate([program.F[bounds], program.A[spaces]]), np.zeros((0, 0))
        if len(indices):
            at = np.where(active[bounds] < 0, program.lower[bounds], program.upper[bounds])
            wanted = np.concatenate([at, program.b[spaces]]) - rows @ v
            gram = rows @ rows.T
            factor, strength, info = dposv(gram, wanted)
            if info != 0:  # two rows may be the same
                gram.flat[:: len(gram) + 1] += _RIDGE * gram.diagonal().max()
                factor, strength, info = dposv(gram, wanted)
                if info != 0:
                    return None
            force[indices] = strength
            v = v + strength @ rows
        return Held(v, force, active, capped, rows, indices, factor)


def _triangle(rows: FloatArray) -> FloatArray:
    """Lower triangle L (k, k) with L L' = rows rows': the same program in k variables."""
    gram = rows @ rows.T
    factor, info = dpotrf(gram, lower=1, clean=1)
    if info != 0:  # two rows may be the same
        gram.flat[:: len(gram) + 1] += _RIDGE * gram.diagonal().max()
        factor, info = dpotrf(gram, lower=1, clean=1)
    return np.ascontiguousarray(factor)


def _signs(force: FloatArray) -> IntArray:
    """DAQP's flags for constraints held by these forces."""
    return np.where(force > 0, _LOWER, force < 0).astype(np.intc)
