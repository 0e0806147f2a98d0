"""One control step of the condensed problem: its free plan, its programs, its points.

Notation as in `condensed.py` and `conflicts.py`.
"""

from collections import Counter
from functools import cached_property

import numpy as np

from scp_mpc.arrays import FloatArray, IntArray
from scp_mpc.problem import Problem
from scp_mpc.solver.active_set import ActiveSetSolver, CondensedProgram, Held
from scp_mpc.solver.certificate import Certificate, Point, Pushed
from scp_mpc.solver.condensed import Condensed
from scp_mpc.solver.conflicts import Conflicts, Tangent
from scp_mpc.solver.step_data import StepData
from scp_mpc.solver.stopwatch import Stopwatch


class CondensedStep:
    """Turns half-spaces into programs and their solutions into certified points.

    Args:
        problem: The problem.
        condensed: What it is condensed to.
        qp: Solves its programs.
        step: The control step.
        watch: Where its time goes.
        like: The same step at other points, whose plan that ignores the obstacles is known.

    Attributes:
        y_free: (ny,) the plan that nothing constrains.
        finished: Programs solved, by solver.
    """

    def __init__(
        self,
        problem: Problem,
        condensed: Condensed,
        qp: ActiveSetSolver,
        step: StepData,
        watch: Stopwatch,
        like: "CondensedStep | None" = None,
    ) -> None:
        """Find the plan that nothing constrains, and the room it leaves to the bounds."""
        self.problem, self.condensed, self.data, self.watch = problem, condensed, step, watch
        self.finished: Counter[str] = Counter()
        self._qp, self._certificate = qp, Certificate(problem, condensed)
        with watch.solving:
            if like is None:
                self.y_free = condensed.start(step.x0, step.x_ref)
            else:
                self.y_free = condensed.started_like(like.condensed, like.y_free)
                y, reaction = like.within_bounds
                known = condensed.of_inputs(y[like.condensed.u], y[like.condensed.s])
                self.within_bounds = known, reaction
            box = self.y_free[condensed.boxed]
            self._room = (
                condensed.lower[condensed.boxed] - box,
                (condensed.upper[condensed.boxed] - box),
            )

    @cached_property
    def within_bounds(self) -> tuple[FloatArray, FloatArray]:
        """The plan that ignores the obstacles: y (ny,) and the forces of its bounds (nf,)."""
        lower, upper = self._room
        nothing = np.zeros(len(lower))
        if (lower <= 0).all() and (upper >= 0).all():
            self.finished["kkt"] += 1
            return self.y_free, nothing
        none = np.zeros((0, self.condensed.response.shape[1])), np.zeros(0)
        with self.watch.solving:
            held = self.solve(self.program(*none), nothing.astype(np.intp), np.inf)
        return (self.y_free, nothing) if held is None else (self.y(held.v), held.force)

    @cached_property
    def least(self) -> float:
        """Cost of the plan that nothing constrains: any other costs |v|^2 / 2 more."""
        c, problem = self.condensed, self.problem
        u = self.y_free[c.u].reshape(-1, problem.model.nu)
        states = self.data.x_ref.copy()
        states[1:] += c.deviations(u)
        return problem.cost(states, u, self.y_free[c.s], self.data.x_ref)

    def y(self, v: FloatArray) -> FloatArray:
        """Outputs (ny,) of a solution v (nv,)."""
        moved: FloatArray = self.y_free + self.condensed.response @ v
        return moved

    def path(self, y: FloatArray) -> FloatArray:
        """(C+1, d) positions of the robot in y, from now on [m]."""
        return self.data.path(y[self.condensed.p])

    def convex(self, conflicts: Conflicts, tangent: Tangent) -> CondensedProgram:
        """The convex subproblem about a tangent."""
        A = np.einsum("kw,kwn->kn", tangent.a, conflicts.response)
        away = (tangent.y - self.y_free)[conflicts.at]
        return self.program(A, (tangent.a * away).sum(axis=1) - tangent.g)

    def program(self, A: FloatArray, b: FloatArray) -> CondensedProgram:
        """The program with half-spaces A v >= b."""
        return CondensedProgram(*self._room, A, b)

    def solve(self, program: CondensedProgram, active: IntArray, cap: float) -> Held | None:
        """Solve it from an active set; see `ActiveSetSolver.solve`."""
        with self.watch.inside:
            held = self._qp.solve(program, active, cap)
        self.finished["daqp"] += held is not None
        return held

    def consistent(self, program: CondensedProgram, held: Held, tolerance: float) -> bool:
        """See `ActiveSetSolver.consistent`."""
        return self._qp.consistent(program, held, tolerance)

    def point(self, conflicts: Conflicts, held: Held) -> Point:
        """Roll a solution out and certify it against the original problem."""
        bounds = len(self._room[0])
        y, e = self._certificate.rolled_out(self.y(held.v))
        with self.watch.linearising:
            tangent = conflicts.tangent(y)
        slack = np.where(held.capped[bounds:], np.maximum(-tangent.g, 0.0), 0.0)
        pushed = Pushed(tangent, held.force[bounds:], slack, conflicts)
        return self._certificate.certify(y, e, held.force[:bounds], pushed)

    def free_point(self) -> Point:
        """The plan that ignores the obstacles, certified as the solution without them."""
        y, reaction = self.within_bounds
        return self._certificate.certify(*self._certificate.rolled_out(y), reaction, None)
