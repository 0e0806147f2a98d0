"""A robot among people: recorded crowds, the same made dense, and people who react to it.

    python benchmarks/crowds.py dense --recordings zara01/obsmat.txt hotel/obsmat.txt --out out/x
    python benchmarks/crowds.py recorded --recordings zara01/obsmat.txt hotel/obsmat.txt --out out/x
    python benchmarks/crowds.py reacting --out out/x

dense     40 people per frame, who see neither the robot nor copies of themselves; 200 s each
recorded  people as they were, the whole recording, without a deadline and with the default one
reacting  12 and 20 people who avoid each other and the robot; needs the package pyrvo

A rerun with the same folder does what is missing; one folder for each version of the code.
"""

import argparse
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.crowds_judge import CELLS, cells, moving, summed
from benchmarks.crowds_reacting import ROBOTS, reacting
from benchmarks.crowds_recorded import as_they_were, dense
from benchmarks.processes import in_one_thread
from benchmarks.progress import progress
from benchmarks.tables import table, write
from scp_mpc.simulation.episodes import Episode, run_episodes

RUNS = {"dense": 10, "recorded": 3, "reacting": 20}
PEOPLE = (12, 20)
DENSE: dict[str, dict[str, Any]] = {"at most 1.8 m/s": {"speed_max": 1.8}, "any speed": {}}
RECORDED: dict[str, dict[str, Any]] = {"no deadline": {"deadline": None}, "deadline dt": {}}

Group = tuple[str, ...]


def main(
    kind: str,
    out: Path,
    recordings: list[Path] | None = None,
    runs: int | None = None,
    jobs: int = 1,
    only: str = "",
    solver: str = "osqp",
    echo: Callable[[str], object] = lambda _: None,
) -> None:
    """Run what is missing and write table and numbers.

    Args:
        kind: "dense", "recorded" or "reacting".
        out: Folder for crowds_kind.md and .json, and one .jsonl for each group of runs.
        recordings: Files for the first two.
        runs: How many of each group; their seeds are 0, 1, ...
        jobs: Processes.
        only: Part of the names of the groups to run.
        solver: "osqp" or "native".
        echo: Takes the Markdown table.
    """
    count = RUNS[kind] if runs is None else runs
    rows = in_one_thread(_rows, kind, recordings or [], count, out, jobs, only, solver)
    found = [
        {"group": group, **summed(some), **progress_of(some), "moving": moving(some)}
        for group, some in rows.items()
    ]
    write(out, f"crowds_{kind}", markdown(kind, found), {"rows": found}, echo=echo)


def _rows(
    kind: str,
    recordings: list[Path],
    runs: int,
    out: Path,
    jobs: int,
    only: str,
    solver: str,
) -> dict[Group, list[dict[str, Any]]]:
    every = dict(_episodes(kind, recordings, solver))
    episodes = {group: one for group, one in every.items() if only in ", ".join(group)}
    rows = {}
    with progress(runs * len(episodes), "run") as advance:
        for group, episode in episodes.items():
            name = "-".join([kind, *group]).replace(" ", "-").replace("/", "")
            file = out / f"crowds-{name}.jsonl"
            rows[group] = run_episodes(episode, range(runs), file=file, jobs=jobs, advance=advance)
    return rows


def _episodes(kind: str, recordings: list[Path], solver: str) -> Iterator[tuple[Group, Episode]]:
    """What is run, by group."""
    for file in recordings:
        name = file.parent.name if file.name == "obsmat.txt" else file.stem
        for variant, options in DENSE.items() if kind == "dense" else RECORDED.items():
            episode = dense if kind == "dense" else as_they_were
            yield (name, variant), partial(episode, file=file, options=options, solver=solver)
    if kind == "reacting":
        for robot in ROBOTS:
            for count in PEOPLE:
                yield (
                    (robot, str(count)),
                    partial(reacting, robot=robot, count=count, solver=solver),
                )


def progress_of(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """How far the robots got."""
    if "passes" in rows[0]:
        passes = [seconds for row in rows for seconds in row["passes"]]
        return {
            "people": float(np.mean([row["people"] for row in rows])),
            "passes": len(passes),
            "pass_mean_s": float(np.mean(passes)) if passes else None,
            "way_m": float(np.mean([row["way"] for row in rows])),
        }
    arrived = [row for row in rows if row["arrived"] is not None]
    ratios, times = ([row[key] for row in arrived] or [np.nan] for key in ("ratio", "arrived"))
    return {
        "arrived": len(arrived),
        "ratio_median": float(np.median(ratios)),
        "ratio_max": float(np.max(ratios)),
        "time_median_s": float(np.median(times)),
        "time_max_s": float(np.max(times)),
    }


def markdown(kind: str, rows: list[dict[str, Any]]) -> str:
    """The summary in Markdown, a row for each group."""
    if kind == "reacting":
        names = (
            "Robot | People | Arrived | Path to straight line: median, max "
            f"| Time: median, max [s] | {CELLS} | Fastest plan [m/s]"
        )
        lines = [
            (
                *row["group"],
                f"{row['arrived']} of {row['runs']}",
                f"{row['ratio_median']:.2f}, {row['ratio_max']:.2f}",
                f"{row['time_median_s']:.1f}, {row['time_max_s']:.1f}",
                *cells(row),
                f"{row['fastest_plan']:.3f}",
            )
            for row in rows
        ]
        return table(names, "lrrrrrrrrrr", lines)
    what = "Problem" if kind == "dense" else "Time limit"
    names = (
        f"Scene | {what} | Runs | People at a time "
        f"| Passes | Mean time of a pass [s] | Way per run [m] | {CELLS}"
    )
    lines = [
        (
            *row["group"],
            row["runs"],
            f"{row['people']:.1f}",
            row["passes"],
            "" if row["pass_mean_s"] is None else f"{row['pass_mean_s']:.1f}",
            f"{row['way_m']:.0f}",
            *cells(row),
        )
        for row in rows
    ]
    return table(names, "llrrrrrrrrrr", lines)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kind", choices=RUNS)
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--recordings", type=Path, nargs="+", help="obsmat.txt, or frame id x y")
    parser.add_argument("--runs", type=int, help="of each group")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--solver", default="osqp", help="or native")
    parser.add_argument("--only", default="", help="groups whose names hold this")
    arguments = parser.parse_args()
    if arguments.kind != "reacting" and not arguments.recordings:
        parser.error(f"{arguments.kind} needs --recordings")
    main(**vars(arguments), echo=print)
