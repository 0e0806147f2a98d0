"""What each solver made of the same recorded steps, and the row of numbers that sums it up."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypedDict

import numpy as np

from benchmarks.peers.plan import PeerPlan
from scp_mpc.arrays import FloatArray

TOLERATED = 1e-5  # largest violation of a plan that counts as feasible
_YARDSTICK = "scp_mpc"


class Row(TypedDict):
    """One solver at one horizon; None where no plan gives a number.

    Keys:
        solver, horizon, obstacles: Who solved what.
        steps: Number of control steps that it was given.
        every: One in so many steps of the run was given to it.
        median_ms, p99_ms, max_ms: Wall time of one step [ms], failures included.
        ratio: Its median over that of "scp_mpc", on the steps that both were given.
        max_cost_gap: Largest (cost - best) / max(best, 1e-9) over the steps where its plan is
            feasible; `best` is the lowest cost among all solvers' feasible plans of that step.
            A solver that stays in a worse local optimum shows here: only scp_mpc with multi-start
            looks for another one.
        max_violation: Largest violation of the original constraints; see `largest_violation`.
        failures: Steps where it reported no success or violates by more than 1e-5.
        programs: Quadratic programs by the solver that finished them; None where nobody tells.
    """

    solver: str
    horizon: int
    obstacles: int
    steps: int
    every: int
    median_ms: float | None
    p99_ms: float | None
    max_ms: float | None
    ratio: float | None
    max_cost_gap: float | None
    max_violation: float | None
    failures: int
    programs: dict[str, int] | None


@dataclass(frozen=True, eq=False)
class Attempts:
    """The plans of one solver.

    Attributes:
        solver: Its name.
        horizon: N.
        obstacles: Number of obstacles.
        steps: Number of control steps that it was given.
        plans: Plans by index of the step; empty if the solver is not installed.
        every: One in so many steps of the run was given to it.
    """

    solver: str
    horizon: int
    obstacles: int
    steps: int
    plans: dict[int, PeerPlan]
    every: int = 1

    @property
    def milliseconds(self) -> FloatArray:
        """Wall time of each step [ms]."""
        return np.array([1e3 * plan.seconds for plan in self.plans.values()])

    @property
    def feasible(self) -> dict[int, PeerPlan]:
        """The plans that the solver stands by and that the referee lets pass."""
        return {
            k: plan
            for k, plan in self.plans.items()
            if plan.ok and plan.violation <= TOLERATED and np.isfinite(plan.cost)
        }


def rows(contest: Sequence[Attempts]) -> list[Row]:
    """Sum up all solvers' attempts at one sequence of steps."""
    best: dict[int, float] = {}
    for attempts in contest:
        for k, plan in attempts.feasible.items():
            best[k] = min(plan.cost, best.get(k, np.inf))
    ours = next((attempts.plans for attempts in contest if attempts.solver == _YARDSTICK), {})
    return [_row(attempts, best, ours) for attempts in contest]


def _row(attempts: Attempts, best: dict[int, float], ours: dict[int, PeerPlan]) -> Row:
    feasible, times = attempts.feasible, attempts.milliseconds
    pairs = [(plan.seconds, ours[k].seconds) for k, plan in attempts.plans.items() if k in ours]
    programs: Counter[str] = sum((Counter(plan.qps) for plan in attempts.plans.values()), Counter())
    gaps = [(plan.cost - best[k]) / max(best[k], 1e-9) for k, plan in feasible.items()]
    return Row(
        solver=attempts.solver,
        horizon=attempts.horizon,
        obstacles=attempts.obstacles,
        steps=attempts.steps,
        every=attempts.every,
        median_ms=float(np.median(times)) if times.size else None,
        p99_ms=float(np.percentile(times, 99)) if times.size else None,
        max_ms=float(times.max()) if times.size else None,
        ratio=float(np.divide(*np.median(pairs, axis=0))) if pairs else None,
        max_cost_gap=max(gaps, default=None),
        max_violation=max((plan.violation for plan in attempts.plans.values()), default=None),
        failures=attempts.steps - len(feasible),
        programs=dict(programs) or None,
    )
