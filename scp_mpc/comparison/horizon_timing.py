"""How long one control step takes at the report's two horizons, solver by solver.

For N = 8 and N = 30 (scenarios 2 and 1), and where asked for 5 and 12 obstacles, a closed-loop run
is recorded once. Every solver then solves its steps from the same guess, twenty in a row as in a
control loop, in turns of shuffled order, so that the machine's noise hits all alike:

    scp_mpc                  from the guess alone: like for like
    scp_mpc (multi-start)    default settings, trying other ways past the obstacles at every step
    scp_mpc (piqp)           from the guess alone, with PIQP for all programs
    others                   see their modules

Only scp_mpc uses the multipliers of the guess; the peers have no use for them.
"""

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from scp_mpc.arrays import as_count
from scp_mpc.comparison.attempts import Attempts, rows
from scp_mpc.comparison.ipopt import Ipopt
from scp_mpc.comparison.one_thread import in_one_thread
from scp_mpc.comparison.ours import Ours
from scp_mpc.comparison.peer_plan import Peer, PeerMissingError
from scp_mpc.comparison.progress import progress
from scp_mpc.comparison.sequence import RecordedStep, record
from scp_mpc.comparison.slsqp import Slsqp
from scp_mpc.comparison.staged import SOLVERS, Staged
from scp_mpc.comparison.timing_figure import timing_figure
from scp_mpc.comparison.timing_table import timing_table
from scp_mpc.problem import Problem
from scp_mpc.provenance import provenance
from scp_mpc.settings import Settings
from scp_mpc.simulation.crowds import Crowd
from scp_mpc.simulation.scenarios import SCENARIOS, Scenario

NAME = "horizon_timing"  # of the files
WITH_CROWDS = "horizon"  # likewise, with crowds
SLOW_STEPS = 20
_SCENARIOS: tuple[Scenario | Crowd, ...] = (SCENARIOS["scenario-2"], SCENARIOS["scenario-1"])
CROWDS = (Crowd(30, 5), Crowd(30, 12))
_SHORT = 10  # horizon up to which every solver is quick enough for every step
_SLOW = {"slsqp": 1, "sqp-osqp": 1, "sqp-hpipm": 5}  # and their share
_NOT_FOR_CROWDS = ("slsqp", "sqp-osqp", "sqp-qrqp")  # up to minutes
_BLOCK = 20  # steps that a solver solves in a row

_log = logging.getLogger(__name__)

Builders = Mapping[str, Callable[[], Peer]]


def everyone(problem: Problem) -> Builders:
    """All solvers, set up for a problem when they are called, by name."""
    return {
        "scp_mpc": partial(Ours, problem, Settings(multi_start=False)),
        "scp_mpc (multi-start)": partial(Ours, problem, multi_start=True),
        "scp_mpc (piqp)": partial(Ours, problem, Settings(multi_start=False, solver="piqp")),
        "ipopt": partial(Ipopt, problem),
        **{name: partial(Staged, problem, name) for name in SOLVERS},
        "slsqp": partial(Slsqp, problem),
    }


