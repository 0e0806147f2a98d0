"""How long one control step takes at the report's two horizons, solver by solver.

    python benchmarks/horizon_timing.py
    python benchmarks/horizon_timing.py --steps 600 --out out/timing

For N = 8 and N = 30 (scenarios 2 and 1), and where asked for 5 and 12 obstacles, a closed-loop run
is recorded once. Every solver then solves its steps from the same guess, in one thread, twenty in a
row as in a control loop, in turns of shuffled order, so that the machine's noise hits all alike:

    scp_mpc               default settings: other ways past the obstacle are tried
    scp_mpc, one start    from the guess alone, as the others
    scp_mpc, piqp         likewise, with PIQP for all programs
    ipopt                 interior points, exact derivatives (CasADi)
    slsqp                 the report's method (SciPy); at N = 30 on every k-th step only
    others                see their modules in `peers/`

As a script, the two horizons with scp_mpc, IPOPT and SLSQP, in about a minute; `run.py` has all of
them. Only scp_mpc uses the multipliers of the guess; the peers have no use for them.
"""

import argparse
import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from benchmarks.attempts import Attempts, Row, rows
from benchmarks.figures import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    PURPLE,
    SKY,
    VERMILION,
    canvas,
    legend_below,
    plain,
)
from benchmarks.peers.ipopt import Ipopt
from benchmarks.peers.ours import Ours
from benchmarks.peers.plan import Peer, PeerMissingError
from benchmarks.peers.slsqp import Slsqp
from benchmarks.peers.staged import SOLVERS, Staged
from benchmarks.processes import in_one_thread
from benchmarks.progress import progress
from benchmarks.recorded import RecordedStep, record
from benchmarks.tables import table, write
from scp_mpc.arrays import as_count
from scp_mpc.problem import Problem
from scp_mpc.settings import Settings
from scp_mpc.simulation.crowds import Crowd
from scp_mpc.simulation.scenarios import DT, SCENARIOS, Scenario

NAME = "horizon_timing"  # of the files
WITH_CROWDS = "horizon"  # likewise, with crowds
SLOW_STEPS = 20
_SCENARIOS: tuple[Scenario | Crowd, ...] = (SCENARIOS["scenario-2"], SCENARIOS["scenario-1"])
CROWDS = (Crowd(30, 5), Crowd(30, 12))
_SHORT = 10  # horizon up to which every solver is quick enough for every step
_SLOW = {"slsqp": 1, "sqp-osqp": 1, "sqp-hpipm": 5}  # and their share
_NOT_FOR_CROWDS = ("slsqp", "sqp-osqp", "sqp-qrqp")  # up to minutes
_BLOCK = 20  # steps that a solver solves in a row

# Line styles tell apart those that share a colour.
_STYLES = {
    "scp_mpc": (BLUE, "-"),
    "scp_mpc, one start": (SKY, "-"),
    "scp_mpc, piqp": (PURPLE, "-"),
    "ipopt": (VERMILION, "-"),
    "fatrop": (ORANGE, "-"),
    "sqp-qrqp": (GREEN, "-"),
    "sqp-hpipm": (GREEN, "--"),
    "sqp-osqp": (GREEN, ":"),
    "slsqp": (BLACK, "-."),
}

_log = logging.getLogger(__name__)

Builders = Mapping[str, Callable[[], Peer]]


def everyone(problem: Problem) -> Builders:
    """All solvers, set up for a problem when they are called, by name."""
    return {
        "scp_mpc": partial(Ours, problem, multi_start=True),
        "scp_mpc, one start": partial(Ours, problem, Settings(multi_start=False)),
        "scp_mpc, piqp": partial(Ours, problem, Settings(multi_start=False, solver="piqp")),
        "ipopt": partial(Ipopt, problem),
        **{name: partial(Staged, problem, name) for name in SOLVERS},
        "slsqp": partial(Slsqp, problem),
    }


