"""Sequential convex programming on the condensed problem: the fast way for linear robots.

    free plan, if it is clear of every obstacle: nothing can be better
    else, from the nominal plan,
    repeat:  half-spaces about y -> condensed program -> active-set method, from the last active set
             -> the sum of the convex steps to come (curvature.py), if they tend somewhere
             -> KKT residual of the original problem
    until    that residual is below the tolerance, or the iterations run out

Pairs of obstacle and stage that are far away stay out of the program and are rechecked after it.
"""

from collections import Counter
from collections.abc import Sequence
from functools import partial

import numpy as np

from scp_mpc.arrays import BoolArray, FloatArray, IntArray
from scp_mpc.problem import Problem
from scp_mpc.settings import Settings
from scp_mpc.solver.active_set import ActiveSetSolver, CondensedProgram, Held
from scp_mpc.solver.certificate import Certificate, Point, Pushed
from scp_mpc.solver.condensed import Condensed
from scp_mpc.solver.conflicts import Conflicts, Tangent
from scp_mpc.solver.curvature import summed
from scp_mpc.solver.descent import Descent, Glimpse, hopeless, judge
from scp_mpc.solver.iterate import Iterate, Multipliers, moved
from scp_mpc.solver.sides import Passing, same_way
from scp_mpc.solver.step_data import StepData
from scp_mpc.solver.stopwatch import Stopwatch

_NEAR = 2.0  # [m] beyond the no-go set; pairs farther off stay out of the program
_STRIDE = 4.0  # where convex steps lead away, how far ahead of them to look, and again
_NEGLIGIBLE = 1e-6  # [cost / m or unit of input] forces of the guess that are not active
_ALIKE = 0.01  # relative difference of cost of plans that may become the same
_SURPLUS = 0.01  # of the tolerance: worth one more iteration, whose convergence is quadratic
_ROUNDING = 1e-9  # violation of a linearised constraint that is none


