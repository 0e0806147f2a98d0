"""What counts about a robot among people: contacts, hard limits, times; and sums over many runs.

A contact is with somebody `seen` if that person had been there for a second when it began.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from os import getloadavg
from typing import Any

import numpy as np
from scipy.stats import binomtest

from scp_mpc.arrays import FloatArray
from scp_mpc.problem import Problem
from scp_mpc.scp.braking import AT_REST
from scp_mpc.simulation.events import find_contacts
from scp_mpc.simulation.run import Run

KINDS = ("at rest", "struck", "at fault")
SEEN = 1.0  # [s]
_TOLERANCE = 1e-6  # of limits, in their own units


def judged(run: Run, steps: int | None = None) -> dict[str, Any]:
    """What happened in the first control steps, ready for JSON."""
    end = run.steps if steps is None else steps
    inputs, states, plans = run.inputs[:end], run.states[1 : end + 1], run.plans[:end]
    X = np.array([plan.X for plan in plans])
    statuses = [plan.status.name for plan in plans]
    return {
        "steps": end,
        "contacts": [
            asdict(contact)
            | {"status": statuses[min(int(contact.time / run.problem.model.dt), end - 1)]}
            for contact in find_contacts(run)
            if contact.time <= run.times[end]
        ],
        "beyond": {
            "input": _beyond(inputs, run.problem.u_min, run.problem.u_max),
            "state": _beyond(states, run.problem.x_min, run.problem.x_max),
            "speed": float((speeds(run.problem, states) - _speed_max(run.problem)).max()),
            "planned": float((speeds(run.problem, X) - _speed_max(run.problem)).max()),
        },
        "fastest": float(speeds(run.problem, states).max()),
        "fastest_plan": float(speeds(run.problem, X).max()),
        "way": float(np.linalg.norm(np.diff(run.positions[: end + 1], axis=0), axis=1).sum()),
        "still": float((speeds(run.problem, states) <= AT_REST).mean()),
        "statuses": dict(Counter(statuses)),
        "milliseconds": (1e3 * run.seconds[:end]).round(1).tolist(),
        "load": getloadavg()[0],  # of the machine, in processes that want to run
    }


def speeds(problem: Problem, states: FloatArray) -> FloatArray:
    """Euclidean speeds (...) in states (..., nx) [m/s]."""
    found: FloatArray = np.linalg.norm(states[..., problem.model.velocity], axis=-1)
    return found


def _speed_max(problem: Problem) -> float:
    return np.inf if problem.speed_max is None else problem.speed_max


def _beyond(values: FloatArray, low: FloatArray, high: FloatArray) -> float:
    """By how much the worst of the values (n, k) is beyond its limits (k,); negative if none is."""
    return float(np.maximum(low - values, values - high).max())


def summed(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Add runs up."""
    contacts = [contact for row in rows for contact in row["contacts"]]
    seen = [contact for contact in contacts if contact["seen"] >= SEEN]
    resting = sum(contact["speed"] <= AT_REST for contact in seen)
    times = np.concatenate([row["milliseconds"] for row in rows])
    return {
        "runs": len(rows),
        "steps": len(times),
        "contacts": {kind: sum(c["kind"] == kind for c in contacts) for kind in KINDS},
        "seen": {kind: sum(c["kind"] == kind for c in seen) for kind in KINDS},
        "resting": resting,
        "resting_interval": interval(resting, len(seen)),
        "beyond": {what: max(row["beyond"][what] for row in rows) for what in rows[0]["beyond"]},
        "runs_beyond": sum(max(row["beyond"].values()) > _TOLERANCE for row in rows),
        "fastest": max(row["fastest"] for row in rows),
        "fastest_plan": max(row["fastest_plan"] for row in rows),
        "still": float(np.average([r["still"] for r in rows], weights=[r["steps"] for r in rows])),
        "statuses": dict(sum((Counter(row["statuses"]) for row in rows), Counter())),
        "median_ms": float(np.median(times)),
        "p99_ms": float(np.quantile(times, 0.99)),
        "max_ms": float(times.max()),
        "load": max(row["load"] for row in rows),
    }


def moving(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The contacts that count: somebody seen, and a robot that moves."""
    return [
        {"seed": row["seed"], **contact}
        for row in rows
        for contact in row["contacts"]
        if contact["seen"] >= SEEN and contact["speed"] > AT_REST
    ]


def interval(hits: int, count: int) -> list[float]:
    """The 95 % interval of a share by Clopper and Pearson; all of [0, 1] if there is no trial."""
    if not count:
        return [0.0, 1.0]
    found = binomtest(hits, count).proportion_ci(0.95, method="exact")
    return [float(found.low), float(found.high)]


def cells(total: dict[str, Any]) -> tuple[str, ...]:
    """Contacts, share at rest, runs beyond a limit and times of a summary, for a table."""
    seen = sum(total["seen"].values())
    low, high = (100 * end for end in total["resting_interval"])
    share = f"{100 * total['resting'] / seen:.1f} % ({low:.1f} to {high:.1f})" if seen else ""
    return (
        _joined(total["contacts"]),
        _joined(total["seen"]),
        share,
        str(total["runs_beyond"]),
        ", ".join(f"{total[f'{key}_ms']:.0f}" for key in ("median", "p99", "max")),
    )


CELLS = (
    "Contacts at rest, struck, at fault | of these with somebody seen for 1 s "
    "| of these at rest (95 %) | Runs beyond a hard limit | Step: median, p99, max [ms]"
)


def _joined(counts: dict[str, int]) -> str:
    return ", ".join(str(counts[kind]) for kind in KINDS)
