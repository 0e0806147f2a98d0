"""One control step in numbers: what the loop reads, writes, has solved and certified.

Notation as in `layout.py`, `condensing.py`, `pairs.py` and `certificate.py`.
"""

from collections import Counter
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from scp_mpc.arrays import BoolArray, FloatArray, IntArray
from scp_mpc.deadline import Clock
from scp_mpc.problem import Problem
from scp_mpc.qp.active_set import CondensedQP, QPSolution, Settled, settled
from scp_mpc.qp.backend import Rows
from scp_mpc.scp.certificate import Certificate, Nominal, least_curvature
from scp_mpc.scp.condensing import Condensed, Condenser, Rollout
from scp_mpc.scp.iterate import NEGLIGIBLE, Iterate, Multipliers
from scp_mpc.scp.layout import Layout
from scp_mpc.scp.nodes import Nodes, NonlinearNodes
from scp_mpc.scp.pairs import Pairs, Planes
from scp_mpc.scp.step import Step
from scp_mpc.scp.subproblem import Subproblem
from scp_mpc.settings import Settings

_REPAIRS = 10  # of the bounds of a plan that ignores the obstacles
_MOVED = 1e-6  # of a state, in its own unit: the robot is not where the guess has it
_TOUCH = 1e-7  # distance to a constraint that counts as none
_ROUNDING = 1e-10  # of a bounded entry, in its own unit
_NEAR = 2.0  # [m] beyond the no-go set; pairs farther off stay out of the programs
_HARD = 10.0  # price of a hard state's excess in merits, times that of slack


class Relaxation(IntEnum):
    """Which constraints are relaxed where they cannot all be met.

    STATES: soft states yield, the others as far as full braking takes them. ALL: obstacles, too.
    """

    NONE = 0
    STATES = 1
    ALL = 2


@dataclass(frozen=True, eq=False)
class Program:
    """A convex subproblem, condensed and sparse.

    Attributes:
        condensed: The problem that it was condensed from.
        pairs: Whose half-spaces it holds.
        planes: These.
        relaxation: Who may give way.
        qp: Its values, condensed.
        subproblem: Holds its values as a sparse program, and the solver.
        rows: Which row of that is which constraint.
    """

    condensed: Condensed
    pairs: Pairs
    planes: Planes
    relaxation: Relaxation
    qp: CondensedQP
    subproblem: Subproblem
    rows: Rows


