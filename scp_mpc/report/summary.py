"""The summary of closed-loop runs: what was measured, with what, where."""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from scp_mpc.errors import InvalidArgumentError
from scp_mpc.provenance import provenance
from scp_mpc.report.encounters import slack_steps
from scp_mpc.report.table import markdown_report
from scp_mpc.scp.plan import Status
from scp_mpc.simulation.closed_loop import ClosedLoop
from scp_mpc.simulation.scenarios import DT


def summarise(run: ClosedLoop) -> dict[str, Any]:
    """Return the numbers of one run, ready for JSON.

    Distances are between true centres; clearances are to the no-go set at s = s_ref, negative
    inside. `certified_share` counts the steps with status CONVERGED among those without slack; it
    is None where every step needed slack.
    """
    s = np.concatenate([plan.s for plan in run.plans])
    slack = np.array([plan.slack.max(initial=0.0) for plan in run.plans])
    softened = slack_steps(run)
    certified = np.array([plan.status is Status.CONVERGED for plan in run.plans])
    milliseconds = 1e3 * run.seconds
    return {
        "name": run.scenario.name,
        "horizon": run.problem.horizon,
        "steps": run.steps,
        "rms_tracking_error_m": float(np.sqrt(np.mean(np.square(run.tracking_errors)))),
        "min_distance_m": float(run.distances.min()),
        "min_clearance_m": float(run.clearances.min()),
        "s_low": float(s.min()),
        "s_high": float(s.max()),
        "slack_steps": int(softened.sum()),
        "max_slack_m": float(slack.max()),
        "median_ms": float(np.median(milliseconds)),
        "p99_ms": float(np.quantile(milliseconds, 0.99)),
        "max_ms": float(milliseconds.max()),
        "over_200_ms": int((run.seconds > DT).sum()),
        "statuses": dict(Counter(plan.status.name.lower() for plan in run.plans)),
        "certified_share": None if softened.all() else float(certified[~softened].mean()),
    }


def summarise_all(runs: Sequence[ClosedLoop]) -> dict[str, Any]:
    """Return the numbers of all runs together with what they depend on.

    Raises:
        InvalidArgumentError: There is no run, or they differ in settings, seed, inflation or
            margin, which the summary tells only once.
    """
    if not runs:
        raise InvalidArgumentError("runs", "there is none to summarise")
    first = runs[0]
    if any(_conditions(run) != _conditions(first) for run in runs):
        raise InvalidArgumentError("runs", "not all under the same settings, seed and problem")
    return {
        "scenarios": [summarise(run) for run in runs],
        "settings": asdict(first.settings),
        "seed": first.seed,
        "inflation": first.problem.inflation,
        "margin": asdict(first.problem.size),
        "provenance": provenance(),
    }


def write_summary(runs: Sequence[ClosedLoop], directory: Path) -> dict[str, Any]:
    """Write summary.json and summary.md into a directory and return what is in them."""
    text = json.dumps(summarise_all(runs), indent=2, allow_nan=False) + "\n"
    contents: dict[str, Any] = json.loads(text)  # tuples are lists there
    (directory / "summary.json").write_text(text, encoding="utf-8")
    (directory / "summary.md").write_text(markdown_report(contents), encoding="utf-8")
    return contents


def _conditions(run: ClosedLoop) -> tuple[object, ...]:
    return run.settings, run.seed, run.problem.inflation, run.problem.margin
