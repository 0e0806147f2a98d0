"""Tracking under wind as Markdown tables."""

from collections.abc import Mapping, Sequence
from typing import Any

Row = dict[str, Any]

_HEAD = (
    "| N | Controller | Disturbance | Runs | RMS error [m]: mean (95 %) | median "
    "| Difference (95 %) | To the report's way (95 %) | Median error [m] | Least clearance [m] "
    "| Contacts | Slack steps |\n"
    "|--:|:--|:--|--:|:--|--:|:--|:--|--:|--:|--:|--:|"
)
_GROUPS = {
    "main": "The report's wind, its obstacle, its no-go sets",
    "calm": "No disturbance",
    "alone": "The report's wind without an obstacle",
    "others": "Other disturbances",
    "foresight": "The robot's own spread in the no-go sets",
    "exact": "The report's wind with exact no-go sets",
}


def markdown(groups: Mapping[str, Sequence[Row]], steps: int) -> str:
    """All groups with a line of explanation each."""
    parts = [
        f"{steps} steps per run; the same winds for all variants. The difference is to the first "
        "row with the same disturbance, wind by wind; the report's way is N = 30, nominal, from "
        "the last plan alone. Error: distance from the reference of the same time; its RMS is over "
        "a run, mean and median are over the runs. Clearance: from the no-go set."
    ]
    for group, rows in groups.items():
        if not rows:
            continue
        parts.append(f"{_GROUPS[group]}:")
        lines = [_HEAD, *(_line(row) for row in rows)]
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def _line(row: Row) -> str:
    cells = [
        row["horizon"],
        row["controller"],
        row["disturbance"],
        row["runs"],
        f"{row['rms_mean']:.3f} {_ends(row['rms_interval'])}",
        f"{row['rms_median']:.3f}",
        f"{row['excess']:+.3f} {_ends(row['excess_interval'])}",
        f"{row['beyond']:+.3f} {_ends(row['beyond_interval'])}" if "beyond" in row else "",
        f"{row['usual']:.3f}",
        f"{row['clearance']:.3f}" if row["obstacle"] else "",
        row["contact"],
        row["slack"],
    ]
    return "| " + " | ".join(map(str, cells)) + " |"


def _ends(ends: Sequence[float]) -> str:
    return f"({ends[0]:.3f} to {ends[1]:.3f})"
