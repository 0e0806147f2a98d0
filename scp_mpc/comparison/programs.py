"""QP solvers on the sparse programs of a closed loop, each from scratch, through qpsolvers.

The programs are those of scenario 1's steps, linearised about the controller's guess and about
the ways past the obstacle. What counts is whether a solver's point holds up against the program's
own data, and how long it took to get there from a cold start, set-up included.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from scp_mpc.comparison.progress import progress
from scp_mpc.comparison.sequence import record
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.simulation.scenarios import SCENARIOS
from scp_mpc.scp.iterate import moved
from scp_mpc.solver.oracle import Oracle
from scp_mpc.qp.program import QuadraticProgram
from scp_mpc.scp.solver import SCP
from scp_mpc.solver.sides import candidates
from scp_mpc.solver.step_data import StepData
from scp_mpc.solver.subproblem import Subproblem

NAME = "programs"  # of the files
ACCURACY = 1e-6
SOLVERS: dict[str, dict[str, Any]] = {
    "osqp": {"eps_abs": 1e-7, "eps_rel": 1e-7, "max_iter": 20000, "polishing": True},
    "piqp": {"eps_abs": 1e-9, "eps_rel": 1e-9},
    "daqp": {},
    "clarabel": {},
    "proxqp": {"eps_abs": 1e-9},
    "quadprog": {},
    "highs": {},
    "scs": {"eps_abs": 1e-7, "eps_rel": 1e-7},
}


def recorded(steps: int) -> list[QuadraticProgram]:
    """Copies of the programs at a step's guess, and at each way past an obstacle in conflict."""
    scenario = SCENARIOS["scenario-1"]
    problem = scenario.problem("axes")
    subproblem, plain, found = Subproblem(problem), SCP(problem), []
    position = problem.model.position
    for one in record(scenario, steps, problem=problem):
        step = StepData.read(problem, one.x0, one.x_ref, one.obstacles)
        free = plain.solve(one.x0, one.x_ref).iterate
        here = one.guess.states[1:, position]
        sides = candidates(step, free.states[1:, position], here, free.s)
        subproblem.write_step(step.x0, step.x_ref)
        for path in (here, *(side.path for side in sides)):
            about = moved(one.guess, position, path)
            subproblem.write_half_spaces(step.half_spaces(about.states, about.s))
            p = subproblem.program
            lower, upper = p.lower.copy(), p.upper.copy()
            found.append(QuadraticProgram(p.P, p.q.copy(), p.A.copy(), lower, upper))
    return found


def rows(steps: int, every: int = 5) -> list[dict[str, Any]]:
    """Solve every k-th program with every solver; a missing solver keeps its row.

    Args:
        steps: Control steps of the closed loop.
        every: k.
    """
    programs = recorded(steps)[::every]
    with progress(len(SOLVERS) * len(programs)) as advance:
        return [_row(name, programs, advance) for name in SOLVERS]


def markdown(table: Sequence[dict[str, Any]]) -> str:
    """The table in Markdown."""
    head = (
        "| QP solver | Programs | Solved to 1e-6 | No point | Median [ms] | p99 [ms] "
        "| Max [ms] |\n|:--|--:|--:|--:|--:|--:|--:|"
    )
    return "\n".join([head, *map(_line, table)])


def _row(
    name: str, programs: Sequence[QuadraticProgram], advance: Callable[[], object]
) -> dict[str, Any]:
    row: dict[str, Any] = {"solver": name, "programs": len(programs)}
    try:
        oracle = Oracle(name, **SOLVERS[name])
    except InvalidArgumentError:
        return row | {"solved": None, "none": None, "ms": None}
    times, solved, none = [], 0, 0
    for program in programs:
        found = oracle.solve(program)
        times.append(1e3 * found.seconds)
        none += not found.has_point
        good = found.has_point and program.residuals(found.x, found.y).worst <= ACCURACY
        solved += good
        advance()
    quantiles = np.percentile(times, [50, 99, 100]).tolist()
    return row | {"solved": solved, "none": none, "ms": quantiles}


def _line(row: dict[str, Any]) -> str:
    if row["ms"] is None:
        return f"| {row['solver']} | {row['programs']} | not installed | | | | |"
    times = " | ".join(f"{v:.2f}" for v in row["ms"])
    return f"| {row['solver']} | {row['programs']} | {row['solved']} | {row['none']} | {times} |"
