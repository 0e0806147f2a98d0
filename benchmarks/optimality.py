"""How good the plans are: against the best that IPOPT finds from many starts.

    python benchmarks/run.py --only optimality --out out/bench

On every step of scenarios 1 and 2 in closed loop at which an obstacle shapes the plan, IPOPT
starts from the guess that the controller had and from random paths: the free plan, bent by up to
four metres in a random direction, ever more along a random part of the horizon.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from benchmarks.attempts import TOLERATED
from benchmarks.peers.ipopt import Ipopt
from benchmarks.progress import progress
from benchmarks.tables import table
from scp_mpc.control.mpc import MPC
from scp_mpc.geometry.margin import Margin
from scp_mpc.scp.solver import SCP
from scp_mpc.settings import Settings
from scp_mpc.simulation.scenarios import SCENARIOS, Scenario
from scp_mpc.trajectory import Trajectory

NAME = "optimality"  # of the files
STARTS = 24
CASES = (("scenario-2", None), ("scenario-1", None), ("scenario-2", 0.5), ("scenario-1", 0.5))
_WITHIN = 0.01


def rows(steps: int, starts: int = STARTS, seed: int = 0) -> list[dict[str, Any]]:
    """Run all cases in this process; one row each.

    Args:
        steps: Control steps of each closed loop.
        starts: IPOPT's starts at each active step, the guess included.
        seed: Of the random starts.
    """
    with progress(steps * len(CASES)) as advance:
        return [
            measure(SCENARIOS[name], s_min, steps, starts, seed, advance) for name, s_min in CASES
        ]


def measure(
    scenario: Scenario,
    s_min: float | None,
    steps: int,
    starts: int,
    seed: int,
    advance: Callable[[], object] = lambda: None,
) -> dict[str, Any]:
    """Drive one scenario and compare its active steps; see `rows`."""
    margin = None if s_min is None else Margin(lower=s_min)
    problem = scenario.problem("axes", margin)
    mpc, plain, peer = MPC(problem, Settings(deadline=None)), SCP(problem), Ipopt(problem)
    rng = np.random.default_rng(seed)
    x, total, gaps, dt = scenario.start(), 0.0, [], problem.model.dt
    for k in range(steps):
        x_ref = scenario.x_ref(k * dt)
        obstacles = scenario.predictions(k * dt, dt, problem.horizon)
        free = plain.solve(x, x_ref)
        guess = mpc.nominal() or free.iterate
        plan = mpc.step(x, x_ref, obstacles)
        if plan.iterate.touches:
            paths = [guess] + [_bent(free.X, free.U, rng) for _ in range(starts - 1)]
            found = [peer.solve(x, x_ref, obstacles, path) for path in paths]
            costs = [one.cost for one in found if one.ok and one.violation <= TOLERATED]
            best = min(costs, default=np.inf)
            gaps.append((plan.cost - best) / best if np.isfinite(best) else -np.inf)
        total += plan.cost
        x = problem.model.step(x, plan.u0)
        advance()
    return {
        "scenario": scenario.name,
        "horizon": scenario.horizon,
        "s_min": problem.size.lower,
        "steps": steps,
        "cost": total,
        "active": len(gaps),
        "within": sum(gap <= _WITHIN for gap in gaps),
        "better": sum(gap < -_WITHIN for gap in gaps),
        "worst": max(gaps, default=0.0),
        "starts": starts,
    }


def markdown(found: Sequence[dict[str, Any]]) -> str:
    """The table in Markdown."""
    names = (
        "N | s_min | Sum of plan costs | Active steps | Within 1 % of the best of IPOPT's starts "
        "| More than 1 % better | Largest gap"
    )
    cells = (
        (
            row["horizon"],
            f"{row['s_min']:.2f}",
            f"{row['cost']:.1f}",
            row["active"],
            row["within"],
            row["better"],
            f"{row['worst']:.1%}",
        )
        for row in found
    )
    return table(names, "rrrrrrr", cells)


def _bent(states: Any, inputs: Any, rng: np.random.Generator) -> Trajectory:
    N = len(states) - 1
    angle, reach = rng.uniform(0, 2 * np.pi), rng.uniform(0.2, 4.0)
    share = np.minimum(1.0, np.arange(N + 1) / (N * rng.uniform(0.05, 1.0)))
    bent = states.copy()
    bent[:, [0, 2]] += reach * share[:, None] * [np.cos(angle), np.sin(angle)]
    return Trajectory(bent, inputs)
