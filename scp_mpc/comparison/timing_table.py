"""The benchmark's rows as a Markdown table that names machine and commit."""

from collections import Counter
from collections.abc import Mapping, Sequence

from scp_mpc.comparison.attempts import Row

_HEAD = (
    "| Solver | N | Obstacles | Steps | Median [ms] | p99 [ms] | Max [ms] | Ratio "
    "| Cost gap | Violation | Failures | Programs |\n"
    "|:--|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|:--|"
)
_NOTE = "Ratio: of the median to that of `scp_mpc` on the same steps."


def timing_table(summary: Sequence[Row], origin: Mapping[str, str | int | None]) -> str:
    """Return the table of all rows, with a line on where they were measured."""
    return "\n".join([_HEAD, *(_line(row) for row in summary), "", _NOTE, measured_on(origin)])


def measured_on(origin: Mapping[str, str | int | None]) -> str:
    """Return a line on machine, versions, commit and date."""
    names = ("osqp", "piqp", "casadi")
    versions = ", ".join(f"{name} {origin[name] or 'missing'}" for name in names)
    return (
        f"Measured on {origin['machine']}, {origin['cores']} cores, one thread, "
        f"Python {origin['python']}, {versions}, "
        f"commit {origin['commit'] or 'unknown'}, {origin['date']}."
    )


def _line(row: Row) -> str:
    times = (_shown(row[key], ".2f") for key in ("median_ms", "p99_ms", "max_ms"))
    errors = (_shown(row[key], ".1e") for key in ("max_cost_gap", "max_violation"))
    steps = f"{row['steps']}" + (f" (1 in {row['every']})" if row["every"] > 1 else "")
    who = (row["solver"], row["horizon"], row["obstacles"], steps)
    cells = (*who, *times, _shown(row["ratio"], ".2f"), *errors, row["failures"], _programs(row))
    return "| " + " | ".join(map(str, cells)) + " |"


def _programs(row: Row) -> str:
    """Who finished which share of the programs."""
    if row["median_ms"] is None:
        return "not installed"
    counts = Counter(row["programs"])
    ranking = counts.most_common()
    return ", ".join(f"{name} {count / counts.total():.1%}" for name, count in ranking) or "n/a"


def _shown(value: float | None, form: str) -> str:
    return "n/a" if value is None else format(value, form)
