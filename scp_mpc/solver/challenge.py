"""The challenge: other ways past the obstacles against the plan that is there.

All ways are ranked by one program each; the best is followed to its end, and wins if it is better
by enough. Where the plan needs slack, all are followed until one does not.
"""

from dataclasses import dataclass, replace

import numpy as np

from scp_mpc.problem import Problem
from scp_mpc.settings import Settings
from scp_mpc.solver.descent import Descent, Glimpse
from scp_mpc.solver.engine import Engine
from scp_mpc.solver.iterate import Iterate
from scp_mpc.solver.plan import Candidate
from scp_mpc.solver.sides import (
    MAX_CANDIDATES,
    MOST_AMONG_WALLS,
    Passing,
    candidates,
    same_way,
    varied,
)
from scp_mpc.solver.step_data import StepData
from scp_mpc.solver.stopwatch import Stopwatch

# A rival must be better by this share, or the plan flickers between sides of equal cost.
_HYSTERESIS = 0.001
_BEAM = 3  # ways among polytopes that are varied
_ROUNDS = 5  # of variations
_ALIKE = 1e-6  # relative difference of merits that counts as none


@dataclass(frozen=True, eq=False)
class Found:
    """The best plan so far, the rivals that were tried, and whether one of them won."""

    best: Descent
    tried: tuple[Candidate, ...] = ()
    switched: bool = False


class Challenge:
    """Tries other ways past the obstacles.

    Args:
        problem: What to solve.
        settings: Whether to try them, and how many to follow.
    """

    def __init__(self, problem: Problem, settings: Settings) -> None:
        """Remember both."""
        self._problem, self._settings = problem, settings

    def wanted(self, best: Descent, due: bool) -> bool:
        """Whether to try: an obstacle is entered, or shapes a plan that is not safe or is due.

        Not where no program was solved: there is no time, or no solver. Nor where no obstacle has
        to do with what is wrong, as with a start outside the states' bounds.
        """
        if not self._settings.multi_start or best.iterate.multipliers is None:
            return False
        clear = float(best.iterate.slack.max(initial=0.0)) <= self._settings.tolerance
        return not clear or ((due or not best.status.ok) and best.iterate.touches)

    def run(
        self,
        engine: Engine,
        step: StepData,
        watch: Stopwatch,
        best: Descent,
        fresh: bool = False,
    ) -> Found:
        """Rank the ways past the obstacles by one program each; descend from the best of them.

        Among polytopes, a plan that is not `fresh` was searched for at the steps before: there are
        no more candidates than elsewhere.
        """
        thorough = step.shapes is not None and (fresh or not best.status.ok)
        many = MOST_AMONG_WALLS if thorough else MAX_CANDIDATES
        most = watch.room("way", many, then=engine.sampling.first)
        if not most:
            return Found(best)
        began = watch.elapsed
        full = np.full(self._problem.max_obstacles, self._problem.size.reference)
        here = Passing(engine.path(best.iterate), best.iterate.touched[: step.count])
        sides = candidates(step, engine.free_path(), here.path, full, most)
        present = replace(best.iterate, s=full)
        safe = best.status.ok
        starts = engine.glimpses(present, [side.path for side in sides], firm=safe)
        watch.learn("way", began, len(sides))
        tried = tuple(
            Candidate(side.obstacle, side.normal, side.time, start.merit)
            for side, start in zip(sides, starts, strict=False)  # fewer where time ran out
        )
        rivals = self._settings.max_candidates
        if thorough:
            starts = self._searched(engine, step, watch, present, starts)
            rivals += _BEAM - 1  # some lead to where we are
        goal, switched = best, False
        ranked = sorted(starts, key=lambda start: start.merit)  # ties keep their order
        # A plan with slack is followed by any without: then all ways are worth their time.
        for start in ranked[:rivals] if safe else ranked:
            if (not safe and goal.status.ok) or not watch.affords(engine.sampling.first):
                break
            if safe and same_way(step, Passing(start.path, start.touched), here):
                continue  # this way leads to where we are
            rival = engine.follow(start.iterate, goal)
            if rival is not None and rival.beats(goal, _HYSTERESIS * goal.merit):
                goal, switched = rival, True
        return Found(goal, tried, switched)

    def _searched(
        self,
        engine: Engine,
        step: StepData,
        watch: Stopwatch,
        present: Iterate,
        starts: list[Glimpse],
    ) -> list[Glimpse]:
        """Among polytopes, which face to pass at which stage is a search: the best few ways of all.

        Each is varied by one face at one stage, as long as that finds better ones.
        """
        beam, done = _best(starts), list[Glimpse]()
        for _ in range(_ROUNDS):
            paths = [
                path
                for way in beam
                if not any(way is other for other in done)
                for path in varied(step, Passing(way.path, way.touched), present.s)
            ]
            done += beam
            most = watch.room("way", MOST_AMONG_WALLS, then=engine.sampling.first)
            if not paths or not most:
                break
            began = watch.elapsed
            more = engine.glimpses(present, paths[:most], firm=True)
            watch.learn("way", began, len(more))
            beam = _best([*beam, *more])
        return beam or starts


def _best(ways: list[Glimpse]) -> list[Glimpse]:
    """The best few that can be followed and differ in cost."""
    beam: list[Glimpse] = []
    for way in sorted(ways, key=lambda way: way.merit):
        alike = beam and way.merit - beam[-1].merit <= _ALIKE * way.merit
        if len(beam) < _BEAM and np.isfinite(way.merit) and not alike:
            beam.append(way)
    return beam