def few(problem: Problem) -> Builders:
    """Those of the script."""
    names = ("scp_mpc", "scp_mpc, one start", "ipopt", "slsqp")
    return {name: build for name, build in everyone(problem).items() if name in names}


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
    out: Path,
    steps: int,
    seed: int,
    slow_steps: int = SLOW_STEPS,
    echo: Callable[[str], object] = _log.info,
    crowds: bool = False,
    solvers: Callable[[Problem], Builders] = everyone,
) -> None:
    """Run the benchmark in a process of one thread, echo its table and write its files.

    Args:
        out: Folder for the table, the numbers and the figure.
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
    name = WITH_CROWDS if crowds else NAME
    write(out, name, markdown(summary), {"rows": summary}, figure(contests), echo)


def markdown(summary: Sequence[Row]) -> str:
    """The table in Markdown."""
    names = (
        "Solver | N | Obstacles | Steps | Median [ms] | p99 [ms] | Max [ms] | Ratio "
        "| Cost gap | Violation | Failures | Programs"
    )
    note = "Ratio: of the median to that of `scp_mpc` on the same steps."
    return table(names, "lrrrrrrrrrrl", map(_cells, summary)) + f"\n\n{note}"


def figure(contests: Sequence[Sequence[Attempts]]) -> Figure:
    """Draw the share of steps solved within a time, one panel per contest."""
    count = len(contests)
    drawing, panels = canvas(max(5.2 * count, 11), 5.0, count, sharex=True, sharey=True)
    for axes, contest in zip(panels, contests, strict=True):
        for attempts in contest:
            if attempts.plans:
                colour, line = _STYLES[attempts.solver]
                style: Any = {"color": colour, "linestyle": line, "linewidth": 2.0}
                axes.ecdf(attempts.milliseconds, label=attempts.solver, **style)
        axes.axvline(1e3 * DT, color="black", linewidth=1.2, linestyle=":")
        axes.annotate(
            f"the report's {1e3 * DT:g} ms",
            (1e3 * DT, 0.04),
            xytext=(-5, 0),
            textcoords="offset points",
            fontsize=11,
            rotation=90,
            ha="right",
            va="bottom",
        )
        axes.set_ylim(-0.02, 1.02)
        plain(axes, "x")
        one = contest[0]
        crowd = "1 obstacle" if one.obstacles == 1 else f"{one.obstacles} obstacles"
        axes.set_title(f"N = {one.horizon}, {crowd}", fontsize=14)
        axes.set_xlabel("time per control step [ms]", fontsize=13)
    panels[0].set_ylabel("share of steps", fontsize=13)
    legend_below(drawing, panels[0], 6)
    return drawing


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


def _cells(row: Row) -> tuple[object, ...]:
    times = (_shown(row[key], ".2f") for key in ("median_ms", "p99_ms", "max_ms"))
    errors = (_shown(row[key], ".1e") for key in ("max_cost_gap", "max_violation"))
    steps = f"{row['steps']}" + (f" (1 in {row['every']})" if row["every"] > 1 else "")
    who = (row["solver"], row["horizon"], row["obstacles"], steps)
    return (*who, *times, _shown(row["ratio"], ".2f"), *errors, row["failures"], _programs(row))


def _programs(row: Row) -> str:
    """Who finished which share of the programs."""
    if row["median_ms"] is None:
        return "not installed"
    counts = Counter(row["programs"])
    ranking = counts.most_common()
    return ", ".join(f"{name} {count / counts.total():.1%}" for name, count in ranking) or "n/a"


def _shown(value: float | None, form: str) -> str:
    return "n/a" if value is None else format(value, form)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    results = Path(__file__).parent / "results"
    parser.add_argument("--steps", type=int, default=200, help="control steps per horizon")
    parser.add_argument("--out", type=Path, default=results, help="folder for the results")
    parser.add_argument("--seed", type=int, default=0, help="of the solvers' turns")
    arguments = parser.parse_args()
    main(arguments.out, arguments.steps, arguments.seed, echo=print, solvers=few)