class CondensedSCP:
    """Solves control steps of a problem with linear dynamics and a positive definite Hessian.

    Usage: `begin` a step; then `unhindered`, `free` and `descend` as often as wanted.

    Attributes:
        step: The control step at hand.
        watch: Where its time goes.
        finished: Programs solved in it, by solver.
    """

    def __init__(self, problem: Problem, settings: Settings, condensed: Condensed) -> None:
        """Set up the solver of the condensed programs."""
        self._problem, self._tolerance = problem, settings.tolerance
        self._condensed = condensed
        self._certificate = Certificate(problem, condensed)
        self._qp = ActiveSetSolver(condensed.response[condensed.boxed])
        self._least, self._most = condensed.lower[condensed.boxed], condensed.upper[condensed.boxed]
        self._none = np.zeros((0, condensed.response.shape[1])), np.zeros(0)
        self._relaxed = np.zeros(condensed.boxed.stop - condensed.boxed.start)

    @classmethod
    def of(cls, problem: Problem, settings: Settings) -> "CondensedSCP | None":
        """Condense a problem; None where the inputs' Hessian is singular."""
        try:
            return cls(problem, settings, Condensed(problem))
        except np.linalg.LinAlgError:
            return None

    def begin(self, step: StepData, watch: Stopwatch) -> None:
        """Read a control step and find the plan that nothing constrains."""
        self.step, self.watch = step, watch
        self.finished: Counter[str] = Counter()
        with watch.solving:
            self._free = self._condensed.start(step.x0, step.x_ref)
            box = self._free[self._condensed.boxed]
            self._room = self._least - box, self._most - box
        self._bounded: tuple[FloatArray, FloatArray] | None = None

    def unhindered(self) -> Descent | None:
        """The plan that ignores the obstacles, if it is clear of them all: none costs less."""
        y, reaction = self._within_bounds()
        if self.step.within(self._path(y), y[self._condensed.s], 0.0) is not None:
            return None
        point = self._certificate.certify(*self._certificate.rolled_out(y), reaction, None)
        if point.residuals.worst > self._tolerance:
            return None
        return self._ended(point, np.inf, 0)

    def free(self) -> Iterate:
        """The plan that ignores the obstacles, which may not be clear of them."""
        y, reaction = self._within_bounds()
        point = self._certificate.certify(*self._certificate.rolled_out(y), reaction, None)
        return self._iterate(point, np.inf)

    def glimpses(self, best: Iterate, paths: Sequence[FloatArray]) -> list[Glimpse]:
        """Solve one program about each path (N, d), all linearised at once.

        A plan costs |v|^2 / 2 more than the one that nothing constrains.
        """
        if not paths:
            return []
        step, position = self.step, self._problem.model.position
        whole = np.empty((len(paths), len(step.x_ref), len(position)))
        whole[:, 0], whole[:, 1:] = step.x0[position], paths
        conflicts = Conflicts(step, self._condensed, self._near(whole, best.s))
        with self.watch.linearising:
            a, b = conflicts.about(whole, best.s)
        with self.watch.solving:
            A = np.einsum("ckw,kwn->ckn", a, conflicts.response)
            b -= (a * self._free[conflicts.at]).sum(axis=2)
        bounds = self._active_bounds(best)
        return [
            self._glimpse(self._program(rows, least), bounds, conflicts, best, path)
            for rows, least, path in zip(A, b, paths, strict=True)
        ]

    def _glimpse(
        self,
        program: CondensedProgram,
        bounds: IntArray,
        conflicts: Conflicts,
        best: Iterate,
        path: FloatArray,
    ) -> Glimpse:
        shape, position = (self.step.count, len(path)), self._problem.model.position
        with self.watch.solving, self.watch.inside:
            end = self._qp.glimpse(program, bounds)
        if end is None:
            return Glimpse(np.inf, np.zeros(shape, np.bool_), partial(moved, best, position, path))
        self.finished["daqp"] += 1
        v, pushing = end
        seen = self._path(self._free + self._condensed.response @ v)[1:]
        touched = conflicts.table(pushing, 0.0, *shape) > 0
        return Glimpse(float(v @ v) / 2, touched, partial(moved, best, position, seen))

    def _near(self, paths: FloatArray, s: FloatArray) -> BoolArray:
        """Pairs that some path (C, N+1, d) or the free plan comes near to."""
        near = np.zeros((self.step.count, self._problem.horizon), dtype=np.bool_)
        for path in (*paths, self._path(self._within_bounds()[0])):
            more = self.step.within(path, s, _NEAR, known=near)
            near = near if more is None else near | more
        return near if near.any() else ~near

    def descend(
        self, nominal: Iterate, limit: int, goal: Descent | None = None
    ) -> Descent | None:
        """Descend from a nominal plan; None if a program could not be solved.

        Args:
            nominal: Where to begin.
            limit: Iterations at most.
            goal: Give up, with None, when it is plain that this plan will not be reached.
        """
        c, step, path = self._condensed, self.step, nominal.states[1:] - self.step.x_ref[1:]
        p = path[:, self._problem.model.position]
        y = np.concatenate([p.ravel(), nominal.inputs.ravel(), nominal.s])
        near = touched = nominal.touched[: step.count]
        bounds, total = self._active_bounds(nominal), 0
        while True:
            more = step.within(self._path(y), y[c.s], _NEAR)
            near = near if more is None else near | more
            if not near.any():
                near = ~near
            conflicts = Conflicts(step, c, near)
            active = np.concatenate([bounds, -touched[near].astype(np.intp)])
            end = self._converge(conflicts, y, active, limit - total, goal)
            if end is None:
                return None
            point, active, cap, iterations = end
            total += iterations
            y, bounds = point.y, active[: len(bounds)]
            missed = step.within(self._path(y), y[c.s], 0.0, known=near)
            if missed is None or total >= limit:
                return self._ended(point, cap, total)
            touched = conflicts.table(active[len(bounds) :], 0.0, *near.shape) < 0

    def _converge(
        self,
        conflicts: Conflicts,
        y: FloatArray,
        active: IntArray,
        limit: int,
        goal: Descent | None,
    ) -> tuple[Point, IntArray, float, int] | None:
        """Repeat convex step, summed step and certificate about some pairs."""
        tangent, cap, before, point = conflicts.tangent(y), np.inf, np.inf, None
        bold, leap = True, 0  # whether to sum; leaps taken in a row
        for iteration in range(1, limit + 1):
            with self.watch.solving:
                program = self._convex(conflicts, tangent)
                held = self._solve(program, active, cap)
            if held is None and goal is not None and goal.status.ok:
                return None  # a plan with slack never beats one without
            if held is None and cap == np.inf:
                cap = self._problem.slack_weight  # nobody found a plan within all half-spaces
                held = self._solve(program, active, cap)
            if held is None:
                return None
            ahead = self._summed(conflicts, tangent, program, held, leap) if bold else None
            end = self._certified(conflicts, ahead if isinstance(ahead, Held) else held)
            if leap and point is not None and self._merit(end) > self._merit(point):
                tangent, leap, bold = point.pushed.tangent, 0, False  # back to before the leap
                continue
            point, active, residual = end, held.active, end.residuals.worst
            certified = residual <= self._tolerance
            if residual <= _SURPLUS * self._tolerance or (certified and before <= self._tolerance):
                break
            if goal is not None and (
                hopeless(iteration, point.cost, goal) or self._arrives(point, goal)
            ):
                return None
            bold = not isinstance(ahead, Held) or residual < before / 2
            before, tangent = residual, point.pushed.tangent
            leap = leap + 1 if isinstance(ahead, np.ndarray) else 0
            if isinstance(ahead, np.ndarray):
                tangent = conflicts.tangent(ahead)
        return None if point is None else (point, active, cap, iteration)

    def _merit(self, point: Point) -> float:
        slack = 0.0 if point.pushed is None else float(point.pushed.slack.sum())
        return point.cost + self._problem.slack_weight * slack

    def _convex(self, conflicts: Conflicts, tangent: Tangent) -> CondensedProgram:
        """The convex subproblem about a tangent."""
        A = np.einsum("kw,kwn->kn", tangent.a, conflicts.response)
        away = (tangent.y - self._free)[conflicts.at]
        return self._program(A, (tangent.a * away).sum(axis=1) - tangent.g)

    def _program(self, A: FloatArray, b: FloatArray) -> CondensedProgram:
        """A program with the given half-spaces."""
        return CondensedProgram(*self._room, A, b)

    def _solve(self, program: CondensedProgram, active: IntArray, cap: float) -> Held | None:
        with self.watch.inside:
            held = self._qp.solve(program, active, cap)
        self.finished["daqp"] += held is not None
        return held

    def _summed(
        self,
        conflicts: Conflicts,
        tangent: Tangent,
        program: CondensedProgram,
        held: Held,
        leap: int,
    ) -> Held | FloatArray | None:
        """The sum of the convex steps to come; or if it breaks constraints, or the steps lead away,
        only where to linearise next.
        """
        bounds = len(held.force) - len(tangent.g)
        pairs = np.flatnonzero(held.force[bounds:] > _NEGLIGIBLE)
        if not len(pairs):
            return None
        root = np.sqrt(held.force[bounds + pairs])
        L = conflicts.bend(tangent)[pairs] * root[:, None, None]
        bends = np.einsum("kwm,kwn->kmn", L, conflicts.response[pairs])
        moved = self._free + self._condensed.response @ held.v - tangent.y
        turned = np.einsum("kwm,kw->km", L, moved[conflicts.at[pairs]])
        bold = summed(held, bends.reshape(-1, bends.shape[-1]), turned.ravel())
        if bold is not None and self._qp.consistent(program, bold, _ROUNDING):
            return bold
        y = tangent.y + moved + _STRIDE ** (leap + 1) * moved
        if bold is not None:
            y = self._free + self._condensed.response @ bold.v
        return np.clip(y, self._condensed.lower, self._condensed.upper)

    def _arrives(self, point: Point, goal: Descent) -> bool:
        """Whether a point is about to end where the goal is: at its cost, and the same way."""
        if abs(point.cost - goal.cost) > _ALIKE * goal.cost or point.pushed is None:
            return False
        count, horizon = self.step.count, self._problem.horizon
        position = self._problem.model.position
        forces = point.pushed.conflicts.table(point.pushed.force, 0.0, count, horizon)
        mine = Passing(self._path(point.y)[1:], forces > _NEGLIGIBLE)
        theirs = Passing(goal.iterate.states[1:, position], goal.iterate.touched[:count])
        return same_way(self.step, mine, theirs)

    def _within_bounds(self) -> tuple[FloatArray, FloatArray]:
        """The free plan's y and the forces of its bounds."""
        c, y = self._condensed, self._free
        if self._bounded is None:
            if (self._room[0] <= 0).all() and (self._room[1] >= 0).all():
                self.finished["kkt"] += 1
                self._bounded = y, self._relaxed
            else:
                nobody = self._relaxed.astype(np.intp)
                with self.watch.solving:
                    held = self._solve(self._program(*self._none), nobody, np.inf)
                self._bounded = (
                    (y, self._relaxed) if held is None else (y + c.response @ held.v, held.force)
                )
        return self._bounded

    def _path(self, y: FloatArray) -> FloatArray:
        """(N+1, d) positions of the robot in y, from now on [m]."""
        position = self._problem.model.position
        path = self.step.x_ref[:, position]
        path[0] = self.step.x0[position]
        path[1:] += y[self._condensed.p].reshape(-1, len(position))
        return path

    def _certified(self, conflicts: Conflicts, held: Held) -> Point:
        c = self._condensed
        bounds = c.boxed.stop - c.boxed.start
        y, e = self._certificate.rolled_out(self._free + c.response @ held.v)
        with self.watch.linearising:
            tangent = conflicts.tangent(y)
        slack = np.where(held.capped[bounds:], np.maximum(-tangent.g, 0.0), 0.0)
        pushed = Pushed(tangent, held.force[bounds:], slack, conflicts)
        return self._certificate.certify(y, e, held.force[:bounds], pushed)

    def _active_bounds(self, nominal: Iterate) -> IntArray:
        """Which bounded entries a nominal plan holds: -1 at lower, 1 at upper bounds."""
        active = np.zeros(len(self._relaxed), dtype=np.intp)
        duals = nominal.multipliers
        if duals is not None:
            forces = np.concatenate([duals.inputs.ravel(), duals.margin])[: len(active)]
            active[forces < -_NEGLIGIBLE], active[forces > _NEGLIGIBLE] = -1, 1
        return active

    def _ended(self, point: Point, cap: float, iterations: int) -> Descent:
        slack = 0.0 if point.pushed is None else point.pushed.slack
        return Descent(
            lambda: self._iterate(point, cap),
            point.cost,
            point.cost + self._problem.slack_weight * float(np.sum(slack)),
            point.residuals,
            judge(point.residuals, float(np.max(slack, initial=0.0)), self._tolerance),
            iterations,
        )

    def _iterate(self, point: Point, cap: float) -> Iterate:
        """Name the parts of a point in the words of the problem."""
        problem, c, step = self._problem, self._condensed, self.step
        N, M = problem.horizon, problem.max_obstacles
        states = np.empty_like(step.x_ref)
        states[0] = step.x0
        np.add(step.x_ref[1:], point.deviations, out=states[1:])
        slack, forces = np.zeros((M, N)), np.zeros((M, N))
        margin = -point.reaction[N * problem.model.nu :]
        if point.pushed is not None:
            pairs, force = point.pushed.conflicts, point.pushed.force
            slack[pairs.obstacle, pairs.stage] = point.pushed.slack
            forces[pairs.obstacle, pairs.stage] = force
            if not c.moving_sizes:  # the bound takes whatever pushes a size that cannot move
                pull = force * point.pushed.tangent.a[:, -1]
                margin = np.bincount(pairs.obstacle, weights=pull, minlength=M)
        elif not c.moving_sizes:
            margin = np.zeros(M)
        inputs = point.reaction[: N * problem.model.nu].reshape(N, -1)
        pins = forces if cap == np.inf else forces - cap
        return Iterate(
            states,
            point.y[c.u].reshape(inputs.shape),
            point.y[c.s],
            slack,
            Multipliers(point.costates, -inputs, margin, -forces, pins),
        ).frozen()
