"""Multi-start: other ways past the obstacles against the plan that is there.

All ways are ranked by the programs that linearise about them. The multipliers that OSQP has after a
few iterations bound the program's optimum from below, and tightly: most ways are cut off by that,
and many by the multipliers that the same way had one control step before, without any iteration.
The best are followed to their end, and win if they are better by enough. Where the plan needs
slack, all are followed until one does not.
"""

from collections import Counter
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.scp.candidates import (
    MAX_CANDIDATES,
    MOST_AMONG_WALLS,
    Passing,
    candidates,
    same_way,
    varied,
)
from scp_mpc.scp.certificate import Nominal
from scp_mpc.scp.condensing import Condensed
from scp_mpc.scp.iterate import NEGLIGIBLE, Iterate
from scp_mpc.scp.loop import Loop
from scp_mpc.scp.pairs import Pairs, Planes
from scp_mpc.scp.plan import Candidate, Result
from scp_mpc.scp.transcription import Relaxation, Transcription

# A rival must be better by this share, or the plan flickers between ways of equal cost.
_HYSTERESIS = 0.001
_HOPELESS = 3.0  # times the plan's own merit: more than that one program does not make good
_BEAM = 3  # ways among polytopes that are varied
_ROUNDS = 5  # of variations
_ALIKE = 1e-6  # relative difference of merits that counts as none


@dataclass(frozen=True, eq=False)
class Ranked:
    """What one program about a path seems to lead to.

    Attributes:
        merit: Lower bound of its optimum, cost and penalty on the slack; infinite if it has no
            solution, or none that can win.
        passing: Its positions, and who pushes it where.
        about: (ny,) the path, where its half-spaces are taken.
        start: The plan that it seems to lead to, with its multipliers; None if it cannot win.
        duals: Its multipliers (N, nu) of the input bounds and (M, C) of the obstacles.
    """

    merit: float
    passing: Passing
    about: FloatArray
    start: Nominal | None
    duals: tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class Found:
    """The best plan so far, the ways that were tried, and whether one of them won."""

    best: Result
    tried: tuple[Candidate, ...] = ()
    switched: bool = False


