"""The exact solution of a convex program on a guessed active set, and the guess's repair.

A solver that stops early names the active set; from there one Cholesky factor gives all digits.
All constraints of the program are then checked: who pulls is dropped, who is violated joins, and
the system is solved again. Nothing leaves this file that is not the solution of its program.

The program is condensed: dynamics eliminated, in coordinates in which its Hessian is the identity,

    minimise |v|^2 / 2   subject to   lower <= F v <= upper,   A v >= b

Constraints with an L1 weight are relaxed where it takes more than that force to keep them: the
exact penalty.

Notation:
    v       (nv,)       inputs and sizes
    F       (nf, nv)    responses of the bounded entries; the first nv of them are a square box
    A       (K, nv)     half-spaces
    force   (nf + K,)   multipliers, positive at lower bounds and half-spaces
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import qr, solve_triangular
from scipy.linalg.lapack import dposv
from scipy.optimize import nnls

from scp_mpc.arrays import BoolArray, FloatArray, IntArray

_ACCURACY = 1e-9  # of a constraint, in its own unit
_HELD = 1e-8  # the same at the end, after the last system
_LEAST = 1e-30  # of what forces ask: a pull that is none
_SHARE = 0.5  # of the worst: who is no better goes along
_PULL = 1e-10  # of the largest force: a force the wrong way that is none
_POOR = 1e-4  # of the largest pivot: too little for a factor of the squares to be exact
_DEPENDENT = 1e-10  # of the largest pivot: none


@dataclass(frozen=True, eq=False)
class CondensedQP:
    """The values of one program.

    Attributes:
        F: (nf, nv) responses of the bounded entries.
        lower: (nf,) bounds of F v.
        upper: (nf,) likewise.
        A: (K, nv) half-spaces.
        b: (K,) their right-hand sides.
        unbox: (nv, nv) inverse of F[:nv].
        l1_weight: (nf + K,) largest force on each constraint: finite where it may yield. None where
            none may.
        least: Cost at v = 0.
    """

    F: FloatArray
    lower: FloatArray
    upper: FloatArray
    A: FloatArray
    b: FloatArray
    unbox: FloatArray
    l1_weight: FloatArray | None = None
    least: float = 0.0

    @cached_property
    def rows(self) -> FloatArray:
        """F and A (nf + K, nv), one below the other."""
        return np.concatenate([self.F, self.A])

    def merit(self, v: FloatArray) -> float:
        """Cost at v (nv,) and what it pays for constraints that yield."""
        merit = self.least + float(v @ v) / 2
        if self.l1_weight is None:
            return merit
        bounded = self.F @ v
        beyond = np.maximum(self.lower - bounded, bounded - self.upper)
        short = np.concatenate([beyond, self.b - self.A @ v])
        soft = np.isfinite(self.l1_weight)
        return merit + float(self.l1_weight[soft] @ np.maximum(short[soft], 0.0))

    def dual_bound(self, force: FloatArray) -> float:
        """Lower bound of the optimum from any multipliers (nf + K,), stretched as they like best.

        With g the pull of all forces and c what their constraints ask of v, the dual function at t
        times the forces is t c - t^2 |g|^2 / 2.
        """
        force = self._admissible(force)
        gain, pull = self._asked(force), self._pull(force)
        pull2 = float(pull @ pull)
        if gain <= 0:
            return self.least
        stretch = gain / pull2 if pull2 > _LEAST * gain else np.inf
        if self.l1_weight is not None:
            soft = np.isfinite(self.l1_weight) & (force != 0)
            if soft.any():
                stretch = min(stretch, float((self.l1_weight[soft] / np.abs(force[soft])).min()))
        if stretch == np.inf:
            return np.inf
        return self.least + stretch * gain - stretch * stretch * pull2 / 2

    def proves_infeasible(self, force: FloatArray) -> bool:
        """Whether multipliers (nf + K,) show that no v in the box meets all constraints (Farkas).

        Their sum is a constraint by itself; it is held against the best that the box can do.
        """
        if self.l1_weight is not None and np.isfinite(self.l1_weight[len(self.F) :]).any():
            return False
        force, n = self._admissible(force), len(self.unbox)
        force[:n] = 0.0
        if self.l1_weight is not None:
            force[np.isfinite(self.l1_weight)] = 0.0
        asked = self._asked(force)
        if asked <= 0:
            return False
        pull = self._pull(force) @ self.unbox
        best = np.maximum(pull * self.lower[:n], pull * self.upper[:n]).sum()
        return bool(asked > best + _ACCURACY * np.abs(force).sum())

    def violations(self, v: FloatArray) -> tuple[FloatArray, IntArray]:
        """How far constraints (nf + K,) are violated, negative if they hold; and at which side."""
        nf, values = len(self.F), self.rows @ v
        bounded = values[:nf]
        below, above = self.lower - bounded, bounded - self.upper
        depth, side = np.empty(len(values)), np.full(len(values), -1, dtype=np.intp)
        np.maximum(below, above, out=depth[:nf])
        depth[nf:] = self.b - values[nf:]
        side[:nf][above > below] = 1
        return depth, side

    def _admissible(self, force: FloatArray) -> FloatArray:
        """Forces without those that have no bound to push at."""
        nf, force = len(self.F), force.copy()
        force[nf:] = np.maximum(force[nf:], 0.0)
        box = force[:nf]
        box[(box > 0) & (self.lower <= -_NONE)] = 0.0
        box[(box < 0) & (self.upper >= _NONE)] = 0.0
        return force

    def _asked(self, force: FloatArray) -> float:
        box, n = force[: len(self.F)], len(self.F)
        at = np.where(box > 0, self.lower, self.upper)
        return float(box[box != 0] @ at[box != 0] + force[n:] @ self.b)

    def _pull(self, force: FloatArray) -> FloatArray:
        n = len(self.F)
        pull: FloatArray = force[:n] @ self.F + force[n:] @ self.A
        return pull


_NONE = 1e29  # a bound beyond this is none


@dataclass(frozen=True, eq=False)
class QPSolution:
    """Point, forces and active set of a program; bounds first, then half-spaces.

    Attributes:
        v: (nv,) point.
        force: (nf + K,) positive at lower bounds and half-spaces.
        active: (nf + K,) -1 at a lower bound or half-space, 1 at an upper bound, 0 elsewhere.
        relaxed: (nf + K,) constraints that yield at the largest force.
        rows: (k, nv) responses of the active constraints that hold with equality.
        indices: (k,) which they are.
        factor: (k, k) upper Cholesky factor of rows rows'.
    """

    v: FloatArray
    force: FloatArray
    active: IntArray
    relaxed: BoolArray
    rows: FloatArray
    indices: IntArray
    factor: FloatArray


def solve_on(qp: CondensedQP, active: IntArray, relaxed: BoolArray) -> QPSolution:
    """Solve for exactly this active set; of rows that depend on others the surplus is left out."""
    nf = len(qp.F)
    v, force = np.zeros(qp.F.shape[1]), np.zeros(len(active))
    indices = active.nonzero()[0]
    if qp.l1_weight is not None and relaxed.any():
        force[relaxed] = -active[relaxed] * qp.l1_weight[relaxed]
        v = force[:nf] @ qp.F + force[nf:] @ qp.A
        indices = (active * ~relaxed).nonzero()[0]
    if not len(indices):
        none = np.zeros((0, len(v)))
        return QPSolution(v, force, active, relaxed, none, indices, np.zeros((0, 0)))
    split = int(np.searchsorted(indices, nf))
    bounds, spaces = indices[:split], indices[split:] - nf
    rows = qp.rows[indices]
    at = np.where(active[bounds] < 0, qp.lower[bounds], qp.upper[bounds])
    wanted = np.concatenate([at, qp.b[spaces]]) - rows @ v
    factor, strength, info = dposv(rows @ rows.T, wanted)
    if info != 0 or _ill_conditioned(factor):
        keep, factor, strength, v_rows = _independent(rows, wanted, -active[indices])
        active = active.copy()
        active[np.delete(indices, keep)] = 0
        indices, rows = indices[keep], rows[keep]
    else:
        v_rows = strength @ rows
    force[indices] = strength
    return QPSolution(v + v_rows, force, active, relaxed, rows, indices, factor)


def holds(qp: CondensedQP, solution: QPSolution, tolerance: float = _ACCURACY) -> bool:
    """Whether all forces push the right way, and all constraints that do not yield hold."""
    if (solution.force * solution.active).max(initial=0.0) > 0.0:
        return False
    depth = qp.violations(solution.v)[0]
    return bool(np.where(solution.relaxed, 0.0, depth).max(initial=0.0) <= tolerance)


@dataclass(frozen=True, eq=False)
class Settled:
    """What became of a guess of the active set.

    Attributes:
        solution: The program's; None if it was not reached.
        systems: Linear systems solved on the way: 1 if the guess was right.
        infeasible: Whether there is no solution, for certain.
        late: Whether there was no time to go on.
    """

    solution: QPSolution | None
    systems: int
    infeasible: bool = False
    late: bool = False


def settled(qp: CondensedQP, active: IntArray, relaxed: BoolArray, changes: int) -> Settled:
    """Go from a guess of the active set to the program's solution: a dual active-set method.

    First, who pulls leaves: one wrong constraint spoils the forces of its neighbours, so that only
    the worst leave at a time. Then forces are admissible, and who is violated the most joins; those
    whose force it takes away leave on the way (Goldfarb and Idnani, 1983). A force that reaches its
    l1_weight stays there, and its constraint yields.

    Args:
        qp: The program.
        active: (nf + K,) guess, as in `QPSolution`.
        relaxed: (nf + K,) guess of those that yield.
        changes: Systems to solve at most, beyond the first.
    """
    none = (
        np.append(qp.lower <= -_NONE, np.zeros(len(qp.b), dtype=np.bool_)),
        np.append(qp.upper >= _NONE, np.ones(len(qp.b), dtype=np.bool_)),
    )
    active = np.where(((active < 0) & none[0]) | ((active > 0) & none[1]), 0, active)
    solution, systems = solve_on(qp, active, relaxed & (active != 0)), 1
    relaxed = solution.relaxed
    while np.isfinite(solution.v @ solution.v):
        force, active = solution.force, solution.active
        pull = np.where(relaxed, 0.0, force * active)
        worst = pull.max(initial=0.0)
        if worst > _PULL * np.abs(force).max(initial=1.0):
            active = np.where(pull >= _SHARE * worst, 0, active)
        elif qp.l1_weight is not None and (np.abs(force) > qp.l1_weight * (1 + _PULL)).any():
            relaxed = relaxed | (np.abs(force) > qp.l1_weight * (1 + _PULL))
        else:
            return _joined(qp, solution, systems, changes + 1)
        if systems > changes:
            break
        solution, systems = solve_on(qp, active, relaxed), systems + 1
    return Settled(None, systems)


def _joined(qp: CondensedQP, solution: QPSolution, systems: int, most: int) -> Settled:
    """Let violated constraints join, from a solution whose forces are admissible."""
    active, relaxed = solution.active.copy(), solution.relaxed.copy()
    force, v = np.abs(solution.force), solution.v.copy()
    l1_weight = np.full(len(force), np.inf) if qp.l1_weight is None else qp.l1_weight
    while True:
        depth, side = qp.violations(v)
        room = np.where(side == active, -depth, np.abs(depth))  # of those that yield; or far beyond
        depth = np.where(relaxed, room, np.where(active != 0, 0.0, depth))
        p = int(depth.argmax())
        if depth[p] <= _ACCURACY:
            if systems > 1:  # rounding of all the steps goes, and the factor comes
                solution = solve_on(qp, active, relaxed)
            wrong = np.where(solution.relaxed, 0.0, solution.force * solution.active)
            if wrong.max(initial=0.0) > 0:  # no more than rounding, or the vertex is degenerate
                solution = replace(solution, force=np.where(wrong > 0, 0.0, solution.force))
                if wrong.max() > _PULL * np.abs(solution.force).max(initial=1.0):
                    return Settled(None, systems)
            if systems > 1 and not holds(qp, solution, _HELD):
                return Settled(None, systems)
            return Settled(solution, systems)
        yields = relaxed[p]  # and its force is to fall, for there is room
        if not yields:
            active[p] = side[p]
        relaxed[p] = False
        others = active != 0
        others[p] = False
        while True:
            if systems >= most:
                return Settled(None, systems)
            systems += 1
            W = (others & ~relaxed).nonzero()[0]
            N = -active[W, None] * qp.rows[W]
            n = -active[p] * qp.rows[p] * (-1.0 if yields else 1.0)
            r = np.zeros(0)
            if len(W):
                _, r, info = dposv(N @ N.T, N @ n)
                if info != 0:
                    return Settled(None, systems)
            z = n - r @ N
            reach = float(z @ n)
            gap = _gap(qp, v, p, int(active[p]), bool(yields))
            whole = gap / reach if reach > _DEPENDENT * float(n @ n) else np.inf
            with np.errstate(divide="ignore", invalid="ignore"):
                leave = np.where(r > 0, force[W] / r, np.inf)
                stop = np.where(r < 0, (l1_weight[W] - force[W]) / -r, np.inf)
            own = force[p] if yields else l1_weight[p] - force[p]
            length = min(whole, leave.min(initial=np.inf), stop.min(initial=np.inf), own)
            if not length < np.inf:  # or NaN
                return Settled(None, systems, infeasible=length == np.inf)
            v += length * z
            force[W] = np.maximum(force[W] - length * r, 0.0)
            force[p] += -length if yields else length
            if length == whole:
                others[p] = True
                break
            if length == own:
                relaxed[p], force[p] = not yields, 0.0 if yields else l1_weight[p]
                if yields:
                    active[p] = 0
                break
            if length == leave.min(initial=np.inf):
                j = W[int(leave.argmin())]
                active[j], force[j], others[j] = 0, 0.0, False
            else:
                j = W[int(stop.argmin())]
                relaxed[j], force[j] = True, l1_weight[j]


def _gap(qp: CondensedQP, v: FloatArray, p: int, side: int, yields: bool) -> float:
    """How much a constraint still lacks, or has too much of where it yields."""
    nf, value = len(qp.F), float(qp.rows[p] @ v)
    bound = qp.b[p - nf] if p >= nf else (qp.lower[p] if side < 0 else qp.upper[p])
    lacks = (bound - value) * -side
    return -lacks if yields else lacks


def _ill_conditioned(factor: FloatArray) -> bool:
    pivots = factor.diagonal()
    return bool(pivots.min() <= _POOR * pivots.max())


def _independent(
    rows: FloatArray, wanted: FloatArray, sign: IntArray
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """Solve with a largest set of rows that do not depend on each other, without squaring them.

    At a degenerate vertex many sets lead to the same point, but not all of them with forces that
    push; non-negative least squares find one that does.

    Returns:
        Which rows (k,); the factor (k, k) of rows rows'; their forces; and the point that they
        demand (nv,).
    """
    Q, R, order = qr(rows.T, mode="economic", pivoting=True)
    pivots = np.abs(R.diagonal())
    rank = int(np.count_nonzero(pivots > _DEPENDENT * pivots[0]))
    along = solve_triangular(R[:rank, :rank], wanted[order[:rank]], trans=1)
    point = Q[:, :rank] @ along
    keep = np.array(order[:rank], dtype=np.intp)
    force = np.array(solve_triangular(R[:rank, :rank], along), dtype=np.float64)
    factor = np.array(R[:rank, :rank], dtype=np.float64)
    met = np.flatnonzero(np.abs(rows @ point - wanted) <= _ACCURACY)
    if rank == len(rows) or not len(met):
        return keep, factor, force, point
    push, missed = nnls((rows[met] * sign[met, None]).T, point, maxiter=30 * len(rows))
    if missed > _ACCURACY * max(1.0, float(np.linalg.norm(point))) or not push.any():
        return keep, factor, force, point
    keep, force = met[push > 0], np.array((sign[met] * push)[push > 0], dtype=np.float64)
    factor = np.array(qr(rows[keep].T, mode="r")[0][: len(keep)], dtype=np.float64)
    return keep, factor, force, point