def measure(
    scenario: Scenario | Crowd,
    steps: int,
    seed: int = 0,
    slow_steps: int = SLOW_STEPS,
    advance: Callable[[], object] = lambda: None,
    solvers: Callable[[Problem], Builders] = everyone,
) -> list[Attempts]:
    """Record a scenario and let every solver solve its steps, in this process.

    Args:
        scenario: Whose problem, with the report's inflation.
        steps: Number of control steps.
        seed: Seed of the disturbance and of the solvers' order.
        slow_steps: At horizons beyond 10, SLSQP solves every k-th step only: about this many.
        advance: Called twice per step, when it is recorded and when it is solved by all.
        solvers: Who takes part.
    """
    as_count("steps", steps)
    as_count("slow_steps", slow_steps)
    problem = scenario.problem("axes")
    sequence = record(scenario, steps, seed, problem, advance=advance)
    peers = _set_up(problem, solvers(problem))
    every = dict.fromkeys(peers, 1)
    if problem.horizon > _SHORT:
        slow = {name: share for name, share in _SLOW.items() if name in peers}
        every |= {name: max(1, steps // (slow_steps * share)) for name, share in slow.items()}
    obstacles = len(sequence[0].obstacles)
    contest = [
        Attempts(name, problem.horizon, obstacles, len(range(0, steps, k)), {}, k)
        for name, k in every.items()
    ]
    for peer in peers.values():
        _warm_up(peer, sequence[0])
    order = np.random.default_rng(seed)
    for begin in range(0, steps, _BLOCK):
        block = range(begin, min(begin + _BLOCK, steps))
        for turn in order.permutation(len(contest)):
            attempts = contest[turn]
            peer = peers[attempts.solver]
            if peer is None:
                continue
            for k in block:
                if k % every[attempts.solver] == 0:
                    step = sequence[k]
                    attempts.plans[k] = peer.solve(step.x0, step.x_ref, step.obstacles, step.guess)
        for _ in block:
            advance()
    return contest


def main(
    json_path: Path | None,
    out: Path | None,
    steps: int,
    seed: int,
    slow_steps: int = SLOW_STEPS,
    echo: Callable[[str], None] = _log.info,
    crowds: bool = False,
    solvers: Callable[[Problem], Builders] = everyone,
) -> None:
    """Run the benchmark in a process of one thread, echo its table and write its files.

    Args:
        json_path: File for {"rows": [...], "provenance": {...}}; None for no such file.
        out: Folder for the table and the figure; None for neither.
        steps: Number of control steps per horizon.
        seed: Seed of the disturbance.
        slow_steps: See `measure`.
        echo: Takes the Markdown table.
        crowds: Five and twelve obstacles too.
        solvers: Who takes part: a module's function, for the other process to find.
    """
    scenarios = _SCENARIOS + (CROWDS if crowds else ())
    contests = in_one_thread(_contests, scenarios, steps, seed, slow_steps, solvers)
    summary = [row for contest in contests for row in rows(contest)]
    for row in summary:
        if row["median_ms"] is None:
            _log.warning("%s is not installed: N = %d is empty", row["solver"], row["horizon"])
    origin = provenance()
    table = timing_table(summary, origin)
    echo(table)
    if json_path is not None:
        json_path.parent.mkdir(parents=True, exist_ok=True)
        content = json.dumps({"rows": summary, "provenance": origin}, indent=2)
        json_path.write_text(content + "\n", encoding="utf-8")
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        name = WITH_CROWDS if crowds else NAME
        (out / f"{name}.md").write_text(table + "\n", encoding="utf-8")
        timing_figure(contests).savefig(out / f"{name}.png", dpi=150)


def _contests(
    scenarios: Sequence[Scenario | Crowd],
    steps: int,
    seed: int,
    slow_steps: int,
    solvers: Callable[[Problem], Builders],
) -> list[list[Attempts]]:
    """One contest per scenario, with a progress bar on a terminal."""
    # Among several obstacles a step takes some of the peers seconds.
    counts = [max(steps // 4, 1) if isinstance(one, Crowd) else steps for one in scenarios]
    with progress(2 * sum(counts)) as advance:
        return [
            measure(one, count, seed, slow_steps, advance, solvers)
            for one, count in zip(scenarios, counts, strict=True)
        ]


def _set_up(problem: Problem, builders: Builders) -> dict[str, Peer | None]:
    """The solvers by name; None for one that is not installed, whose row is kept."""
    peers: dict[str, Peer | None] = {}
    for name, build in builders.items():
        if problem.max_obstacles > 1 and name in _NOT_FOR_CROWDS:
            continue
        try:
            peers[name] = build()
        except PeerMissingError as error:
            peers[name] = None
            _log.warning("%s has no results: %s", name, error)
    return peers


def _warm_up(peer: Peer | None, step: RecordedStep) -> None:
    if peer is not None:
        peer.solve(step.x0, step.x_ref, step.obstacles, step.guess)
