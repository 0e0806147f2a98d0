"""The summary of a replay: contacts, clearance, progress and time."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from scp_mpc.provenance import provenance
from scp_mpc.simulation.events import Contact, find_contacts, find_meetings
from scp_mpc.simulation.run import Run
from scp_mpc.simulation.there_and_back import arrivals, crossing_of, time_alone

NEW = 1.0  # [s] for which somebody counts as having just appeared
_KINDS = {
    "at rest": "the robot is at rest",
    "struck": "somebody runs into the moving robot",
    "at fault": "the robot runs into somebody",
}


def summarise_replay(run: Run) -> dict[str, Any]:
    """Return the numbers of a replay, ready for JSON; times and distances in SI units."""
    meetings, contacts, line = find_meetings(run), find_contacts(run), crossing_of(run)
    durations = np.diff(run.times[[0, *arrivals(run)]]).tolist()
    beside = (run.positions - line.start) @ np.array([-line.direction[1], line.direction[0]])
    slack = np.array([plan.slack.max(initial=0.0) for plan in run.plans])
    return {
        "steps": run.steps,
        "seconds": float(run.times[-1]),
        "people": len(meetings),
        "people_touched": sum(meeting.touched for meeting in meetings),
        "contacts": _counted(contacts),
        "contacts_by_kind": {
            kind: _counted([contact for contact in contacts if contact.kind == kind])
            for kind in _KINDS
        },
        "min_clearance_m": min((meeting.clearance for meeting in meetings), default=None),
        "start_m": line.start.tolist(),
        "goal_m": line.goal.tolist(),
        "length_m": line.length,
        "passes": len(durations),
        "pass_mean_s": float(np.mean(durations)) if durations else None,
        "pass_max_s": max(durations, default=None),
        "pass_alone_s": time_alone(run),
        "furthest_beside_m": float(np.abs(beside).max()),
        "slack_steps": int((slack > 1e-6).sum()),
        "max_slack_m": float(slack.max()),
        "left_out_steps": sum(plan.left_out > 0 for plan in run.plans),
        "most_left_out": max(plan.left_out for plan in run.plans),
        "median_ms": float(1e3 * np.median(run.seconds)),
        "p99_ms": float(1e3 * np.quantile(run.seconds, 0.99)),
        "max_ms": float(1e3 * run.seconds.max()),
        "tracking_median_ms": float(1e3 * np.median(run.sensing)),
        "statuses": dict(Counter(plan.status.name for plan in run.plans)),
        "seed": run.seed,
        "closest": [
            {"name": run.scene.bodies[meeting.body].name, **asdict(meeting)}
            for meeting in meetings[:10]
        ],
        "provenance": provenance(),
    }


def _counted(contacts: Sequence[Contact]) -> dict[str, int]:
    """How many, and how many of them with somebody who has just appeared."""
    return {"count": len(contacts), "new": sum(contact.seen <= NEW for contact in contacts)}


def replay_table(numbers: dict[str, Any]) -> list[tuple[str, str]]:
    """Return what to print: a name with its unit, and a value, in each row."""
    n = numbers
    statuses = ", ".join(f"{count} {name}" for name, count in sorted(n["statuses"].items()))
    return [
        ("Time [s]; control steps", f"{n['seconds']:.1f}; {n['steps']}"),
        ("People; touched", f"{n['people']}; {n['people_touched']}"),
        (f"Contacts; within {NEW:g} s of appearing", _joined(n["contacts"].values(), 0)),
        *(
            (f"  {text}", _joined(n["contacts_by_kind"][kind].values(), 0))
            for kind, text in _KINDS.items()
        ),
        ("Smallest clearance between discs [m]", _joined([n["min_clearance_m"]])),
        (f"Passes of {n['length_m']:.1f} m that reached the goal", str(n["passes"])),
        ("Time of a pass, mean; longest [s]", _joined([n["pass_mean_s"], n["pass_max_s"]])),
        ("The same with nobody there [s]", _joined([n["pass_alone_s"]])),
        ("Furthest from the straight line [m]", f"{n['furthest_beside_m']:.2f}"),
        ("Steps with slack; largest [m]", f"{n['slack_steps']}; {n['max_slack_m']:.2f}"),
        (
            "Steps with people left out; at most",
            f"{n['left_out_steps']}; {n['most_left_out']}",
        ),
        (
            "Step, median; p99; max [ms]",
            _joined([n[f"{o}_ms"] for o in ("median", "p99", "max")], 1),
        ),
        ("Tracker before it, median [ms]", f"{n['tracking_median_ms']:.1f}"),
        ("Statuses", statuses),
    ]


def _joined(values: Iterable[float | None], digits: int = 2) -> str:
    return "; ".join("none" if value is None else f"{value:.{digits}f}" for value in values)
