"""The summary of a replay: contacts, clearance, progress and time."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from scp_mpc.provenance import provenance
from scp_mpc.simulation.meetings import Meeting
from scp_mpc.simulation.replay import Replay

SLOW = 0.3  # [m/s] below which a contact is called one of people with the robot
NEW = 1.0  # [s] for which somebody counts as having just appeared


def summarise_replay(run: Replay, meetings: Sequence[Meeting]) -> dict[str, Any]:
    """Return the numbers of a replay, ready for JSON; times and distances in SI units."""
    touches = [meeting for meeting in meetings if meeting.touched]
    done = [o for o in run.passes if o.reached]
    durations = [float(run.times[o.last] - run.times[o.first]) for o in done]
    line = run.passes[0].crossing
    beside = (run.positions - line.start) @ np.array([-line.direction[1], line.direction[0]])
    return {
        "steps": run.steps,
        "seconds": float(run.times[-1] - run.times[0]),
        "people": len(meetings),
        "contacts": len(touches),
        "contacts_robot_slow": sum(meeting.speed < SLOW for meeting in touches),
        "contacts_person_new": sum(meeting.seen <= NEW for meeting in touches),
        "min_clearance_m": min((meeting.clearance for meeting in meetings), default=None),
        "start_m": line.start.tolist(),
        "goal_m": line.goal.tolist(),
        "length_m": line.length,
        "passes": len(done),
        "pass_mean_s": float(np.mean(durations)) if done else None,
        "pass_max_s": max(durations, default=None),
        "pass_alone_s": run.alone,
        "furthest_beside_m": float(np.abs(beside).max()),
        "slack_steps": int((run.slack > 1e-6).sum()),
        "max_slack_m": float(run.slack.max()),
        "median_ms": float(1e3 * np.median(run.seconds)),
        "p99_ms": float(1e3 * np.quantile(run.seconds, 0.99)),
        "max_ms": float(1e3 * run.seconds.max()),
        "tracking_median_ms": float(1e3 * np.median(run.tracking)),
        "statuses": dict(Counter(status.name for status in run.statuses)),
        "noise_m": run.noise,
        "seed": run.seed,
        "closest": [asdict(meeting) for meeting in meetings[:10]],
        "provenance": provenance(),
    }


def replay_table(numbers: dict[str, Any]) -> list[tuple[str, str]]:
    """Return what to print: a name with its unit, and a value, in each row."""
    n = numbers
    statuses = ", ".join(f"{count} {name}" for name, count in sorted(n["statuses"].items()))
    return [
        ("Time [s]; control steps", f"{n['seconds']:.1f}; {n['steps']}"),
        ("People", str(n["people"])),
        ("People touched", str(n["contacts"])),
        (f"  while the robot is below {SLOW} m/s", str(n["contacts_robot_slow"])),
        (f"  within {NEW:g} s of their appearing", str(n["contacts_person_new"])),
        ("Smallest clearance between discs [m]", _number(n["min_clearance_m"])),
        (f"Passes of {n['length_m']:.1f} m that reached the goal", str(n["passes"])),
        (
            "Time of a pass, mean; longest [s]",
            f"{_number(n['pass_mean_s'])}; {_number(n['pass_max_s'])}",
        ),
        ("The same with nobody there [s]", f"{n['pass_alone_s']:.2f}"),
        ("Furthest from the straight line [m]", f"{n['furthest_beside_m']:.2f}"),
        ("Steps with slack; largest [m]", f"{n['slack_steps']}; {n['max_slack_m']:.2f}"),
        (
            "Step, median; p99; max [ms]",
            f"{n['median_ms']:.1f}; {n['p99_ms']:.1f}; {n['max_ms']:.1f}",
        ),
        ("Tracker before it, median [ms]", f"{n['tracking_median_ms']:.1f}"),
        ("Statuses", statuses),
    ]


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.2f}"
