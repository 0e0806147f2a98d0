"""Multi-start: other candidates past the obstacles against the plan that is there.

All are ranked by the programs that linearise about them. The multipliers that OSQP has after a few
iterations bound a program's optimum from below, and tightly: most candidates are cut off by that,
and many by the multipliers that the same one had one control step before, without any iteration.
The best are followed to their end, and win if they are better by enough. Where the plan needs
slack, more are followed until one does not. Waiting in front of an obstacle is cheap over a short
horizon, which does not show what it costs in the end: it has to promise half of the plan's cost.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.qp.active_set import CondensedQP
from scp_mpc.scp.candidates import (
    MAX_CANDIDATES,
    MOST_AMONG_WALLS,
    PassingPattern,
    candidate_paths,
    same_pattern,
    varied,
)
from scp_mpc.scp.certificate import Nominal
from scp_mpc.scp.condensing import Condensed
from scp_mpc.scp.iterate import NEGLIGIBLE, Iterate
from scp_mpc.scp.loop import Loop
from scp_mpc.scp.pairs import Pairs, Planes
from scp_mpc.scp.plan import Candidate, Result
from scp_mpc.scp.transcription import Relaxation, Transcription

# It must be better by this share, or the plan flickers between candidates of equal cost.
_HYSTERESIS = 0.001
_MOST_FOLLOWED = 8  # candidates, where the plan needs slack
_MOST_PROMISING = 3  # candidates, where others promise to cost much less
_PROMISING = 0.5  # share of the plan's merit that is much less
_CUTOFF = 3.0  # times the plan's own merit: more than that one program does not make good
_BEAM = 3  # candidates among polytopes that are varied
_ROUNDS = 5  # of variations
_ALIKE = 1e-6  # relative difference of merits that counts as none

# Multipliers of a program about a path: (N, nu) of the input bounds and (M, C) of the obstacles.
Duals = tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class Ranked:
    """What one program about a path seems to lead to.

    Attributes:
        merit: Lower bound of its optimum, cost and penalty on the slack; infinite if it has no
            solution, or none that can win.
        planes: Its half-spaces, about the path.
        force: (nf + K,) its multipliers.
        v: (nv,) the point reached; None if it cannot win.
        waits: Whether its path stays in front of an obstacle.
    """

    merit: float
    planes: Planes
    force: FloatArray
    v: FloatArray | None = None
    waits: bool = False


@dataclass(frozen=True, eq=False)
class Found:
    """The best plan so far, the candidates that were tried, and whether one of them won."""

    best: Result
    tried: tuple[Candidate, ...] = ()
    switched: bool = False


class MultiStart:
    """Tries other candidates past the obstacles.

    Args:
        at: The control steps in numbers.
        loop: Follows the candidates that look best.
    """

    def __init__(self, at: Transcription, loop: Loop) -> None:
        """Remember both."""
        self._at, self._loop, self._settings = at, loop, at.settings

    def wanted(self, best: Result, due: bool) -> bool:
        """Whether to try: an obstacle is entered, or shapes a plan that is not safe or is due.

        Not where no program was solved: there is no time, or no solver. Nor where no obstacle has
        to do with what is wrong, as with a start outside the states' bounds.
        """
        if not self._settings.multi_start or best.nominal is None:
            return False
        clear = float(best.iterate.slack.max(initial=0.0)) <= self._settings.tolerance
        return not clear or ((due or not best.status.ok) and best.iterate.touches)

    def run(self, best: Result, free: FloatArray, last: Iterate | None = None) -> Found:
        """Rank the candidates past the obstacles by one program each; follow the best of them.

        Among polytopes the search is thorough where there is no plan from the step before, or where
        the one that is there is not safe.

        Args:
            best: The plan that is there.
            free: (C, d) positions of the plan that ignores the obstacles.
            last: The nominal plan of the step, or None.
        """
        at, step, clock = self._at, self._at.step, self._at.clock
        assert best.nominal is not None
        safe = best.status.ok
        thorough = step.shapes is not None and (last is None or not safe)
        most = MOST_AMONG_WALLS if thorough else MAX_CANDIDATES
        most = clock.room("candidate", most, then="iteration")
        if not most:
            return Found(best)
        began = clock.mark()
        here = PassingPattern(at.path(best.nominal.y)[1:], best.iterate.touched[: step.count])
        full = np.full(at.problem.max_obstacles, at.problem.size.reference)
        candidates, numbers = candidate_paths(step, free, here.path, full, most), Counter[int]()
        if not candidates:
            return Found(replace(best, iterate=replace(best.iterate, alternatives={})))
        keys = []
        for candidate in candidates:  # an obstacle's candidates come in the same order in each step
            numbers[candidate.obstacle] += 1
            keys.append((candidate.obstacle, numbers[candidate.obstacle]))
        known = {} if last is None else last.alternatives
        about = self._incumbent(best.nominal, free)
        old = [known.get(key) for key in keys]
        paths, waits = [way.path for way in candidates], [way.waits for way in candidates]
        looks = self._rank(best, about, paths, old, thorough, waits)
        ranked = [one for one in looks if one is not None]
        clock.learn("candidate", began, len(ranked))
        tried = tuple(
            Candidate(candidate.obstacle, candidate.normal, candidate.time, one.merit)
            for candidate, one in zip(candidates, looks, strict=True)
            if one is not None  # there was no time
        )
        duals = {k: about.duals(one) for k, one in zip(keys, looks, strict=True) if one is not None}
        follow = self._settings.max_candidates
        if thorough:
            ranked = self._searched(best, about, ranked, full)
            follow += _BEAM - 1  # some lead to where we are
        goal, switched = best, False
        # Ties keep their order. What waiting costs in the end, no horizon shows: it comes last.
        ranked = sorted(ranked, key=lambda one: (one.waits, one.merit))
        # A plan with slack is beaten by any without, and one that costs far more by others: then
        # more candidates are worth their time.
        for k, one in enumerate(ranked):
            wanted = k < follow if safe else k < _MOST_FOLLOWED and not goal.status.ok
            if one.waits or (safe and not wanted and k < _MOST_PROMISING):
                wanted = one.merit <= _PROMISING * goal.merit
            if one.v is None or not wanted:
                continue
            if not clock.allows("iteration"):
                break
            if safe and same_pattern(step, about.passing(one), here):
                continue  # this candidate leads to where we are
            end = self._loop.run(about.start(one), goal, one.planes.y, hard=True)
            if end is not None and end.beats(goal, _HYSTERESIS * goal.merit):
                goal, switched = end, True
        # None is without slack; then the one that seems to need the least is worth a try.
        first = ranked[0] if ranked and not goal.status.ok else None
        if first is not None and first.v is not None and first.merit < goal.merit:
            end = self._loop.run(about.start(first), goal, first.planes.y)
            if end is not None and end.beats(goal, _HYSTERESIS * goal.merit):
                goal, switched = end, True
        kept = replace(goal.iterate, alternatives=duals)
        return Found(replace(goal, iterate=kept), tried, switched)

    def _incumbent(self, plan: Nominal, free: FloatArray) -> "Incumbent":
        """Condense about the plan that is there, with all pairs near to it or to the free one."""
        at, c = self._at, self._at.layout
        alone = plan.y.copy()
        alone[c.p] = (free - at.step.here).ravel()
        pairs = Pairs(at.step, c, at.near(alone, at.near(plan.y, plan.pairs.near & False)))
        force = plan.pairs.table(plan.force)[pairs.obstacle, pairs.node]
        plan = replace(plan, pairs=pairs, force=force)
        return Incumbent(at, plan, at.linearise(plan))

    def _rank(
        self,
        best: Result,
        about: "Incumbent",
        paths: list[FloatArray],
        known: list[Duals | None],
        thorough: bool,
        waits: Sequence[bool],
    ) -> list[Ranked | None]:
        """Look at one program about each path (C, d), all linearised at once, until the deadline.

        Those come first that seem best by the multipliers of the step before: they tell soonest how
        much the others would have to be worth. None for those for which there was no time. A path
        that waits is no measure for others: what it costs in the end, no horizon shows.
        """
        at, c = self._at, self._at.layout
        ys = np.repeat(about.plan.y[None], len(paths), axis=0)
        ys[:, c.s] = at.problem.size.reference
        ys[:, c.p] = (np.stack(paths) - at.step.here).reshape(len(paths), -1)
        relaxation = Relaxation.NONE if best.status.ok else Relaxation.ALL
        limit = _CUTOFF * best.merit if best.status.ok else inf
        only_best = best.status.ok and not thorough and self._settings.max_candidates == 1
        programs = []
        for planes, duals in zip(about.plan.pairs.about(ys), known, strict=True):
            qp = at.condensed_qp(about.condensed, about.plan.pairs, planes, relaxation)
            force = None if duals is None else about.force(duals)
            programs.append((-inf if force is None else qp.dual_bound(force), qp, planes, force))
        looks: list[Ranked | None] = [None] * len(paths)
        for k in sorted(range(len(paths)), key=lambda k: programs[k][0]):
            bound, qp, planes, force = programs[k]
            if not at.clock.allows("candidate"):
                break
            most = _PROMISING * best.merit if waits[k] and best.status.ok else limit
            if force is not None and bound > most:
                at.hard.solver.finished["cut"] += 1
                looks[k] = Ranked(inf, planes, force)
                continue
            one = self._look(about, planes, relaxation, qp, most, thorough)
            looks[k] = replace(one, waits=waits[k])
            if only_best and not waits[k]:
                limit = min(limit, one.merit)
        return looks

    def _look(
        self,
        about: "Incumbent",
        planes: Planes,
        relaxation: Relaxation,
        qp: CondensedQP,
        limit: float,
        thorough: bool,
    ) -> Ranked:
        """Look at one program, from the plan that is there.

        A thorough look solves it; else the multipliers after a few iterations have to do.
        """
        at, condensed = self._at, about.condensed
        program = at.write(about.plan, condensed, planes, relaxation, qp=qp)
        solver, start = program.subproblem.solver, at.start(program, about.plan)
        merit, (z, y) = solver.rank(qp, program.rows, start, limit)
        force, exact = program.rows.forces(y), None
        if thorough and merit < inf:
            exact = solver.solve(qp, program.rows, (z, y), at.clock).solution
            merit = inf if exact is None else qp.merit(exact.v)
        at.clock.charge("solve")
        if merit == inf:
            return Ranked(inf, planes, force)
        if exact is not None:
            return Ranked(merit, planes, exact.force, exact.v)
        away = program.subproblem.box(z) - condensed.y_free[at.layout.boxed][: len(qp.unbox)]
        return Ranked(merit, planes, force, qp.unbox @ away)

    def _searched(
        self, best: Result, about: "Incumbent", ranked: list[Ranked], full: FloatArray
    ) -> list[Ranked]:
        """Among polytopes, which face to pass at which stage is a search: the best few of all.

        Each is varied by one face at one stage, as long as that finds better ones.
        """
        clock, step = self._at.clock, self._at.step
        beam, done = _best(ranked), list[Ranked]()
        for _ in range(_ROUNDS):
            paths = [
                path
                for candidate in beam
                if not any(candidate is other for other in done)
                for path in varied(step, about.passing(candidate), full)
            ]
            done += beam
            spare = 2 * self._settings.max_iterations  # to follow the best, and what comes then
            most = clock.room("candidate", MOST_AMONG_WALLS, then="iteration", spare=spare)
            if not paths or not most:
                break
            began = clock.mark()
            paths = paths[:most]
            unknown: list[Duals | None] = [None] * len(paths)
            looks = self._rank(best, about, paths, unknown, True, [False] * len(paths))
            more = [one for one in looks if one is not None]
            clock.learn("candidate", began, len(more))
            beam = _best([*beam, *more])
        return beam or ranked


@dataclass(frozen=True, eq=False)
class Incumbent:
    """The plan that is there, about which all programs are condensed.

    Attributes:
        at: The control step in numbers.
        plan: The plan, with the pairs that the programs hold.
        condensed: The problem condensed about it.
    """

    at: Transcription
    plan: Nominal
    condensed: Condensed

    def passing(self, one: Ranked) -> PassingPattern:
        """How the point that a program reached passes the obstacles."""
        force = self.plan.pairs.table(one.force[self.at.layout.bounded :])
        return PassingPattern(self.at.path(self._reached(one))[1:], force > NEGLIGIBLE)

    def start(self, one: Ranked) -> Nominal:
        """The plan to which that point leads, with its multipliers."""
        at, c, nf = self.at, self.at.layout, self.at.layout.bounded
        reached = self._reached(one)
        y, rollout = at.rolled(reached[c.u].reshape(c.shape), reached[c.s])
        return at.nominal(y, rollout, one.force[:nf], self.plan.pairs, one.force[nf:])

    def duals(self, one: Ranked) -> Duals:
        """Multipliers of the input bounds and of all pairs, to be known in the next step."""
        c, pairs = self.at.layout, self.plan.pairs
        pushes = np.zeros((self.at.problem.max_obstacles, self.at.nodes.size))
        pushes[pairs.obstacle, pairs.node] = one.force[c.bounded :]
        return one.force[c.inputs].reshape(c.shape), pushes

    def force(self, duals: Duals) -> FloatArray:
        """Multipliers (nf + K,) from those of the step before."""
        c, pairs = self.at.layout, self.plan.pairs
        force = np.zeros(c.bounded + len(pairs.node))
        force[c.inputs] = duals[0].ravel()
        force[c.bounded :] = duals[1][pairs.obstacle, pairs.node]
        return force

    def _reached(self, one: Ranked) -> FloatArray:
        assert one.v is not None
        return self.condensed.y(one.v)


def _best(candidates: list[Ranked]) -> list[Ranked]:
    """The best few that can be followed and differ in cost."""
    beam: list[Ranked] = []
    for candidate in sorted(candidates, key=lambda candidate: candidate.merit):
        alike = beam and candidate.merit - beam[-1].merit <= _ALIKE * candidate.merit
        if len(beam) < _BEAM and np.isfinite(candidate.merit) and not alike:
            beam.append(candidate)
    return beam