class Transcription:
    """Turns control steps into programs, and their solutions into certified plans.

    Usage: `begin` a step; everything else then belongs to it.

    Args:
        problem: The problem.
        settings: Who solves its programs.
        nodes: Where plans are constrained.

    Attributes:
        linear: Whether the robot is linear.
        step: The control step, with radii and sizes as they count just now.
        no_pairs: No pairs at all.
        obstacle_free: The plan that ignores the obstacles, where another one was found.
        suspected: Whether the log has it that the model's derivatives seem wrong.
    """

    suspected = False
    step: Step
    no_pairs: Pairs
    obstacle_free: Iterate | None

    def __init__(self, problem: Problem, settings: Settings, nodes: Nodes) -> None:
        """Condense the problem, lay the programs out and set up their solvers."""
        self.problem, self.settings, self.nodes = problem, settings, nodes
        self.layout = Layout(problem, nodes)
        self.condenser = Condenser(problem, nodes, self.layout)
        self.linear = self.condenser.linear
        self.hard, self.elastic = (
            Subproblem(problem, nodes, self.layout, settings, elastic) for elastic in (False, True)
        )
        self._certificate = Certificate(problem, self.layout)
        self._full = np.full(problem.max_obstacles, problem.size.reference)
        prices = problem.state_slack_weight, _HARD * problem.slack_weight
        self._prices = np.tile(np.where(problem.soft_rows, *prices), problem.horizon)

    def begin(self, step: Step, clock: Clock) -> None:
        """Read a control step."""
        self.step, self.clock, self.obstacle_free = step, clock, None
        self.condenser.begin(step)
        self.bounds = self.layout.bounds(step)
        self._strict = self.layout.bounds(step, "outside") if step.is_outside else self.bounds
        self._braked: tuple[FloatArray, FloatArray] | None = None
        self.no_pairs = Pairs(step, self.layout, np.zeros(step.radii.shape, dtype=np.bool_))
        for subproblem in (self.hard, self.elastic):
            subproblem.solver.finished, subproblem.about = Counter(), None

    @property
    def finished(self) -> Counter[str]:
        """Programs of this step by who finished them."""
        return self.hard.solver.finished + self.elastic.solver.finished

    # --- plans

    def path(self, y: FloatArray) -> FloatArray:
        """(C+1, d) positions of the robot in y, from now on [m]."""
        return self.step.path(y[self.layout.p])

    def rolled(
        self, inputs: FloatArray, s: FloatArray, guess: FloatArray | None = None
    ) -> tuple[FloatArray, Rollout]:
        """Clip inputs (N, nu) and sizes (M,) to their bounds and roll out; return y, and how."""
        size = self.problem.size
        inputs = self.problem.limited(inputs, self.step.u_last)
        if self.layout.moving:
            s = np.minimum(np.maximum(s, size.lower), size.upper)
        rollout = self.condenser.rolled(inputs, guess)
        e = rollout.deviations
        return self.layout.outputs(self.step, rollout.positions, s, inputs, e), rollout

    def nominal(
        self,
        y: FloatArray,
        rollout: Rollout,
        reaction: FloatArray,
        pairs: Pairs,
        force: FloatArray,
        relaxed: BoolArray | None = None,
        relaxation: Relaxation = Relaxation.NONE,
    ) -> Nominal:
        """A plan with its residuals; see `Certificate.certify`. Nobody yields unless `relaxed`."""
        planes = pairs.planes(y)
        slack = np.zeros(len(force)) if relaxed is None else np.maximum(-planes.g, 0.0) * relaxed
        given = y, rollout, reaction, pairs, planes, force, slack
        return self._certificate.certify(*given, self.bounds, self.relaxed_bounds(relaxation))

    def plain(self, inputs: FloatArray, guess: FloatArray | None = None) -> Nominal:
        """A plan of inputs (N, nu) on which nothing pushes, obstacles left out."""
        y, rollout = self.rolled(inputs, self._full, guess)
        nothing = np.zeros(self.layout.size - self.layout.boxed.start)
        return self.nominal(y, rollout, nothing, self.no_pairs, np.zeros(0))

    def at(
        self, iterate: Iterate, near: BoolArray | None = None, about: FloatArray | None = None
    ) -> Nominal:
        """An iterate's inputs, rolled out from the state now, with its multipliers.

        Args:
            iterate: The iterate.
            near: (J, C) pairs to look at; None for those near to it.
            about: (ny,) another point, pairs near to which are to be looked at, too.
        """
        inputs, guess = iterate.inputs, iterate.states[1:] - self.step.x_ref[1:]
        moved = np.abs(self.step.x0 - iterate.states[0]).max() > _MOVED
        if moved and not self.linear:
            inputs, guess = self.condenser.tracking(iterate.states, inputs)
        y, rollout = self.rolled(inputs, iterate.s, guess)
        if near is None:
            near = self.near(y, iterate.touched[: self.step.count])
            near = near if about is None else self.near(about, near)
        pairs, duals = Pairs(self.step, self.layout, near), iterate.multipliers
        reaction = np.zeros(self.layout.size - self.layout.boxed.start)
        force = np.zeros(len(pairs.node))
        if duals is not None:
            reaction = self._reaction(duals)
            force = -duals.obstacles[pairs.obstacle, pairs.node]
        return self.nominal(y, rollout, reaction, pairs, force)

    def obstacle_free_optimum(self, guess: Iterate | None) -> Nominal | None:
        """A linear robot's plan that ignores the obstacles, from the bounds where another one is.

        No more than a few linear systems: the program has only bounds, and few of them change from
        step to step. None where that does not lead to it.
        """
        rest = np.tile(self.problem.model.equilibrium_input, (self.problem.horizon, 1))
        condensed = self.condenser.condensed(self.condenser.rolled(rest), self._full)
        free, box = condensed.y_free, self.layout.boxed
        lower, upper = self.relaxed_bounds(Relaxation.NONE)
        if (lower[box] <= free[box]).all() and (upper[box] >= free[box]).all():
            self.hard.solver.finished["kkt"] += 1
            return _convex(self.plain(free[self.layout.u].reshape(rest.shape)))
        planes = self.no_pairs.planes(free)
        qp = self.condensed_qp(condensed, self.no_pairs, planes)
        active = np.zeros(len(qp.F), dtype=np.intp)
        if guess is not None and guess.multipliers is not None:
            active[:] = -np.sign(self._reaction(guess.multipliers))
        most, began = self.clock.room("repair", _REPAIRS, then="iteration"), self.clock.mark()
        end = settled(qp, active, np.zeros(len(active), dtype=np.bool_), most)
        self.clock.learn("repair", began, end.systems)
        self.clock.charge("solve")
        if end.solution is None:
            return None
        self.hard.solver.finished["kkt"] += 1
        given = condensed, self.no_pairs, planes, Relaxation.NONE, qp, self.hard
        return _convex(
            self.certify(Program(*given, Rows(np.zeros(0, dtype=np.intp))), end.solution)
        )

    def outputs(self, iterate: Iterate) -> FloatArray:
        """Y (ny,) of an iterate's own states, which need not be where its inputs lead."""
        positions = self.nodes.positions(iterate.states, iterate.inputs) - self.step.here
        e = iterate.states[1:] - self.step.x_ref[1:]
        return self.layout.outputs(self.step, positions, iterate.s, iterate.inputs, e)

    def merit(self, cost: float, slack: float, excess: FloatArray) -> float:
        """Cost and the penalties on all slack [m] and on the states' excess."""
        merit = cost + self.problem.slack_weight * slack
        return merit + float(self._prices @ excess) if len(excess) else merit

    # --- which obstacles are near

    def near(self, y: FloatArray, known: BoolArray) -> BoolArray:
        """Pairs (J, C) in `known` or near to a plan; if there is none, all."""
        more = self.step.within(self.path(y), y[self.layout.s], _NEAR, known=known)
        near = known if more is None else known | more
        return near if near.any() else ~near

    def screen(self, plan: Nominal) -> Pairs | None:
        """The pairs that a program should have held; None if its plan violates none without.

        A plan without any pairs ignores the obstacles on purpose.
        """
        near = plan.pairs.near
        if not near.any():
            return None
        missed = self.step.within(self.path(plan.y), plan.y[self.layout.s], 0.0, known=near)
        if missed is None:
            return None
        return Pairs(self.step, self.layout, self.near(plan.y, near | missed))

    def with_pairs(self, plan: Nominal, pairs: Pairs) -> Nominal:
        """The same plan with other pairs, which include those that push."""
        at = pairs.obstacle, pairs.node
        force, slack = (plan.pairs.table(values)[at] for values in (plan.force, plan.slack))
        return self.nominal(plan.y, plan.rollout, plan.reaction, pairs, force, slack > 0)

    # --- programs

    def linearise(self, nominal: Nominal) -> Condensed:
        """The problem condensed about a plan."""
        condensed = self.condenser.condensed(nominal.rollout, nominal.y[self.layout.s])
        self.clock.charge("linearise")
        return condensed

    def write(
        self,
        nominal: Nominal,
        condensed: Condensed,
        planes: Planes,
        relaxation: Relaxation = Relaxation.NONE,
        radius: FloatArray | None = None,
        qp: CondensedQP | None = None,
    ) -> Program:
        """Write the convex program about a plan: its values, condensed and sparse.

        Args:
            nominal: The plan, whose pairs the program holds.
            condensed: The problem condensed about it.
            planes: Half-spaces of its pairs.
            relaxation: Who may give way.
            radius: (N nu,) by how much inputs may change at most, or None.
            qp: Its condensed values, if they are known.
        """
        pairs, along = nominal.pairs, condensed.about.along
        if qp is None:
            qp = self.condensed_qp(condensed, pairs, planes, relaxation, radius)
        subproblem = self.hard if relaxation is Relaxation.NONE else self.elastic
        if subproblem.about is None or not (self.linear or subproblem.about is condensed.about):
            subproblem.write_dynamics(condensed.about)
        free = condensed.y_free[self.layout.boxed]
        subproblem.write_bounds(qp.lower + free, qp.upper + free, self.step.u_last)
        everybody = relaxation is Relaxation.ALL
        rows = subproblem.write_half_spaces(pairs, planes, along, everybody)
        self.clock.charge("update")
        return Program(condensed, pairs, planes, relaxation, qp, subproblem, rows)

    def condensed_qp(
        self,
        condensed: Condensed,
        pairs: Pairs,
        planes: Planes,
        relaxation: Relaxation = Relaxation.NONE,
        radius: FloatArray | None = None,
    ) -> CondensedQP:
        """The condensed values of a convex program; arguments as for `write`."""
        c, by = self.layout, condensed.by
        A = np.einsum("kw,kwn->kn", planes.a, pairs.rows(by.S))
        b = (planes.a * (planes.y - condensed.y_free)[pairs.at]).sum(axis=1) - planes.g
        lower, upper = (bound[c.boxed] for bound in self.relaxed_bounds(relaxation))
        if radius is not None:
            lower, upper, u = lower.copy(), upper.copy(), condensed.about.inputs.ravel()
            lower[c.inputs] = np.maximum(lower[c.inputs], u - radius)
            upper[c.inputs] = np.minimum(upper[c.inputs], u + radius)
        l1_weight = None
        if relaxation is not Relaxation.NONE:
            l1_weight = np.full(len(lower) + len(b), np.inf)
            l1_weight[c.soft] = self.problem.state_slack_weight
            if relaxation is Relaxation.ALL:
                l1_weight[len(lower) :] = self.problem.slack_weight
        free = condensed.y_free[c.boxed]
        return CondensedQP(
            by.bounded, lower - free, upper - free, A, b, by.unbox, l1_weight, condensed.least
        )

    def start(self, program: Program, nominal: Nominal) -> tuple[FloatArray, FloatArray]:
        """Where a program's solver starts: at a plan and its multipliers."""
        plan, force = nominal.rollout, np.concatenate([nominal.reaction, nominal.force])
        given = plan.deviations, plan.inputs, nominal.y[self.layout.s], nominal.costates, force
        return program.subproblem.start(*given)

    def solve(self, program: Program, nominal: Nominal) -> Settled:
        """Solve a program from a plan and its multipliers."""
        start, solver = self.start(program, nominal), program.subproblem.solver
        end = solver.solve(program.qp, program.rows, start, self.clock)
        self.clock.charge("solve")
        return end

    def next_relaxation(self, relaxation: Relaxation, hard: bool) -> Relaxation | None:
        """Who is to give way next; None if nobody is left: hard obstacles never do."""
        if relaxation is Relaxation.NONE and self._states_yield():
            return Relaxation.STATES
        return Relaxation.ALL if relaxation is not Relaxation.ALL and not hard else None

    def relaxed_bounds(self, relaxation: Relaxation) -> tuple[FloatArray, FloatArray]:
        """Bounds (ny,) of y in a program of some kind."""
        if relaxation is Relaxation.NONE or not self.layout.limits_states:
            return self._strict
        if self._braked is None:
            self._braked = self.layout.bounds(self.step, "all")
        return self._braked

    def _states_yield(self) -> bool:
        braked = self.relaxed_bounds(Relaxation.STATES)
        return len(self.layout.soft) > 0 or not all(map(np.array_equal, self._strict, braked))

    def certify(self, program: Program, solution: QPSolution) -> Nominal:
        """Roll a solution out and certify it against the original problem."""
        nf, condensed, c = len(program.qp.F), program.condensed, self.layout
        y = condensed.y(solution.v)
        boxed = y[c.boxed]
        for bound in self.relaxed_bounds(program.relaxation):  # met exactly, not nearly
            near = np.abs(boxed - bound[c.boxed]) <= _ROUNDING
            boxed[near] = bound[c.boxed][near]
        guess = None if self.linear else condensed.deviations(solution.v)
        y, rollout = self.rolled(y[c.u].reshape(c.shape), y[c.s], guess)
        force, relaxed = solution.force[nf:], solution.relaxed[nf:]
        given = y, rollout, solution.force[:nf], program.pairs, force, relaxed, program.relaxation
        plan = self.nominal(*given)
        self.clock.charge("linearise")
        return plan

    # --- curvature

    def curvature_factors(
        self, program: Program, force: FloatArray
    ) -> tuple[FloatArray, IntArray, FloatArray]:
        """How the half-spaces that push bend, each times the root of its force.

        Returns:
            L (q, nv) in condensed coordinates; which pairs push; L (k, w, d-1) on outputs.
        """
        pairs, planes = program.pairs, program.planes
        if not len(force):
            none, d = np.zeros((0, program.qp.F.shape[1])), self.problem.model.dim
            return none, np.zeros(0, dtype=np.intp), np.zeros((0, d + 1, d - 1))
        push = (force > NEGLIGIBLE).nonzero()[0]
        L = pairs.curvature_factor(planes)[push] * np.sqrt(force[push])[:, None, None]
        rows = pairs.rows(program.condensed.by.S)[push]
        factors = np.einsum("kwm,kwn->kmn", L, rows)
        return factors.reshape(-1, factors.shape[-1]), push, L

    def curvature(self, program: Program, solution: QPSolution) -> FloatArray:
        """W (nv, nv): what the convex program leaves out of the Lagrangian's second derivative."""
        factors = self.curvature_factors(program, solution.force[len(program.qp.F) :])[0]
        W = self._dynamics_curvature(program, solution)
        return -factors.T @ factors if W is None else W - factors.T @ factors

    def _dynamics_curvature(self, program: Program, solution: QPSolution) -> FloatArray | None:
        """The part (nv, nv) of dynamics and positions; None of a linear robot."""
        if self.linear:
            return None
        nf = len(program.qp.F)
        condensed, certificate = program.condensed, self._certificate
        about, e = condensed.about, condensed.deviations(solution.v)
        phi = certificate.phi(program.pairs, program.planes, solution.force[nf:])
        nu = certificate.costates(about, certificate.track(e), solution.force[:nf], phi)[0]
        on_p = np.zeros(self.layout.p.stop) if phi is None else phi[self.layout.p]
        states = self.step.x_ref.copy()
        states[0] = self.step.x0
        states[1:] += about.deviations
        assert isinstance(self.nodes, NonlinearNodes)
        stages, sway = self.nodes.curvature(states, about.inputs, -nu, -on_p)
        return self._condensed_curvature(condensed, stages, sway)

    def second_order(
        self, plan: Nominal, program: Program, solution: QPSolution
    ) -> tuple[Nominal, FloatArray]:
        """A plan with its least curvature known, and the direction (N, nu) of it in inputs.

        Args:
            plan: The plan.
            program: The program that led to it; at a KKT point the two agree to first order.
            solution: Its solution, which knows the active set.
        """
        qp, by, nf = program.qp, program.condensed.by, len(program.qp.F)
        W = self._dynamics_curvature(program, solution)
        factors = self.curvature_factors(program, solution.force[nf:])[0]
        if W is None and not len(factors):  # nothing but the convex program
            return _convex(plan), np.zeros(self.layout.shape)
        depth, side = qp.violations(solution.v)
        touched = (depth >= -_TOUCH) & (solution.active == 0)  # without a force: weakly active
        indices = np.concatenate([solution.indices, touched.nonzero()[0]])
        towards = -np.where(touched, side, solution.active)[indices]  # where they allow to go
        rows, force = qp.rows[indices] * towards[:, None], np.abs(solution.force[indices])
        least, direction = least_curvature(W, factors, rows, force)
        inputs = by.inverse.T @ direction[: len(by.inverse)]
        residuals = replace(plan.residuals, curvature=least)
        return replace(plan, residuals=residuals), inputs.reshape(self.layout.shape)

    # --- what is handed out

    def _reaction(self, duals: Multipliers) -> FloatArray:
        """Forces (nf,) of the bounds."""
        given = duals.margin, duals.inputs, duals.rates, duals.states
        reaction: FloatArray = -self.layout.gathered(*given)
        return reaction

    def iterate(self, nominal: Nominal, l1_weight: float = np.inf) -> Iterate:
        """Name the parts of a plan in the words of the problem; no force beyond `l1_weight`."""
        problem, c, pairs = self.problem, self.layout, nominal.pairs
        states = self.step.x_ref.copy()
        states[0] = self.step.x0
        states[1:] += nominal.rollout.deviations
        slack, forces = np.zeros((2, problem.max_obstacles, self.nodes.size))
        margin, inputs, rates, limits = c.parted(-nominal.reaction)
        if len(pairs.node):
            slack[pairs.obstacle, pairs.node] = nominal.slack
            forces[pairs.obstacle, pairs.node] = nominal.force
            if not c.moving:  # the bound takes whatever pushes a size that cannot move
                pull = nominal.force * nominal.planes.a[:, -1]
                pulled = np.bincount(pairs.obstacle, weights=pull, minlength=len(margin))
                margin = pulled.astype(np.float64)
        pins = forces - l1_weight if np.isfinite(l1_weight) else forces
        duals = Multipliers(nominal.costates, inputs, margin, -forces, pins, limits, rates)
        s = nominal.y[c.s].copy()
        return Iterate(states, nominal.rollout.inputs, s, slack, duals, self.obstacle_free).frozen()

    def _condensed_curvature(
        self, condensed: Condensed, stages: FloatArray, sway: FloatArray | None
    ) -> FloatArray:
        """Second derivatives (nv, nv) of what stages (N, nx+nu, nx+nu) add up to.

        State 0 is given; the others respond to the inputs by G. `sway` (N,) are second derivatives
        in one of the entries of states 1 .. N, the heading.
        """
        G, back = condensed.by.G, condensed.by.inverse.T
        N, nx, n = G.shape
        x, u, later = slice(nx), slice(nx, None), stages[1:]
        W = np.zeros((n, n))
        W[n // N :] = (later[:, u, x] @ G[:-1]).reshape(-1, n)
        W += W.T
        W += (later[:, x, x] @ G[:-1]).reshape(-1, n).T @ G[:-1].reshape(-1, n)
        if sway is not None:
            turns = G[:, self.problem.model.heading]
            W += (turns * sway[:, None]).T @ turns
        blocks, i = W.reshape(N, n // N, N, n // N), np.arange(N)
        blocks[i, :, i] += stages[:, u, u]
        whole = np.zeros((self.layout.variables,) * 2)
        whole[:n, :n] = back.T @ W @ back
        return whole


def _convex(plan: Nominal) -> Nominal:
    """A plan of a convex problem, whose least curvature is that of its cost."""
    return replace(plan, residuals=replace(plan.residuals, curvature=1.0))
