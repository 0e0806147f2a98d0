"""One robot given in several ways: what a user's own model costs against the built-in one.

    python benchmarks/run.py --only user_models --out out/bench

Closed loops of a unicycle on a circuit among five obstacles. The same robot is the built-in one, a
CasADi expression, a plain function f(x, u) as in a textbook with derivatives by differences or by a
complex step, the same with Jacobians by hand, which are called for one point at a time, and with
`math` instead of numpy, so that the function, too, takes no more than one point.
"""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi
import numpy as np

from benchmarks.circuits import Circuit
from benchmarks.progress import progress
from benchmarks.tables import table
from benchmarks.timing import closed_loop, milliseconds
from scp_mpc import CasadiModel, FunctionModel, Model, Settings, Unicycle
from scp_mpc.arrays import FloatArray

NAME = "user_models"  # of the files
DT = 0.2
_PLANE: dict[str, Any] = {"dt": DT, "position": [0, 1], "heading": 2, "velocity": [3]}
WORLDS = {
    "five obstacles": Circuit("unicycle", 30, 5),
    "five obstacles, dense": Circuit("unicycle", 30, 5, dense=True),
}


def rates(x: Any, u: Any) -> Any:
    """The unicycle as in a textbook: x = [p1, p2, theta, v], u = [a, omega]."""
    return np.array([x[3] * np.cos(x[2]), x[3] * np.sin(x[2]), u[1], u[0]])


def single(x: Any, u: Any) -> Any:
    """The same, of one state alone."""
    return np.array([x[3] * math.cos(x[2]), x[3] * math.sin(x[2]), u[1], u[0]])


def slopes(x: FloatArray, u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Its Jacobians of one state."""
    by_x, by_u = np.zeros((4, 4)), np.zeros((4, len(u)))
    by_x[0, 2:] = -x[3] * np.sin(x[2]), np.cos(x[2])
    by_x[1, 2:] = x[3] * np.cos(x[2]), np.sin(x[2])
    by_u[3, 0] = by_u[2, 1] = 1.0
    return by_x, by_u


def symbolic() -> Model:
    """The same as a CasADi expression."""
    x, u = casadi.SX.sym("x", 4), casadi.SX.sym("u", 2)
    g = casadi.vertcat(x[3] * casadi.cos(x[2]), x[3] * casadi.sin(x[2]), u[1], u[0])
    return CasadiModel(g, x, u, **_PLANE)


def function(g: Callable[[Any, Any], Any], jacobians: Any) -> Model:
    """The same as functions."""
    return FunctionModel(g, jacobians, nx=4, nu=2, **_PLANE)


WAYS: Mapping[str, Callable[[], Model]] = {
    "built in": lambda: Unicycle(DT),
    "CasADi expression": symbolic,
    "plain f(x, u)": lambda: function(rates, "central"),
    "plain f(x, u), complex step": lambda: function(rates, "complex"),
    "plain f(x, u), Jacobians point by point": lambda: function(rates, slopes),
    "f(x, u) and Jacobians point by point": lambda: function(single, slopes),
    "f(x, u) point by point": lambda: function(single, "central"),
}


def rows(
    steps: int,
    worlds: Mapping[str, Circuit] = WORLDS,
    ways: Mapping[str, Callable[[], Model]] = WAYS,
) -> list[dict[str, Any]]:
    """Run everything in this process; one row per world and way, the built-in robot first.

    Args:
        steps: Control steps of each closed loop.
        worlds: By name.
        ways: To give the robot, by name.
    """
    with progress(len(worlds) * len(ways) * steps) as advance:
        found = [
            _row(name, worlds[name], way, make(), steps, advance)
            for name in worlds
            for way, make in ways.items()
        ]
    for row in found:
        base = next(one for one in found if one["world"] == row["world"])
        for key in ("median", "p99"):
            row[f"{key}_ratio"] = row["thread"][key] / base["thread"][key]
        row["cost_ratio"] = row["cost"] / base["cost"]
    return found


def markdown(found: Sequence[dict[str, Any]]) -> str:
    """The table in Markdown; times and ratios are those of the thread's processor time."""
    names = (
        "World | Robot given as | Median [ms] | p99 [ms] | Median ratio | p99 ratio "
        "| Sum of costs, ratio | Certified, no slack"
    )
    cells = (
        (
            row["world"],
            row["way"],
            *(f"{row['thread'][key]:.2f}" for key in ("median", "p99")),
            *(f"{row[key]:.2f}" for key in ("median_ratio", "p99_ratio")),
            f"{row['cost_ratio']:.4f}",
            f"{row['statuses'].get('CONVERGED', 0)} of {row['steps']}",
        )
        for row in found
    )
    return table(names, "llrrrrrr", cells)


def _row(
    world: str,
    circuit: Circuit,
    way: str,
    model: Model,
    steps: int,
    advance: Callable[[], object],
) -> dict[str, Any]:
    problem = replace(circuit.problem, model=model)
    run = list(closed_loop(circuit, problem, Settings(deadline=None), steps, advance))
    return {
        "world": world,
        "way": way,
        "steps": steps,
        "wall": milliseconds([step.wall for step in run]),
        "thread": milliseconds([step.thread for step in run]),
        "cost": float(sum(step.plan.cost for step in run)),
        "statuses": dict(Counter(step.plan.status.name for step in run)),
    }
