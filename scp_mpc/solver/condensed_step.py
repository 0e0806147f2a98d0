"""One control step of the condensed problem: its free plan, its programs, its points.

Notation as in `chart.py`, `conflicts.py` and `certificate.py`.
"""

from collections import Counter
from enum import IntEnum
from functools import cached_property

import numpy as np

from scp_mpc.arrays import FloatArray, IntArray
from scp_mpc.problem import Problem
from scp_mpc.solver.active_set import ActiveSetSolver, CondensedProgram, Held
from scp_mpc.solver.certificate import Certificate, Point, Pushed
from scp_mpc.solver.chart import Chart, Condensation, Rolled
from scp_mpc.solver.conflicts import Conflicts, Tangent
from scp_mpc.solver.step_data import StepData
from scp_mpc.solver.stopwatch import Stopwatch


class Yielding(IntEnum):
    """Who gives way where the constraints cannot all be met."""

    NOBODY = 0
    STATES = 1
    EVERYBODY = 2


class CondensedStep:
    """Turns half-spaces into programs and their solutions into certified points.

    Args:
        problem: The problem.
        condensed: What it is condensed to.
        qp: Solves its programs.
        step: The control step.
        watch: Where its time goes.

    Attributes:
        chart: The condensed problem, about the plan that was last charted.
        finished: Programs solved, by solver.
    """

    chart: Chart

    def __init__(
        self,
        problem: Problem,
        condensed: Condensation,
        qp: ActiveSetSolver,
        step: StepData,
        watch: Stopwatch,
    ) -> None:
        """Read the step; there is no chart yet."""
        self.problem, self.condensed, self.data, self.watch = problem, condensed, step, watch
        self.layout = condensed.layout
        self.finished: Counter[str] = Counter()
        self._qp, self._certificate = qp, Certificate(problem, condensed.layout)
        condensed.begin(step)
        self.bounds = self.layout.bounds(step)
        self._begun: tuple[FloatArray, FloatArray, tuple[FloatArray, Rolled]] | None = None

    def path(self, y: FloatArray) -> FloatArray:
        """(C+1, d) positions of the robot in y, from now on [m]."""
        return self.data.path(y[self.layout.p])

    def inputs(self, y: FloatArray) -> FloatArray:
        """The inputs (N, nu) in y."""
        return y[self.layout.u].reshape(self.layout.shape)

    def ladder(self, firm: bool) -> tuple[Yielding, ...]:
        """Who is to give way, one after the other: firm obstacles never do."""
        states = (Yielding.STATES,) if self.layout.limits_states else ()
        return Yielding.NOBODY, *states, *(() if firm else (Yielding.EVERYBODY,))

    @cached_property
    def nothing(self) -> tuple[FloatArray, FloatArray]:
        """No half-spaces, A (0, nv) and b (0,)."""
        return np.zeros((0, self.layout.variables)), np.zeros(0)

    def convex(self, conflicts: Conflicts, tangent: Tangent) -> tuple[FloatArray, FloatArray]:
        """The half-spaces A v >= b of a tangent."""
        A = np.einsum("kw,kwn->kn", tangent.a, conflicts.response(self.chart))
        away = (tangent.y - self.chart.y_free)[conflicts.at]
        return A, (tangent.a * away).sum(axis=1) - tangent.g

    def program(self, A: FloatArray, b: FloatArray, yields: Yielding) -> CondensedProgram:
        """The program with half-spaces A v >= b."""
        lower, upper = self.bounds
        boxed = self.layout.boxed
        box = self.chart.y_free[boxed]
        cap = self._cap(len(b), yields)
        return CondensedProgram(self.chart.boxed, lower[boxed] - box, upper[boxed] - box, A, b, cap)

    def solve(self, program: CondensedProgram, active: IntArray) -> Held | None:
        """Solve it from an active set; see `ActiveSetSolver.solve`."""
        with self.watch.inside:
            held = self._qp.solve(program, active)
        self.finished["daqp"] += held is not None
        return held

    def consistent(self, program: CondensedProgram, held: Held, tolerance: float) -> bool:
        """See `ActiveSetSolver.consistent`."""
        return self._qp.consistent(program, held, tolerance)

    def rolled(
        self, inputs: FloatArray, s: FloatArray, guess: FloatArray | None = None
    ) -> tuple[FloatArray, Rolled]:
        """Clip inputs (N, nu) and sizes (M,) to their bounds and roll out; return y, and how."""
        problem, size = self.problem, self.problem.size
        inputs = problem.limited(inputs, self.data.u_last)
        if self.layout.moving:
            s = np.minimum(np.maximum(s, size.lower), size.upper)
        rolled = self.condensed.rolled(inputs, guess)
        return self._outputs(rolled, s), rolled

    def _outputs(self, rolled: Rolled, s: FloatArray) -> FloatArray:
        return self.layout.outputs(self.data, rolled.positions, s, rolled.inputs, rolled.deviations)

    def start(
        self,
        inputs: FloatArray,
        s: FloatArray,
        conflicts: Conflicts | None,
        guess: FloatArray | None = None,
    ) -> Point:
        """The plan of inputs (N, nu) and sizes (M,), on which nothing pushes."""
        known = self._begun
        if known is not None and np.array_equal(known[0], inputs) and np.array_equal(known[1], s):
            y, rolled = known[2]
        else:
            y, rolled = self.rolled(inputs, s, guess)
        self._begun = inputs, s, (y, rolled)
        pushed = None
        if conflicts is not None:
            nothing = np.zeros(len(conflicts.point))
            pushed = Pushed(conflicts.tangent(y), nothing, nothing, conflicts)
        return self.certify(y, rolled, np.zeros(self.layout.size - self.layout.boxed.start), pushed)

    def point(self, conflicts: Conflicts | None, held: Held) -> Point:
        """Roll a solution out and certify it against the original problem."""
        bounds = len(self.chart.boxed)
        y = self.chart.y(held.v)
        y, rolled = self.rolled(self.inputs(y), y[self.layout.s], self.chart.guess(held.v))
        pushed = None
        if conflicts is not None:
            with self.watch.linearising:
                tangent = conflicts.tangent(y)
            slack = np.where(held.capped[bounds:], np.maximum(-tangent.g, 0.0), 0.0)
            pushed = Pushed(tangent, held.force[bounds:], slack, conflicts)
        return self.certify(y, rolled, held.force[:bounds], pushed)

    def certify(
        self, y: FloatArray, rolled: Rolled, reaction: FloatArray, pushed: Pushed | None
    ) -> Point:
        """See `Certificate.certify`."""
        return self._certificate.certify(y, rolled, reaction, pushed, self.bounds)

    def costates(
        self, rolled: Rolled, e: FloatArray, reaction: FloatArray, pushed: Pushed | None
    ) -> tuple[FloatArray, FloatArray]:
        """Multipliers nu (N, nx) and forces (C d,) on positions; see `Certificate.costates`."""
        nu = self._certificate.costates(rolled, self._certificate.track(e), reaction, pushed)[0]
        phi = np.zeros(self.layout.p.stop)
        if pushed is not None:
            phi = pushed.on(self.layout.size)[self.layout.p]
        return nu, phi

    def merit(self, cost: float, slack: float, excess: FloatArray) -> float:
        """Cost and the penalties on all slack [m] and on the states' excess."""
        merit = cost + self.problem.slack_weight * slack
        if len(excess):
            merit += self.problem.state_slack_weight * float(excess.sum())
        return merit

    def _cap(self, pairs: int, yields: Yielding) -> FloatArray | None:
        """Largest forces (nf + K,) on a program's constraints; None for firm ones."""
        if yields is Yielding.NOBODY:
            return None
        cap = np.full(len(self.chart.boxed) + pairs, np.inf)
        cap[self.layout.yielding] = self.problem.state_slack_weight
        if yields is Yielding.EVERYBODY:
            cap[len(self.chart.boxed) :] = self.problem.slack_weight
        return cap
