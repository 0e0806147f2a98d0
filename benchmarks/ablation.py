"""What the parts of the loop and the options of its solver are worth: each taken away in turn.

    python benchmarks/run.py --only ablation --out out/bench

Recorded steps of one, five and twelve obstacles at N = 30 and of one at N = 8, each solved from the
controller's last plan alone, without other ways past. Parts are taken away from outside.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from time import process_time
from typing import Any
from unittest.mock import patch

import numpy as np

from benchmarks.progress import progress
from benchmarks.recorded import RecordedStep, record
from benchmarks.tables import table
from scp_mpc import SCP, Problem, QPSettings, Settings
from scp_mpc.arrays import FloatArray
from scp_mpc.qp.backend import ProgramSolver
from scp_mpc.scp import loop
from scp_mpc.scp.certificate import Nominal
from scp_mpc.scp.transcription import Program, Transcription
from scp_mpc.simulation import SCENARIOS, Crowd, Scenario

NAME = "ablation"  # of the files
_MOST = 200  # SCP iterations
WORLDS: dict[str, Scenario | Crowd] = {
    "1 obstacle, N = 8": SCENARIOS["scenario-2"],
    "1 obstacle, N = 30": SCENARIOS["scenario-1"],
    "5 obstacles": Crowd(30, 5),
    "12 obstacles": Crowd(30, 12),
}
VARIANTS: dict[str, QPSettings | str] = {
    "default": QPSettings(),
    "no warm start": "cold",
    "no Newton step": "convex",
    "no repair": QPSettings(repairs=(0, 0)),
    "one repair each": QPSettings(repairs=(1, 1)),
    "one run of 10": QPSettings(iterations=(10,), repairs=(100,)),
    "one run of 25": QPSettings(iterations=(25,), repairs=(100,)),
    "one run of 100": QPSettings(iterations=(100,), repairs=(100,)),
    "rho = 10": QPSettings(rho=(10.0,)),
    "rho = 30": QPSettings(rho=(30.0,)),
    "rho = 1": QPSettings(rho=(1.0,)),
    "rho = 0.1": QPSettings(rho=(0.1,)),
    "alpha = 1": QPSettings(alpha=1.0),
}


def rows(steps: int) -> list[dict[str, Any]]:
    """Run everything in this process; one row per variant and world."""
    recorded = []
    for name, world in WORLDS.items():
        problem = world.problem("axes")
        recorded.append((name, problem, record(world, steps, problem=problem)))
    with progress(len(VARIANTS) * len(recorded), "run") as advance:
        return [
            _row(variant, name, problem, sequence, advance)
            for variant in VARIANTS
            for name, problem, sequence in recorded
        ]


def markdown(found: Sequence[dict[str, Any]]) -> str:
    """The table in Markdown: variants down, worlds across."""
    names = " | ".join(["Taken away, or changed", *WORLDS])
    lines = []
    for variant in VARIANTS:
        part = [row for row in found if row["variant"] == variant]
        lines.append([variant, *map(_cell, part)])
    note = (
        "Steps that an obstacle shapes. SCP iterations, median and largest; ADMM iterations of a "
        "program, mean; share of programs that OSQP finished, and the rescue's share; processor "
        "time of a step, median."
    )
    return f"{note}\n\n{table(names, 'l' + 'l' * len(WORLDS), lines)}"


def _row(
    variant: str,
    name: str,
    problem: Problem,
    sequence: Sequence[RecordedStep],
    advance: Callable[[], object],
) -> dict[str, Any]:
    what = VARIANTS[variant]
    qp = what if isinstance(what, QPSettings) else QPSettings()
    scp = SCP(problem, Settings(multi_start=False, max_iterations=_MOST, qp=qp))
    counts, times, iterations = Counter[str](), [], []
    admm: list[int] = []
    with _without(what), _counted(admm):
        for step in sequence:
            began = process_time()
            plan = scp.solve(step.x0, step.x_ref, step.obstacles, step.guess, multi_start=False)
            if plan.iterate.touches:
                times.append(1e3 * (process_time() - began))
                iterations.append(plan.iterations)
            counts.update(plan.qps)
    advance()
    solved = sum(counts[who] for who in ("osqp", "repaired", "piqp"))
    return {
        "variant": variant,
        "world": name,
        "iterations": [float(np.median(iterations)), max(iterations)],
        "admm": float(np.mean(admm)),
        "osqp": counts["osqp"] / solved,
        "piqp": counts["piqp"] / solved,
        "median_ms": float(np.median(times)),
    }


@contextmanager
def _without(what: QPSettings | str) -> Iterator[None]:
    """Take a part away."""
    if what == "cold":

        def cold(
            at: Transcription, program: Program, nominal: Nominal
        ) -> tuple[FloatArray, FloatArray]:
            z, y = start(at, program, nominal)
            return 0 * z, 0 * y

        start = Transcription.start
        with patch.object(Transcription, "start", cold):
            yield
    elif what == "convex":
        with patch.object(loop, "refined", lambda _, __, solution: solution):
            yield
    else:
        yield


@contextmanager
def _counted(admm: list[int]) -> Iterator[None]:
    """Note the ADMM iterations of each program."""
    solve = ProgramSolver.solve

    def counting(solver: ProgramSolver, *given: Any) -> Any:
        end = solve(solver, *given)
        admm.append(solver.iterations)
        return end

    with patch.object(ProgramSolver, "solve", counting):
        yield


def _cell(row: dict[str, Any]) -> str:
    middle, most = row["iterations"]
    return (
        f"{middle:g}, {most}; {row['admm']:.1f}; {100 * row['osqp']:.1f} % "
        f"({100 * row['piqp']:.1f} %); {row['median_ms']:.1f} ms"
    )
