"""One control step in numbers: what the loop reads, writes, has solved and certified.

Notation as in `layout.py`, `condensing.py`, `pairs.py` and `certificate.py`.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from scp_mpc.arrays import BoolArray, FloatArray, IntArray
from scp_mpc.problem import Problem
from scp_mpc.qp.active_set import CondensedQP, QPSolution
from scp_mpc.qp.backend import Rows
from scp_mpc.scp.certificate import Certificate, Nominal, least_curvature
from scp_mpc.scp.condensing import Condensed, Condenser, Rollout
from scp_mpc.scp.deadline import Clock
from scp_mpc.scp.iterate import NEGLIGIBLE, Iterate, Multipliers
from scp_mpc.scp.layout import Layout
from scp_mpc.scp.nodes import Nodes, NonlinearNodes
from scp_mpc.scp.pairs import Pairs, Planes
from scp_mpc.scp.step import Step
from scp_mpc.scp.subproblem import Subproblem
from scp_mpc.settings import Settings

_TOUCH = 1e-7  # distance to a constraint that counts as none
_ROUNDING = 1e-10  # of a bounded entry, in its own unit
_NEAR = 2.0  # [m] beyond the no-go set; pairs farther off stay out of the programs


class Relaxation(IntEnum):
    """Who gives way where the constraints cannot all be met."""

    NOBODY = 0
    STATES = 1
    EVERYBODY = 2


@dataclass(frozen=True, eq=False)
class Convex:
    """A convex subproblem and its solution.

    Attributes:
        condensed: The problem that it was condensed from.
        pairs: Whose half-spaces it holds.
        planes: These.
        qp: Its values.
        solution: Its solution.
        relaxation: Who gave way.
    """

    condensed: Condensed
    pairs: Pairs
    planes: Planes
    qp: CondensedQP
    solution: QPSolution
    relaxation: Relaxation


class Transcription:
    """Turns control steps into programs, and their solutions into certified plans.

    Usage: `begin` a step; everything else then belongs to it.

    Args:
        problem: The problem.
        settings: Who solves its programs.
        nodes: Where plans are constrained.

    Attributes:
        nobody: No pairs at all.
        free: (N, nu) inputs of the plan that ignores the obstacles; nonlinear robots' only.
    """

    free: FloatArray | None
    nobody: Pairs

    def __init__(self, problem: Problem, settings: Settings, nodes: Nodes) -> None:
        """Condense the problem, lay the programs out and set up their solvers."""
        self.problem, self.settings, self.nodes = problem, settings, nodes
        self.layout = Layout(problem, nodes)
        self.condenser = Condenser(problem, nodes, self.layout)
        self.firm, self.elastic = (
            Subproblem(problem, nodes, self.layout, settings, elastic) for elastic in (False, True)
        )
        self._certificate = Certificate(problem, self.layout)
        self._rest = np.full(problem.max_obstacles, problem.size.reference)

    @property
    def linear(self) -> bool:
        """Whether the robot is linear."""
        return self.condenser.linear

    @property
    def finished(self) -> Counter[str]:
        """Programs solved in this control step, by who finished them."""
        return self.firm.solver.finished + self.elastic.solver.finished

    def begin(self, step: Step, clock: Clock) -> None:
        """Read a control step."""
        self.step, self.clock, self.free = step, clock, None
        self.condenser.begin(step)
        self.bounds = self.layout.bounds(step)
        self.nobody = Pairs(step, self.layout, np.zeros(step.radii.shape, dtype=np.bool_))
        self._written: dict[bool, object] = {}
        for subproblem in (self.firm, self.elastic):
            subproblem.solver.finished = Counter()

    def widen(self, step: Step) -> None:
        """Take other radii or sizes for the step that has begun."""
        self.step = step

    # --- plans

    def path(self, y: FloatArray) -> FloatArray:
        """(C+1, d) positions of the robot in y, from now on [m]."""
        return self.step.path(y[self.layout.p])

    def inputs(self, y: FloatArray) -> FloatArray:
        """The inputs (N, nu) in y."""
        return y[self.layout.u].reshape(self.layout.shape)

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

    def at(
        self, iterate: Iterate, near: BoolArray | None = None, about: FloatArray | None = None
    ) -> Nominal:
        """An iterate's inputs, rolled out from the state now, with its multipliers.

        Args:
            iterate: The iterate.
            near: (J, C) pairs to look at; None for those near to it.
            about: (ny,) another point, pairs near to which are to be looked at, too.
        """
        guess = iterate.states[1:] - self.step.x_ref[1:]
        y, rollout = self.rolled(iterate.inputs, iterate.s, guess)
        if near is None:
            near = self.near(y, iterate.touched[: self.step.count])
            near = near if about is None else self.near(about, near)
        pairs = Pairs(self.step, self.layout, near)
        reaction = np.zeros(self.layout.size - self.layout.boxed.start)
        force = np.zeros(len(pairs.node))
        if iterate.multipliers is not None:
            duals = iterate.multipliers
            reaction = -self.layout.gathered(duals.margin, duals.inputs, duals.rates, duals.states)
            force = -duals.obstacles[pairs.obstacle, pairs.node]
        none = np.zeros(len(force), dtype=np.bool_)
        return self.certify(y, rollout, reaction, pairs, force, none)

    def outputs(self, iterate: Iterate) -> FloatArray:
        """Y (ny,) of an iterate's own states, which need not be where its inputs lead."""
        positions = self.nodes.positions(iterate.states, iterate.inputs) - self.step.here
        e = iterate.states[1:] - self.step.x_ref[1:]
        return self.layout.outputs(self.step, positions, iterate.s, iterate.inputs, e)

    def plain(self, inputs: FloatArray, guess: FloatArray | None = None) -> Nominal:
        """A plan of inputs (N, nu) on which nothing pushes, obstacles left out."""
        y, rollout = self.rolled(inputs, self._rest, guess)
        return self.certify(
            y,
            rollout,
            np.zeros(self.layout.size - self.layout.boxed.start),
            self.nobody,
            np.zeros(0),
            np.zeros(0, dtype=np.bool_),
        )

    def certify(
        self,
        y: FloatArray,
        rollout: Rollout,
        reaction: FloatArray,
        pairs: Pairs,
        force: FloatArray,
        capped: BoolArray,
    ) -> Nominal:
        """See `Certificate.certify`."""
        return self._certificate.certify(y, rollout, reaction, pairs, force, capped, self.bounds)

    def reached(self, convex: Convex, solution: QPSolution) -> Nominal:
        """Roll a solution out and certify it against the original problem."""
        nf, condensed = len(convex.qp.F), convex.condensed
        y = condensed.y(solution.v)
        boxed = y[self.layout.boxed]
        for bound in self.bounds:  # exactly, not nearly
            near = np.abs(boxed - bound[self.layout.boxed]) <= _ROUNDING
            boxed[near] = bound[self.layout.boxed][near]
        guess = None if self.linear else condensed.deviations(solution.v)
        y, rollout = self.rolled(self.inputs(y), y[self.layout.s], guess)
        return self.certify(
            y, rollout, solution.force[:nf], convex.pairs, solution.force[nf:], solution.capped[nf:]
        )

    def merit(self, cost: float, slack: float, excess: FloatArray) -> float:
        """Cost and the penalties on all slack [m] and on the states' excess."""
        merit = cost + self.problem.slack_weight * slack
        if len(excess):
            merit += self.problem.state_slack_weight * float(excess.sum())
        return merit

    # --- screening

    def near(self, y: FloatArray, known: BoolArray) -> BoolArray:
        """Pairs (J, C) in `known` or near to a plan; if there is none, all."""
        more = self.step.within(self.path(y), y[self.layout.s], _NEAR, known=known)
        near = known if more is None else known | more
        return near if near.any() else ~near

    def screened(self, nominal: Nominal) -> Pairs | None:
        """The pairs that a plan's program should have held, if it violates one that was left out."""
        path, s, near = self.path(nominal.y), nominal.y[self.layout.s], nominal.pairs.near
        missed = self.step.within(path, s, 0.0, known=near)
        if missed is None:
            return None
        more = self.step.within(path, s, _NEAR, known=near)
        near = near | missed if more is None else near | more
        return Pairs(self.step, self.layout, near)

    def renewed(self, nominal: Nominal, pairs: Pairs) -> Nominal:
        """The same plan with other pairs, which include those that push."""
        capped = nominal.pairs.table(nominal.slack > 0)[pairs.obstacle, pairs.node]
        force = nominal.pairs.table(nominal.force)[pairs.obstacle, pairs.node]
        return self.certify(nominal.y, nominal.rollout, nominal.reaction, pairs, force, capped)

    def with_pairs(self, nominal: Nominal, pairs: Pairs) -> Nominal:
        """The same plan as a start for programs with other pairs; not certified for them."""
        force = nominal.pairs.table(nominal.force)[pairs.obstacle, pairs.node]
        return replace(nominal, pairs=pairs, force=force)

    # --- programs

    def condensed(self, nominal: Nominal) -> Condensed:
        """The problem condensed about a plan."""
        return self.condenser.condensed(nominal.rollout, nominal.y[self.layout.s])

    def convex_qp(
        self,
        condensed: Condensed,
        pairs: Pairs,
        planes: Planes,
        relaxation: Relaxation,
        radius: FloatArray | None = None,
    ) -> CondensedQP:
        """The condensed program with the half-spaces of some planes.

        Args:
            condensed: The problem.
            pairs: Whose planes these are.
            planes: The half-spaces.
            relaxation: Who may give way.
            radius: (N nu,) by how much inputs may change at most, or None.
        """
        rows = pairs.rows(condensed.by.S)
        A = np.einsum("kw,kwn->kn", planes.a, rows)
        away = (planes.y - condensed.y_free)[pairs.at]
        b = (planes.a * away).sum(axis=1) - planes.g
        lower, upper = self._box(condensed, radius)
        free = condensed.y_free[self.layout.boxed]
        cap = self._cap(len(b), relaxation)
        by = condensed.by
        return CondensedQP(
            by.bounded, lower - free, upper - free, A, b, by.unbox, cap, condensed.least
        )

    def write(
        self,
        condensed: Condensed,
        pairs: Pairs,
        planes: Planes,
        relaxation: Relaxation,
        radius: FloatArray | None = None,
    ) -> tuple[Subproblem, Rows]:
        """Write the sparse program of the same constraints; return it, and which row is whose."""
        elastic = relaxation is not Relaxation.NOBODY
        subproblem = self.elastic if elastic else self.firm
        about = condensed.about
        known = self.step.x_ref if self.linear else about
        if self._written.get(elastic) is not known:
            subproblem.write_dynamics(about)
            self._written[elastic] = known
        subproblem.write_bounds(*self._box(condensed, radius), self.step.u_last)
        yielding = relaxation is Relaxation.EVERYBODY
        return subproblem, subproblem.write_half_spaces(pairs, planes, about.along, yielding)

    def solve(
        self,
        nominal: Nominal,
        condensed: Condensed,
        planes: Planes,
        relaxations: Sequence[Relaxation],
        radius: FloatArray | None = None,
    ) -> Convex | None:
        """Solve the convex program about a plan, with planes of its pairs; None if nobody can.

        Args:
            nominal: The plan, and its multipliers to start from.
            condensed: The problem condensed about it.
            planes: Half-spaces of its pairs.
            relaxations: Who is to give way, one after the other, until there is a solution.
            radius: As in `convex_qp`.
        """
        pairs, clock = nominal.pairs, self.clock
        for give in relaxations:
            if give > relaxations[0] and clock.remaining < 0:
                break  # it was the time that ran out
            clock.begin()
            qp = self.convex_qp(condensed, pairs, planes, give, radius)
            subproblem, rows = self.write(condensed, pairs, planes, give, radius)
            start = self.start(subproblem, nominal)
            clock.charge("update")
            rescue = clock.unlimited or clock.allows("rescue")
            began = clock.elapsed
            solution = subproblem.solver.solve(qp, rows, start, rescue)
            clock.charge("solve")
            if solution is not None:
                return Convex(condensed, pairs, planes, qp, solution, give)
            if rescue:
                clock.learn("rescue", began)
        return None

    def start(self, subproblem: Subproblem, nominal: Nominal) -> tuple[FloatArray, FloatArray]:
        """Where a program's solver starts: at the plan and its multipliers."""
        plan, force = nominal.rollout, np.concatenate([nominal.reaction, nominal.force])
        s = nominal.y[self.layout.s]
        return subproblem.start(plan.deviations, plan.inputs, s, nominal.costates, force)

    def relaxations(
        self, firm: bool, least: Relaxation = Relaxation.NOBODY
    ) -> tuple[Relaxation, ...]:
        """Who is to give way, one after the other: firm obstacles never do."""
        states = (Relaxation.STATES,) if self.layout.limits_states else ()
        every = (Relaxation.NOBODY, *states, *(() if firm else (Relaxation.EVERYBODY,)))
        return tuple(give for give in every if give >= least) or (least,)

    # --- curvature

    def bends(self, convex: Convex, force: FloatArray) -> tuple[FloatArray, IntArray, FloatArray]:
        """How the half-spaces that push bend, each times the root of its force.

        Returns:
            L (q, nv) in condensed coordinates; which pairs push; L (k, w, d-1) on outputs.
        """
        pairs, planes = convex.pairs, convex.planes
        if not len(force):
            none, d = np.zeros((0, convex.qp.F.shape[1])), self.problem.model.dim
            return none, np.zeros(0, dtype=np.intp), np.zeros((0, d + 1, d - 1))
        push = (force > NEGLIGIBLE).nonzero()[0]
        L = pairs.bend(planes)[push] * np.sqrt(force[push])[:, None, None]
        rows = pairs.rows(convex.condensed.by.S)[push]
        bends = np.einsum("kwm,kwn->kmn", L, rows)
        return bends.reshape(-1, bends.shape[-1]), push, L

    def curvature(self, convex: Convex, solution: QPSolution) -> FloatArray:
        """W (nv, nv): what the convex program leaves out of the Lagrangian's second derivative."""
        bends = self.bends(convex, solution.force[len(convex.qp.F) :])[0]
        W = self._dynamics_curvature(convex, solution)
        return -bends.T @ bends if W is None else W - bends.T @ bends

    def _dynamics_curvature(self, convex: Convex, solution: QPSolution) -> FloatArray | None:
        """The part (nv, nv) of dynamics and positions; None of a linear robot."""
        if self.linear:
            return None
        nf = len(convex.qp.F)
        condensed, certificate = convex.condensed, self._certificate
        about, e = condensed.about, condensed.deviations(solution.v)
        phi = certificate.phi(convex.pairs, convex.planes, solution.force[nf:])
        nu = certificate.costates(about, certificate.track(e), solution.force[:nf], phi)[0]
        on_p = np.zeros(self.layout.p.stop) if phi is None else phi[self.layout.p]
        states = self.step.x_ref.copy()
        states[0] = self.step.x0
        states[1:] += about.deviations
        assert isinstance(self.nodes, NonlinearNodes)
        stages, sway = self.nodes.curvature(states, about.inputs, -nu, -on_p)
        return self._condensed_curvature(condensed, stages, sway)

    def second_order(self, nominal: Nominal) -> tuple[float, FloatArray]:
        """Smallest curvature at a plan, over the largest, and its direction (N, nu) in inputs."""
        condensed = self.condensed(nominal)
        qp = self.convex_qp(condensed, nominal.pairs, nominal.planes, Relaxation.NOBODY)
        force = np.concatenate([nominal.reaction, nominal.force])
        v, nf = condensed.here, len(qp.F)
        bounded = qp.F @ v
        below, above = bounded - qp.lower, qp.upper - bounded
        capped = np.zeros(len(force), dtype=np.bool_)
        capped[nf:] = nominal.slack > 0
        room = np.concatenate([np.minimum(below, above), qp.A @ v - qp.b])
        at = (((room <= _TOUCH) | (np.abs(force) > NEGLIGIBLE)) & ~capped).nonzero()[0]
        nearer = np.append(below <= above, np.ones(len(room) - nf, dtype=np.bool_))
        sign = np.where(force == 0, np.where(nearer, 1, -1), np.sign(force))
        rows = np.concatenate([qp.F, qp.A])[at] * sign[at, None]
        none = np.zeros((0, 0))
        solution = QPSolution(v, force, at, capped, none, at, none)
        convex = Convex(condensed, nominal.pairs, nominal.planes, qp, solution, Relaxation.NOBODY)
        W, bends = self._dynamics_curvature(convex, solution), self.bends(convex, force[nf:])[0]
        least, direction = least_curvature(W, bends, rows, np.abs(force[at]))
        inputs = condensed.by.inverse.T @ direction[: len(condensed.by.inverse)]
        return least, inputs.reshape(self.layout.shape)

    # --- what is handed out

    def iterate(self, nominal: Nominal, cap: float = np.inf) -> Iterate:
        """Name the parts of a plan in the words of the problem; `cap` is the largest force."""
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
        pins = forces - cap if np.isfinite(cap) else forces
        duals = Multipliers(nominal.costates, inputs, margin, -forces, pins, limits, rates)
        s = nominal.y[c.s].copy()
        return Iterate(states, nominal.rollout.inputs, s, slack, duals, self.free).frozen()

    def _box(
        self, condensed: Condensed, radius: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """Bounds (nf,) of the bounded entries, within the trust region about the plan."""
        c = self.layout
        lower, upper = (bound[c.boxed] for bound in self.bounds)
        if radius is not None:
            lower, upper, u = lower.copy(), upper.copy(), condensed.about.inputs.ravel()
            lower[c.inputs] = np.maximum(lower[c.inputs], u - radius)
            upper[c.inputs] = np.minimum(upper[c.inputs], u + radius)
        return lower, upper

    def boxed(self, condensed: Condensed, inputs: FloatArray, s: FloatArray) -> FloatArray:
        """Sizes and inputs (nv,) relative to those of the plan that nothing constrains."""
        c = self.layout
        both = np.concatenate([s[: c.moving], inputs.ravel()])
        return both - condensed.y_free[c.boxed][: c.variables]

    def _cap(self, pairs: int, relaxation: Relaxation) -> FloatArray | None:
        """Largest forces (nf + K,) on a program's constraints; None for firm ones."""
        if relaxation is Relaxation.NOBODY:
            return None
        c = self.layout
        nf = c.size - c.boxed.start
        cap = np.full(nf + pairs, np.inf)
        cap[c.yielding] = self.problem.state_slack_weight
        if relaxation is Relaxation.EVERYBODY:
            cap[nf:] = self.problem.slack_weight
        return cap

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
