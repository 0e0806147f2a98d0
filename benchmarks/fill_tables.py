"""Write the tables of README and docs from the results, with the commit that they come from.

    python benchmarks/fill_tables.py

A table stands between `<!-- table: NAME -->` and `<!-- end -->`. A test fails where what stands
there is not what the results say, where their commit is not an ancestor of this one, or where the
script that measured them is gone.
"""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.tables import table

ROOT = Path(__file__).resolve().parent.parent
RESULTS = ROOT / "benchmarks" / "results"
DOCUMENTS = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
BLOCK = re.compile(r"(<!-- table: ([a-z_ ]+) -->\n).*?(<!-- end -->)", re.DOTALL)

_RISKS = (
    ("`StageRisk`, any contact in the interval", "exact", "stage"),
    ("`JointRisk`, any contact", "exact", "joint, uniform"),
    ("`JointRisk`, iterative", "exact", "joint, iterative"),
    ("`Containment(1 - delta)`, as a stage's risk", "exact", "containment"),
    ("`StageRisk`, samples alone, contact at a sample", "exact", "sample"),
    ("the same", "axes", "sample"),
    ("`StageRisk`, any contact in the interval", "axes", "stage"),
    ("`StageRisk`, samples alone, any contact in the interval", "exact", "samples only"),
    ("the report's margin, 95 % containment, samples alone", "axes", "report"),
)
_DELTAS = (0.1, 0.05, 0.01)
_CLOSED = (
    "scenario-2",
    "scenario-1",
    "crowd-5-N30",
    "crowd-12-N30",
    "crowd-50-N30",
    "crowd-1-N200",
)


def filled(text: str) -> str:
    """A document with its tables as the results say."""
    return BLOCK.sub(lambda found: found[1] + block(found[2]) + "\n" + found[3], text)


def block(name: str) -> str:
    """One table, and where it comes from."""
    make = _OWN.get(name)
    if make is None:
        return (RESULTS / f"{name}.md").read_text(encoding="utf-8").rstrip("\n")
    source, build = make
    content = json.loads((RESULTS / f"{source}.json").read_text(encoding="utf-8"))
    origin = content["provenance"]
    line = (
        f"Commit {origin['commit']}, `{origin['command']}`, {origin['machine']}, "
        f"{origin['cores']} cores, {str(origin['date'])[:10]}."
    )
    return f"{build(content)}\n\n{line}"


def _front(content: dict[str, Any]) -> str:
    """Who solves a step, how quickly, how well."""
    rows = []
    for row in content["rows"]:
        counts = row["programs"] or {}
        solved = sum(counts.get(who, 0) for who in ("osqp", "repaired", "piqp"))
        share = f"{100 * counts['osqp'] / solved:.0f} %" if solved else ""
        rescued = f"{100 * counts.get('piqp', 0) / solved:.1f} %" if solved else ""
        times = (f"{row[key]:.2f}" for key in ("median_ms", "p99_ms", "max_ms"))
        gap = f"{100 * row['max_cost_gap']:.1f} %"
        rows.append((row["solver"], row["horizon"], *times, gap, share, rescued))
    names = (
        "Solver | N | Median [ms] | p99 [ms] | Max [ms] | Worst plan's cost above the best one's "
        "| Programs that OSQP finished | by PIQP"
    )
    return table(names, "lrrrrrrr", rows)


def _risk(content: dict[str, Any]) -> str:
    """The worst scene of each promise, and the upper end of its interval."""
    found = {
        (row["kind"], row["inflation"], row["delta"]): row
        for row in content["open_loop"]
        if row["scale"] == 1
    }
    lines = []
    for label, inflation, kind in _RISKS:
        cells = []
        for delta in _DELTAS:
            row = found.get((kind, inflation, delta))
            if row is None or "measured" not in row:
                cells.append("")
                continue
            text = f"{row['measured']:.4f} ({row['high']:.4f})"
            cells.append(f"**{text}**" if row["low"] > delta else text)
        lines.append((label, f"`{inflation}`", *cells))
    names = "Promise and what is measured | No-go set | delta = 0.1 | 0.05 | 0.01"
    return table(names, "llrrr", lines)


def _wind(content: dict[str, Any]) -> str:
    """The main group: errors, and the difference to the report's way."""
    lines = []
    for row in content["groups"]["main"]:
        ends, beyond = row["rms_interval"], row["beyond_interval"]
        same = not row["rejects"] and row["horizon"] == 30 and "keeps" in row["controller"]
        difference = f"{row['beyond']:+.2f} ({beyond[0]:.2f} to {beyond[1]:.2f})"
        lines.append(
            (
                row["horizon"],
                row["controller"] + (" (the report's way)" if same else ""),
                f"{row['rms_mean']:.2f} ({ends[0]:.2f} to {ends[1]:.2f})",
                "" if same else difference,
                f"{row['usual']:.3f}",
                row["contact"],
                row["slack"],
            )
        )
    names = (
        "N | Controller | RMS error [m] (95 %) | To the report's way [m] (95 %) "
        "| Median error [m] | Contacts | Steps with slack"
    )
    return table(names, "rlllrrr", lines)


def _closed(content: dict[str, Any]) -> str:
    """Closed loops of some worlds, from the benchmark of scaling."""
    rows = {(row["world"], row["multi_start"]): row for row in content["rows"]}
    lines = []
    for world in _CLOSED:
        for multi_start in (False, True):
            row = rows[world, multi_start]
            certified = row["statuses"].get("CONVERGED", 0)
            lines.append(
                (
                    world.split("-N", maxsplit=1)[0].rpartition("-")[0]
                    if world.startswith("crowd")
                    else world,
                    row["horizon"],
                    row["obstacles"],
                    "tried" if multi_start else "off",
                    *(f"{row[key]:.2f}" for key in ("median_ms", "p99_ms", "max_ms")),
                    f"{certified}/{row['steps']}",
                )
            )
    names = (
        "Problem | N | Obstacles | Other ways | Median [ms] | p99 [ms] | Max [ms] "
        "| Certified without slack"
    )
    return table(names, "lrrlrrrr", lines)


_OWN: dict[str, tuple[str, Callable[[dict[str, Any]], str]]] = {
    "front": ("horizon_timing", _front),
    "risk": ("risk", _risk),
    "wind": ("wind", _wind),
    "closed": ("scaling", _closed),
}


if __name__ == "__main__":
    for document in DOCUMENTS:
        before = document.read_text(encoding="utf-8")
        document.write_text(filled(before), encoding="utf-8")
