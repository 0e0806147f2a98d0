"""Tracking under wind: the report's controller against one that estimates what pushes it.

    python benchmarks/wind.py --out benchmarks/results
    python benchmarks/wind.py --out out/wind --seeds 5 --steps 200

Writes wind.md, wind.json and wind.png, and wind.jsonl from which an interrupted run goes on.

Every variant meets the same winds. A mean over seeds comes with its 95 % interval, by the
percentiles of a bootstrap; two variants are compared seed by seed.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.processes import one_thread_each
from benchmarks.progress import progress
from benchmarks.store import Store
from benchmarks.tables import write
from benchmarks.wind_report import markdown, wind_figure
from benchmarks.wind_variants import (
    ALONE,
    CALM,
    EXACT,
    MAIN,
    OTHERS,
    PREDICTION,
    Variant,
    measures,
)
from scp_mpc.arrays import FloatArray

NAME = "wind"  # of the files
SEEDS = 50
FEW = 10  # for all but the first group
STEPS = 600
WORKERS = 2
_RESAMPLES = 10_000

Row = dict[str, Any]


def main(
    out: Path,
    seeds: int = SEEDS,
    steps: int = STEPS,
    workers: int = WORKERS,
    echo: Callable[[str], object] = lambda _: None,
) -> None:
    """Measure all variants and write table, numbers and figure.

    Runs that an interrupted measurement left in `out` are kept.

    Args:
        out: Folder for wind.md, wind.json, wind.png and wind.jsonl.
        seeds: Winds per variant; for all but the first group at most `FEW`.
        steps: Control steps per run.
        workers: Processes.
        echo: Takes the Markdown table.
    """
    few = min(seeds, FEW)
    plan = {"main": (MAIN, seeds), "calm": (CALM, few), "alone": (ALONE, few)}
    plan |= {
        "others": (OTHERS, few),
        "prediction": (PREDICTION, few),
        "exact": (EXACT, few),
    }
    store = out / f"{NAME}.jsonl"
    rows = {
        group: measured(variants, count, steps, store, workers)
        for group, (variants, count) in plan.items()
    }
    numbers = {"seeds": seeds, "steps": steps, "groups": rows}
    drawing = wind_figure(rows["main"], rows["others"])
    write(out, NAME, markdown(rows, steps), numbers, drawing, echo)


def measured(
    variants: Sequence[Variant],
    seeds: int,
    steps: int,
    store: Path | None = None,
    workers: int = 1,
) -> list[Row]:
    """One row per variant, compared with the first one under the same disturbance.

    Where one keeps to its side, as the report's solver does, all are compared with that one, too.

    Args:
        variants: What to run.
        seeds: Winds per variant; one if nothing about it is drawn.
        steps: Control steps per run.
        store: File of finished runs.
        workers: Processes.
    """
    kept = Store(store, steps=steps)
    counts = {variant: seeds if variant.random else 1 for variant in variants}
    keys = [(v, seed) for seed in range(seeds) for v in variants if seed < counts[v]]
    names = [f"{variant.name}, seed {seed}" for variant, seed in keys]
    missing = [pair for pair in zip(names, keys, strict=True) if pair[0] not in kept]
    if missing:
        with one_thread_each(workers) as pool, progress(len(missing)) as advance:
            futures = {name: pool.submit(measures, *key, steps) for name, key in missing}
            for name, future in futures.items():
                kept.get(name, future.result)
                advance()
    runs = {
        variant: [kept.get(f"{variant.name}, seed {seed}", dict) for seed in range(counts[variant])]
        for variant in variants
    }
    first = {variant.disturbance: runs[variant] for variant in reversed(variants)}
    report = {v.disturbance: runs[v] for v in reversed(variants) if not v.multi_start}
    return [summary(v, runs[v], first[v.disturbance], report.get(v.disturbance)) for v in variants]


def summary(
    variant: Variant,
    runs: Sequence[Row],
    base: Sequence[Row],
    report: Sequence[Row] | None = None,
) -> Row:
    """Means over the seeds with their intervals, and the difference to others in the same winds.

    Args:
        variant: What ran.
        runs: What came of it.
        base: Of the first variant.
        report: Of the first one that keeps to its side.
    """
    rms, other = (np.array([run["rms"] for run in which]) for which in (runs, base))
    middle = np.array([run["median"] for run in runs])
    row: Row = asdict(variant) | {"name": variant.name, "controller": variant.controller}
    row |= {
        "runs": len(runs),
        "rms": rms.tolist(),
        "medians": middle.tolist(),
        "rms_median": float(np.median(rms)),
    }
    row["rms_mean"], row["rms_interval"] = float(rms.mean()), interval(rms)
    row["usual"], row["usual_interval"] = float(middle.mean()), interval(middle)
    row["excess"], row["excess_interval"] = float((rms - other).mean()), interval(rms - other)
    if report is not None:
        beyond = rms - np.array([run["rms"] for run in report])
        row["beyond"], row["beyond_interval"] = float(beyond.mean()), interval(beyond)
    row["clearance"] = min(run["clearance"] for run in runs)
    row["distance"] = min(run["distance"] for run in runs)
    row |= {key: sum(run[key] for run in runs) for key in ("contact", "slack", "not_ok")}
    return row


def interval(values: FloatArray) -> list[float]:
    """Ends of the 95 % interval of a mean, by the bootstrap's percentiles."""
    drawn = np.random.default_rng(0).integers(len(values), size=(_RESAMPLES, len(values)))
    low, high = np.percentile(values[drawn].mean(axis=1), [2.5, 97.5])
    return [float(low), float(high)]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="winds per variant")
    parser.add_argument("--steps", type=int, default=STEPS, help="control steps per run")
    parser.add_argument("--workers", type=int, default=WORKERS, help="processes")
    arguments = parser.parse_args()
    main(arguments.out, arguments.seeds, arguments.steps, arguments.workers, print)
