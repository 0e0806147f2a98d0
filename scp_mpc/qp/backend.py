"""Who solves a program, and how far that is believed.

    repeat:  run the solver a little further         (OSQP: 10 iterations, then 25)
             the signs of its multipliers            -> a guess of the active set
             from there to the exact solution        -> solution, or not within so many changes
    until    there is one, or multipliers prove that there is none, or the runs are used up
    rescue:  PIQP, judged in the same way

What a solver returns is never taken as it is: `active_set.py` solves with the program's own data,
and checks every constraint and every force.
"""

from collections import Counter
from contextlib import nullcontext
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from scp_mpc.arrays import BoolArray, FloatArray, IntArray
from scp_mpc.deadline import Clock
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.qp.active_set import CondensedQP, Settled, settled
from scp_mpc.qp.osqp import OSQP
from scp_mpc.qp.others import PIQP, Named, installed, known
from scp_mpc.qp.program import Backend, QuadraticProgram
from scp_mpc.settings import QPSettings

_RANKING_RUNS = 2  # runs of the solver after which a program is ranked
_DIRECT = 2  # systems up to which the active set counts as the solver's own: one, and one repair


@dataclass(frozen=True, eq=False)
class Rows:
    """Where the constraints of a condensed program stand in the sparse one; -1 for nowhere.

    Attributes:
        place: (nf + K,) its row.
        below: (nf + K,) the row that keeps the slack of its lower bound from being negative.
        above: (nf + K,) likewise of its upper bound.
    """

    place: IntArray
    below: IntArray | None = None
    above: IntArray | None = None

    def active(self, y: FloatArray, noise: float) -> tuple[IntArray, BoolArray]:
        """The active set that multipliers y (m,) name, and which of it yields.

        Args:
            y: The multipliers.
            noise: Share of the largest one below which one is none.
        """
        if noise:
            y = np.where(np.abs(y) > noise * np.abs(y).max(), y, 0.0)
        active = np.zeros(len(self.place), dtype=np.intp)
        there = self.place >= 0
        active[there] = np.sign(y[self.place[there]])
        relaxed = np.zeros(len(active), dtype=np.bool_)
        if self.below is not None and self.above is not None:
            pin = np.where(active < 0, self.below, self.above)
            relaxed = (active != 0) & (pin >= 0) & (y[pin] == 0)
        return active, relaxed

    def forces(self, y: FloatArray) -> FloatArray:
        """Multipliers y (m,) as forces (nf + K,), positive at lower bounds."""
        return np.where(self.place >= 0, -y[self.place], 0.0)


class ProgramSolver:
    """Solves the convex programs of one pattern.

    Args:
        program: Whose values are rewritten between calls.
        equations: (k,) its rows with equal bounds.
        name: The solver to ask first.
        settings: OSQP's, and whether to ask PIQP for what that does not finish.

    Attributes:
        backend: The solver.
        iterations: ADMM iterations that OSQP spent on the last program; 0 of other solvers.
        finished: Programs by who finished them: the solver, "repaired" where its active set took
            more than one repair, "piqp". And programs that nobody finished: "ranked" by a bound,
            "cut" because that is too high, "infeasible".
    """

    def __init__(
        self, program: QuadraticProgram, equations: IntArray, name: str, settings: QPSettings
    ) -> None:
        """Set everything up: later calls only write numbers."""
        self.backend = backend(program, equations, name, settings)
        self._rescue = None
        if settings.rescue and name != "piqp":
            self._rescue = PIQP(program, equations)
        self.finished: Counter[str] = Counter()
        self.iterations = 0

    def solve(
        self,
        qp: CondensedQP,
        rows: Rows,
        start: tuple[FloatArray, FloatArray],
        clock: Clock,
    ) -> Settled:
        """Return the program's solution, or that there is none, or that nobody found it in time.

        Args:
            qp: The condensed program; the sparse one has been written.
            rows: Which row is which.
            start: x (n,) and y (m,) to start from.
            clock: Whether there is time for more than the first run.
        """
        solver, end = self.backend, Settled(None, 0)
        solver.load(start)
        for k, stage in enumerate(solver.stages):
            if k and not clock.allows("longer run"):
                return replace(end, late=True)
            with clock.task("longer run") if k else nullcontext():
                end = _attempt(solver, qp, rows, *stage, clock)
            self.iterations = getattr(solver, "iterations", 0)
            if end.solution is not None:
                self.finished[solver.name if end.systems <= _DIRECT else "repaired"] += 1
                return end
            if end.infeasible:
                self.finished["infeasible"] += 1
                return end
        if self._rescue is None:
            return end
        if not clock.allows("rescue"):
            return replace(end, late=True)
        with clock.task("rescue"):
            self._rescue.load(start)
            end = _attempt(self._rescue, qp, rows, *self._rescue.stages[0], clock)
        if end.solution is not None:
            self.finished["piqp"] += 1
        if end.infeasible:
            self.finished["infeasible"] += 1
        return end

    def rank(
        self, qp: CondensedQP, rows: Rows, start: tuple[FloatArray, FloatArray], limit: float
    ) -> tuple[float, tuple[FloatArray, FloatArray]]:
        """Estimate the program's optimum from below, by the multipliers after a few iterations.

        Args:
            qp: As in `solve`, like the next two.
            rows: Likewise.
            start: Likewise.
            limit: Optimum beyond which nobody cares: the second run is left out.

        Returns:
            A lower bound of the optimum, infinite where there is no solution or none within the
            limit; and the point reached.
        """
        self.backend.load(start)
        bound = -inf
        for effort, _ in self.backend.stages[:_RANKING_RUNS]:
            point = _run(self.backend, effort)
            if point is None:
                bound = inf
                break
            start, bound = point, qp.dual_bound(rows.forces(point[1]))
            if bound > limit:
                bound = inf
                break
        self.finished["cut" if bound == inf else "ranked"] += 1
        return bound, start


def _attempt(
    solver: Backend, qp: CondensedQP, rows: Rows, effort: int, repairs: int, clock: Clock
) -> Settled:
    """Let a solver go on, and see whether what it names leads to the solution, or proves none."""
    point = _run(solver, effort)
    if point is None:
        return Settled(None, 0)
    most, began = clock.room("repair", repairs), clock.mark()
    end = settled(qp, *rows.active(point[1], solver.noise), most)
    clock.learn("repair", began, end.systems)
    if end.solution is None and qp.proves_infeasible(rows.forces(point[1])):
        return replace(end, infeasible=True)
    return end


def _run(solver: Backend, effort: int) -> tuple[FloatArray, FloatArray] | None:
    """Let a solver go on; None unless it comes to numbers that can be worked with."""
    point = solver.run(effort)
    with np.errstate(over="ignore"):
        return point if point and np.isfinite(point[0] @ point[0] + point[1] @ point[1]) else None


def backend(
    program: QuadraticProgram, equations: IntArray, name: str, settings: QPSettings
) -> Backend:
    """Return the solver of that name.

    Raises:
        InvalidArgumentError: There is none, or it is not installed.
    """
    if name == "osqp":
        return OSQP(program, settings)
    if name == "piqp":
        return PIQP(program, equations)
    require_solver(name)
    return Named(program, name, equations)


def require_solver(name: object) -> None:
    """Raise `InvalidArgumentError` unless there is a solver of that name."""
    there = ["osqp", "piqp", *installed()]
    if name in there:
        return
    if name in known():
        raise InvalidArgumentError(
            "solver", f"{name!r} is not installed: pip install 'qpsolvers[{name}]'"
        )
    raise InvalidArgumentError("solver", f"{name!r} is none of {', '.join([*there, 'native'])}")
