"""QP solvers on the sparse programs of a closed loop, each from scratch.

    python benchmarks/run.py --only programs --out out/bench

The programs are those of scenario 1's steps, about the controller's guess and about the plan that
ignores the obstacle. What counts is whether a solver's point holds up against the program's own
data, and how long it took to get there from a cold start, set-up included.
"""

from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Any

import numpy as np

from benchmarks.progress import progress
from benchmarks.recorded import record
from benchmarks.tables import table
from scp_mpc.arrays import FloatArray
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.qp.backend import backend
from scp_mpc.qp.program import QuadraticProgram
from scp_mpc.scp.solver import SCP
from scp_mpc.settings import QPSettings
from scp_mpc.simulation.scenarios import SCENARIOS

NAME = "programs"  # of the files
ACCURACY = 1e-6
SOLVERS = ("osqp", "piqp", "daqp", "clarabel", "proxqp", "quadprog", "highs", "scs")
_CHUNK, _CHUNKS = 100, 40  # ADMM iterations between two looks at the residuals; at most so many


def recorded(steps: int) -> list[QuadraticProgram]:
    """The programs about each step's guess, and about the plan that ignores the obstacles."""
    scenario = SCENARIOS["scenario-1"]
    problem = scenario.problem("axes")
    scp, found = SCP(problem), []
    for one in record(scenario, steps, problem=problem):
        given = one.x0, one.x_ref, one.obstacles
        found += [scp.subproblem(*given, guess) for guess in (one.guess, None)]
    return found


def rows(steps: int) -> list[dict[str, Any]]:
    """Solve all programs with every solver; a missing solver keeps its row.

    Args:
        steps: Control steps of the closed loop.
    """
    programs = recorded(steps)
    with progress(len(SOLVERS) * len(programs)) as advance:
        return [_row(name, programs, advance) for name in SOLVERS]


def markdown(found: Sequence[dict[str, Any]]) -> str:
    """The table in Markdown."""
    names = (
        "QP solver | Programs | Solved to 1e-6 | No point | Median residual | Median [ms] "
        "| p99 [ms] | Max [ms]"
    )
    return table(names, "lrrrrrrr", map(_cells, found))


def _row(
    name: str, programs: Sequence[QuadraticProgram], advance: Callable[[], object]
) -> dict[str, Any]:
    row: dict[str, Any] = {"solver": name, "programs": len(programs)}
    times, worst = [], []
    for program in programs:
        began = perf_counter()
        try:
            point = _solved(name, program)
        except InvalidArgumentError:
            return row | {"solved": None, "none": None, "residual": None, "ms": None}
        times.append(1e3 * (perf_counter() - began))
        if point is not None:
            worst.append(program.residuals(*point).worst)
        advance()
    return row | {
        "solved": sum(residual <= ACCURACY for residual in worst),
        "none": len(programs) - len(worst),
        "residual": float(np.median(worst)) if worst else None,
        "ms": np.percentile(times, [50, 99, 100]).tolist(),
    }


def _solved(name: str, program: QuadraticProgram) -> tuple[FloatArray, FloatArray] | None:
    """A solver's point and multipliers from zero, or None."""
    point = None
    solver = backend(
        program, np.flatnonzero(program.lower == program.upper), name, QPSettings(rho=(10.0,))
    )
    solver.load((np.zeros(len(program.q)), np.zeros(len(program.lower))))
    if name != "osqp":
        return solver.run(1)
    for _ in range(_CHUNKS):  # it is run for the active set in the loop, here for the digits
        point = solver.run(_CHUNK)
        if point is None or program.residuals(*point).worst <= ACCURACY:
            break
    return point


def _cells(row: dict[str, Any]) -> list[object]:
    if row["ms"] is None:
        return [row["solver"], row["programs"], "not installed", *[""] * 5]
    cells = [row["solver"], row["programs"], row["solved"], row["none"]]
    cells.append("" if row["residual"] is None else f"{row['residual']:.0e}")
    return cells + [f"{value:.2f}" for value in row["ms"]]
