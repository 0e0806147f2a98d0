"""The report's four scenarios in closed loop: its no-go sets, exact ones, and a soft margin.

    python benchmarks/run.py --only scenarios --out out/bench

600 steps each, seed 0, at the samples alone, as the report does. `scp-mpc report` draws them.
"""

from collections.abc import Callable, Sequence
from typing import Any

from benchmarks.progress import progress
from benchmarks.tables import table
from scp_mpc import MPC, Margin, Settings
from scp_mpc.report.summary import summarise
from scp_mpc.simulation import SCENARIOS

NAME = "scenarios"  # of the files
STEPS = 600
VARIANTS = {"axes": ("axes", None), "exact": ("exact", None), "axes, s_min = 0.5": ("axes", 0.5)}


def rows(steps: int = STEPS) -> list[dict[str, Any]]:
    """Run everything in this process; one row per variant and scenario."""
    with progress(len(VARIANTS) * len(SCENARIOS), "run") as advance:
        return [_row(name, which, steps, advance) for name in VARIANTS for which in SCENARIOS]


def markdown(found: Sequence[dict[str, Any]]) -> str:
    """The table in Markdown."""
    names = (
        "No-go set | Scenario | N | Wind | RMS tracking error [m] | Min clearance [mm] "
        "| Steps with slack | Certified [%] | Median [ms] | p99 [ms] | Max [ms]"
    )
    return table(names, "llrlrrrrrrr", map(_cells, found))


def _row(name: str, which: str, steps: int, advance: Callable[[], object]) -> dict[str, Any]:
    inflation, s_min = VARIANTS[name]
    scenario = SCENARIOS[which]
    margin = Margin() if s_min is None else Margin(lower=s_min)
    shape: Any = inflation
    run = scenario.run(MPC(scenario.problem(shape, margin), Settings(deadline=None)), steps)
    advance()
    return summarise(run) | {"variant": name, "wind": scenario.disturbance is not None}


def _cells(row: dict[str, Any]) -> tuple[object, ...]:
    share = row["certified_share"]
    return (
        f"`{row['variant']}`",
        row["name"].removeprefix("scenario-"),
        row["horizon"],
        "yes" if row["wind"] else "no",
        f"{row['rms_tracking_error_m']:.2f}",
        f"{1e3 * row['min_clearance_m']:.0f}",
        row["slack_steps"],
        "" if share is None else f"{100 * share:.1f}",
        *(f"{row[key]:.2f}" for key in ("median_ms", "p99_ms", "max_ms")),
    )
