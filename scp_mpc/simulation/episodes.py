"""Many seeded episodes, in parallel, that can be interrupted and gone on with.

Each finished episode is one line of a JSON-lines file: its seed, and what the episode returned. A
line that was cut off is read as missing.
"""

import json
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed

from scp_mpc.errors import InvalidArgumentError

Episode = Callable[[int], Mapping[str, Any]]


def run_episodes(
    episode: Episode,
    seeds: Iterable[int],
    *,
    file: Path | str | None = None,
    jobs: int = -1,
    advance: Callable[[], object] = lambda: None,
) -> list[dict[str, Any]]:
    """Return one row per seed, in the order of the seeds; rows in the file are not run again.

    Args:
        episode: A function of a module, or anything else that can be pickled: from a seed to a row
            ready for JSON. Whatever it raises ends the run, and what is finished is kept.
        seeds: Which episodes; each at most once.
        file: Where rows are read from and added to, one file per kind of episode and version of
            the code; None for memory only.
        jobs: Processes; -1 for one per core.
        advance: Called after each row, for a progress bar.

    Raises:
        InvalidArgumentError: A seed is given twice.
    """
    wanted = list(seeds)
    if len(set(wanted)) < len(wanted):
        raise InvalidArgumentError("seeds", "one of them is given twice")
    path = None if file is None else Path(file)
    rows = _read(path)
    for _ in set(rows) & set(wanted):
        advance()
    missing = [seed for seed in wanted if seed not in rows]
    work = (delayed(_row)(episode, seed) for seed in missing)
    parallel = Parallel(n_jobs=jobs, return_as="generator_unordered", batch_size=1)
    for seed, row in parallel(work):
        rows[seed] = row
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("a", encoding="utf-8") as lines:
                lines.write("\n" + json.dumps({"seed": seed, "row": row}))
        advance()
    return [rows[seed] for seed in wanted]


def _row(episode: Episode, seed: int) -> tuple[int, dict[str, Any]]:
    return seed, dict(episode(seed))


def _read(path: Path | None) -> dict[int, dict[str, Any]]:
    found = {}
    if path is not None and path.exists():
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                entry = json.loads(line)
            except json.JSONDecodeError:
                continue
            found[entry["seed"]] = entry["row"]
    return found
