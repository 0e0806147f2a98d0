"""The summary of closed-loop runs: what was measured, with what, where; and its table."""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from scp_mpc.errors import InvalidArgumentError
from scp_mpc.provenance import provenance
from scp_mpc.report.encounters import centre_distances, no_go_clearances, scenario_of
from scp_mpc.scp.plan import Status
from scp_mpc.simulation.run import Run

_TEXTS = ("Scenario", "Statuses")  # aligned to the left
_LEGEND = """\
Distance: between true centres. Clearance: signed distance to the no-go set at s = s_ref, negative
inside. Slack: by how far a plan enters the no-go sets because no plan stays outside. Certified:
share of the steps without slack whose plan meets the KKT conditions of the original problem. Times
are wall-clock for one control step, with the 200 ms of the sampling time as the limit.
"""


def summarise(run: Run) -> dict[str, Any]:
    """Return the numbers of one scenario's run, ready for JSON; `_LEGEND` says what they are.

    `certified_share` is None where every step needed slack.
    """
    s = np.concatenate([plan.s for plan in run.plans])
    slack = np.array([plan.slack.max(initial=0.0) for plan in run.plans])
    softened = slack > run.settings.tolerance
    certified = np.array([plan.status is Status.CONVERGED for plan in run.plans])
    milliseconds = 1e3 * run.seconds
    return {
        "name": scenario_of(run).name,
        "horizon": run.problem.horizon,
        "steps": run.steps,
        "rms_tracking_error_m": float(np.sqrt(np.mean(np.square(run.tracking_errors)))),
        "min_distance_m": float(centre_distances(run).min()),
        "min_clearance_m": float(no_go_clearances(run).min()),
        "s_low": float(s.min()),
        "s_high": float(s.max()),
        "slack_steps": int(softened.sum()),
        "max_slack_m": float(slack.max()),
        "median_ms": float(np.median(milliseconds)),
        "p99_ms": float(np.quantile(milliseconds, 0.99)),
        "max_ms": float(milliseconds.max()),
        "over_200_ms": int((run.seconds > run.problem.model.dt).sum()),
        "statuses": dict(Counter(plan.status.name.lower() for plan in run.plans)),
        "certified_share": None if softened.all() else float(certified[~softened].mean()),
    }


def summarise_all(runs: Sequence[Run]) -> dict[str, Any]:
    """Return the numbers of all runs together with what they depend on.

    Raises:
        InvalidArgumentError: There is no run, or they differ in settings, seed, inflation or
            margin, which the summary tells only once.
    """
    if not runs:
        raise InvalidArgumentError("runs", "there is none to summarise")
    first = runs[0]
    told = [(run.settings, run.seed, run.problem.inflation, run.problem.margin) for run in runs]
    if any(one != told[0] for one in told):
        raise InvalidArgumentError("runs", "not all under the same settings, seed and problem")
    return {
        "scenarios": [summarise(run) for run in runs],
        "settings": asdict(first.settings),
        "seed": first.seed,
        "inflation": first.problem.inflation,
        "margin": asdict(first.problem.size),
        "provenance": provenance(),
    }


def write_summary(runs: Sequence[Run], directory: Path) -> dict[str, Any]:
    """Write summary.json and summary.md into a directory and return what is in them."""
    text = json.dumps(summarise_all(runs), indent=2, allow_nan=False) + "\n"
    contents: dict[str, Any] = json.loads(text)  # tuples are lists there
    (directory / "summary.json").write_text(text, encoding="utf-8")
    origin, margin = contents["provenance"], contents["margin"]
    source = (
        f"scp-mpc {origin['scp-mpc']}, seed {contents['seed']}, inflation "
        f'"{contents["inflation"]}", s_min = {margin["lower"]:.4f}, s_ref = '
        f"{margin['reference']:.4f}; {origin['machine']}, {origin['cores']} cores, Python "
        f"{origin['python']}, NumPy {origin['numpy']}, OSQP {origin['osqp']}.\n"
    )
    table = markdown_table(contents["scenarios"])
    text = f"# Closed-loop runs\n\n{table}\n{_LEGEND}\n{source}"
    (directory / "summary.md").write_text(text, encoding="utf-8")
    return contents


def table_cells(row: dict[str, Any]) -> dict[str, str]:
    """Return one run's row of the table: its texts under their headers, units in these."""
    low, high = f"{row['s_low']:.4f}", f"{row['s_high']:.4f}"
    share = row["certified_share"]  # cut, not rounded, so that 100 means every step
    return {
        "Scenario": row["name"],
        "N": f"{row['horizon']}",
        "Steps": f"{row['steps']}",
        "RMS tracking error [m]": f"{row['rms_tracking_error_m']:.3f}",
        "Min distance [m]": f"{row['min_distance_m']:.3f}",
        "Min clearance [mm]": f"{1e3 * row['min_clearance_m']:.1f}",
        "s": low if low == high else f"{low} to {high}",
        "Steps with slack": f"{row['slack_steps']}",
        "Max slack [mm]": f"{1e3 * row['max_slack_m']:.1f}",
        "Certified [%]": "none" if share is None else f"{int(1000 * share + 1e-9) / 10:.1f}",
        "Median [ms]": f"{row['median_ms']:.1f}",
        "p99 [ms]": f"{row['p99_ms']:.1f}",
        "Max [ms]": f"{row['max_ms']:.1f}",
        "Over 200 ms": f"{row['over_200_ms']}",
        "Statuses": ", ".join(f"{count} {name}" for name, count in sorted(row["statuses"].items())),
    }


def markdown_table(scenarios: Sequence[dict[str, Any]]) -> str:
    """Return the table of one run or more in GitHub's Markdown."""
    rows = [table_cells(row) for row in scenarios]
    rule = [":---" if header in _TEXTS else "---:" for header in rows[0]]
    lines = [list(rows[0]), rule, *(list(row.values()) for row in rows)]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)
