"""The table of all runs: one row each, units in the header."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Column:
    """One column of the table.

    Attributes:
        header: Title with the unit.
        cell: Turns the numbers of one run into text.
        numeric: Whether to align to the right.
    """

    header: str
    cell: Callable[[dict[str, Any]], str]
    numeric: bool = True


def _fixed(key: str, digits: int, factor: float = 1.0) -> Callable[[dict[str, Any]], str]:
    return lambda row: f"{factor * row[key]:.{digits}f}"


def _count(key: str) -> Callable[[dict[str, Any]], str]:
    return lambda row: str(row[key])


def _range(row: dict[str, Any]) -> str:
    """Sizes s to four digits, one number where both ends print alike."""
    low, high = f"{row['s_low']:.4f}", f"{row['s_high']:.4f}"
    return low if low == high else f"{low} to {high}"


def _share(row: dict[str, Any]) -> str:
    """Percentage cut, not rounded, so that 100 means every step."""
    share = row["certified_share"]
    return "none" if share is None else f"{int(1000 * share + 1e-9) / 10:.1f}"


def _statuses(row: dict[str, Any]) -> str:
    return ", ".join(f"{count} {name}" for name, count in sorted(row["statuses"].items()))


COLUMNS: tuple[Column, ...] = (
    Column("Scenario", _count("name"), numeric=False),
    Column("N", _count("horizon")),
    Column("Steps", _count("steps")),
    Column("RMS tracking error [m]", _fixed("rms_tracking_error_m", 3)),
    Column("Min distance [m]", _fixed("min_distance_m", 3)),
    Column("Min clearance [mm]", _fixed("min_clearance_m", 1, 1e3)),
    Column("s", _range),
    Column("Steps with slack", _count("slack_steps")),
    Column("Max slack [mm]", _fixed("max_slack_m", 1, 1e3)),
    Column("Certified [%]", _share),
    Column("Median [ms]", _fixed("median_ms", 1)),
    Column("p99 [ms]", _fixed("p99_ms", 1)),
    Column("Max [ms]", _fixed("max_ms", 1)),
    Column("Over 200 ms", _count("over_200_ms")),
    Column("Statuses", _statuses, numeric=False),
)

_LEGEND = """\
Distance: between true centres. Clearance: signed distance to the no-go set at s = s_ref, negative
inside. Slack: by how far a plan enters the no-go sets because no plan stays outside. Certified:
share of the steps without slack whose plan meets the KKT conditions of the original problem. Times
are wall-clock for one control step, with the 200 ms of the sampling time as the limit.
"""


def markdown_table(scenarios: Sequence[dict[str, Any]]) -> str:
    """Return the table of the runs in GitHub's Markdown."""
    lines = [
        [column.header for column in COLUMNS],
        ["---:" if column.numeric else ":---" for column in COLUMNS],
        *([column.cell(row) for column in COLUMNS] for row in scenarios),
    ]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def markdown_report(summary: dict[str, Any]) -> str:
    """Return the table with its legend and its provenance."""
    origin, margin = summary["provenance"], summary["margin"]
    source = (
        f"scp-mpc {origin['scp-mpc']}, seed {summary['seed']}, inflation "
        f'"{summary["inflation"]}", s_min = {margin["lower"]:.4f}, s_ref = '
        f"{margin['reference']:.4f}; {origin['machine']}, {origin['cores']} cores, Python "
        f"{origin['python']}, NumPy {origin['numpy']}, OSQP {origin['osqp']}.\n"
    )
    table = markdown_table(summary["scenarios"])
    return f"# Closed-loop runs\n\n{table}\n{_LEGEND}\n{source}"