class MultiStart:
    """Tries other ways past the obstacles.

    Args:
        at: The control steps in numbers.
        loop: Follows the ways that look best.
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
        """Rank the ways past the obstacles by one program each; follow the best of them.

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
        began = clock.elapsed()
        here = Passing(at.path(best.nominal.y)[1:], best.iterate.touched[: step.count])
        full = np.full(at.problem.max_obstacles, at.problem.size.reference)
        ways, numbers = candidates(step, free, here.path, full, most), Counter[int]()
        keys = []
        for way in ways:  # an obstacle's ways come in the same order in each step
            numbers[way.obstacle] += 1
            keys.append((way.obstacle, numbers[way.obstacle]))
        known = {} if last is None else last.alternatives
        old = [known.get(key) for key in keys]
        ranked = self._rank(best, free, [way.path for way in ways], old, thorough)
        clock.learn("candidate", began, len(ranked))
        tried = tuple(
            Candidate(way.obstacle, way.normal, way.time, one.merit)
            for way, one in zip(ways, ranked, strict=False)  # fewer where time ran out
        )
        duals = {key: one.duals for key, one in zip(keys, ranked, strict=False)}
        follow = self._settings.max_candidates
        if thorough:
            ranked = self._searched(best, free, ranked, full)
            follow += _BEAM - 1  # some lead to where we are
        goal, switched = best, False
        ranked = sorted(ranked, key=lambda one: one.merit)  # ties keep their order
        # A plan with slack is beaten by any without: then all ways are worth their time.
        for one in ranked[:follow] if safe else ranked:
            if one.start is None or (not safe and goal.status.ok) or not clock.allows("iteration"):
                break
            if safe and same_way(step, one.passing, here):
                continue  # this way leads to where we are
            rival = self._loop.run(one.start, goal, one.about, firm=True)
            if rival is not None and rival.beats(goal, _HYSTERESIS * goal.merit):
                goal, switched = rival, True
        # None is without slack; then the one that seems to need the least is worth a try.
        first = ranked[0] if ranked and not goal.status.ok else None
        if first is not None and first.start is not None and first.merit < goal.merit:
            rival = self._loop.run(first.start, goal, first.about)
            if rival is not None and rival.beats(goal, _HYSTERESIS * goal.merit):
                goal, switched = rival, True
        kept = replace(goal.iterate, alternatives=duals)
        return Found(replace(goal, iterate=kept), tried, switched)

    def _rank(
        self,
        best: Result,
        free: FloatArray,
        paths: list[FloatArray],
        known: list[tuple[FloatArray, FloatArray] | None],
        thorough: bool,
    ) -> list[Ranked]:
        """Look at one program about each path (C, d), all linearised at once, until the deadline.

        A thorough look solves it; else the multipliers after a few iterations have to do.
        """
        at, c, plan = self._at, self._at.layout, best.nominal
        if not paths or plan is None:
            return []
        ys = np.repeat(plan.y[None], len(paths), axis=0)
        ys[:, c.s] = at.problem.size.reference
        ys[:, c.p] = (np.stack(paths) - at.step.here).reshape(len(paths), -1)
        alone = plan.y.copy()
        alone[c.p] = (free - at.step.here).ravel()
        pairs = Pairs(at.step, c, at.near(alone, at.near(plan.y, plan.pairs.near & False)))
        force = plan.pairs.table(plan.force)[pairs.obstacle, pairs.node]
        present = replace(plan, pairs=pairs, force=force)  # where the programs' solver starts
        condensed = at.linearise(present)
        give = Relaxation.NOBODY if best.status.ok else Relaxation.EVERYBODY
        limit, found = _HOPELESS * best.merit if best.status.ok else inf, list[Ranked]()
        for path, about, planes, duals in zip(paths, ys, pairs.about(ys), known, strict=True):
            if not at.clock.allows("candidate"):
                break
            one = self._look(present, condensed, planes, give, duals, limit, thorough)
            passing = one.passing if one.start is not None else Passing(path, one.passing.touched)
            found.append(replace(one, about=about, passing=passing))
            if best.status.ok and not thorough and self._settings.max_candidates == 1:
                limit = min(limit, one.merit)
        return found

    def _look(
        self,
        present: Nominal,
        condensed: Condensed,
        planes: Planes,
        give: Relaxation,
        known: tuple[FloatArray, FloatArray] | None,
        limit: float,
        thorough: bool,
    ) -> Ranked:
        """Look at the program with some planes, from the plan that is there."""
        at, c, pairs = self._at, self._at.layout, present.pairs
        hopeless = Passing(planes.y, np.zeros(pairs.near.shape, dtype=np.bool_))
        qp = at.condensed_qp(condensed, pairs, planes, give)
        nf = len(qp.F)
        if known is not None and limit < inf:
            force = np.zeros(nf + len(pairs.node))
            force[:nf][c.inputs] = known[0].ravel()
            force[nf:] = known[1][pairs.obstacle, pairs.node]
            if qp.dual_bound(force) > limit:
                at.firm.solver.finished["cut"] += 1
                return Ranked(inf, hopeless, planes.y, None, known)
        program = at.write(present, condensed, planes, give, qp=qp)
        solver, start = program.subproblem.solver, at.start(program, present)
        merit, (z, y) = solver.rank(qp, program.rows, start, limit)
        force = program.rows.forces(y)
        exact = None
        if thorough and merit < inf:
            exact = solver.solve(qp, program.rows, (z, y), at.clock).solution
            merit = inf if exact is None else qp.merit(exact.v)
        at.clock.charge("solve")
        pushes = np.zeros((at.problem.max_obstacles, at.nodes.size))
        pushes[pairs.obstacle, pairs.node] = force[nf:]
        duals = force[:nf][c.inputs].reshape(c.shape), pushes
        if merit == inf:
            return Ranked(inf, hopeless, planes.y, None, duals)
        if exact is None:
            away = program.subproblem.box(z) - condensed.y_free[c.boxed][: len(qp.unbox)]
            v = qp.unbox @ away
        else:
            v, force = exact.v, exact.force
        reached = condensed.y(v)
        passing = Passing(at.path(reached)[1:], pairs.table(force[nf:]) > NEGLIGIBLE)
        y, rollout = at.rolled(reached[c.u].reshape(c.shape), reached[c.s])
        plan = at.nominal(y, rollout, force[:nf], pairs, force[nf:])
        return Ranked(merit, passing, planes.y, plan, duals)

    def _searched(
        self, best: Result, free: FloatArray, ranked: list[Ranked], full: FloatArray
    ) -> list[Ranked]:
        """Among polytopes, which face to pass at which stage is a search: the best few ways of all.

        Each is varied by one face at one stage, as long as that finds better ones.
        """
        clock, step = self._at.clock, self._at.step
        beam, done = _best(ranked), list[Ranked]()
        for _ in range(_ROUNDS):
            paths = [
                path
                for way in beam
                if not any(way is other for other in done)
                for path in varied(step, way.passing, full)
            ]
            done += beam
            most = clock.room("candidate", MOST_AMONG_WALLS, then="iteration")
            if not paths or not most:
                break
            began = clock.elapsed()
            more = self._rank(best, free, paths[:most], [None] * len(paths[:most]), True)
            clock.learn("candidate", began, len(more))
            beam = _best([*beam, *more])
        return beam or ranked


def _best(ways: list[Ranked]) -> list[Ranked]:
    """The best few that can be followed and differ in cost."""
    beam: list[Ranked] = []
    for way in sorted(ways, key=lambda way: way.merit):
        alike = beam and way.merit - beam[-1].merit <= _ALIKE * way.merit
        if len(beam) < _BEAM and np.isfinite(way.merit) and not alike:
            beam.append(way)
    return beam
