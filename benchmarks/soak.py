"""The soak: a million control steps in random worlds with faults, in chunks that may be resumed.

    python benchmarks/soak.py --out benchmarks/results

Each finished chunk is a line of JSON; a rerun with the same folder does what is missing, and the
sum of all lines is written last.
"""

import argparse
import json
from collections import Counter
from collections.abc import Callable, Sequence
from concurrent.futures import as_completed
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.processes import one_thread_each
from benchmarks.progress import progress
from benchmarks.soak_chunk import PER_DECADE, run_chunk
from benchmarks.tables import table, write
from scp_mpc.arrays import as_count
from scp_mpc.errors import InvalidArgumentError

STEPS, CHUNK = 1_000_000, 10_000
NAME = "soak"  # of the files
_SUMS = ("steps", "invalid", "lies", "escaped", "traces", "compared", "late", "timed", "seconds")
_COUNTS = ("statuses", "kinds", "refused", "bins")
_MEGA = 1e6


def run_soak(
    out: Path,
    steps: int = STEPS,
    seed: int = 0,
    workers: int = 2,
    chunk: int = CHUNK,
    echo: Callable[[str], object] = lambda _: None,
) -> dict[str, Any]:
    """Run what is missing, write table and numbers, and return the numbers.

    Args:
        out: Folder for the chunks, the table and the numbers.
        steps: Control steps in all.
        seed: Of the worlds; each chunk is a child of it, whoever runs it.
        workers: Processes.
        chunk: Control steps per chunk.
        echo: Takes the Markdown table.

    Raises:
        InvalidArgumentError: The folder holds chunks of another seed or size.
    """
    for name, value in {"steps": steps, "workers": workers, "chunk": chunk}.items():
        as_count(name, value)
    as_count("seed", seed, least=0)
    out.mkdir(parents=True, exist_ok=True)
    file = out / f"{NAME}.jsonl"
    sizes = {k: min(chunk, steps - k * chunk) for k in range(-(-steps // chunk))}
    done = _finished(file, seed, sizes)
    missing = [k for k in sizes if k not in done]
    with one_thread_each(workers) as pool, progress(len(missing), "chunk") as advance:
        futures = [pool.submit(run_chunk, seed, k, sizes[k]) for k in missing]
        for future in as_completed(futures):
            with file.open("a", encoding="utf-8") as lines:
                lines.write(json.dumps(future.result()) + "\n")
            advance()
    total = summarise(list(_finished(file, seed, sizes).values()))
    write(out, NAME, markdown(total), total | {"seed": seed}, echo=echo)
    return total


def _finished(file: Path, seed: int, sizes: dict[int, int]) -> dict[int, dict[str, Any]]:
    """Lines by chunk, in the order they were written; a torn last line is cut off."""
    if not file.exists():
        return {}
    text = file.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        file.write_text(whole, encoding="utf-8")
    done = {}
    for line in map(json.loads, whole.splitlines()):
        if line["seed"] != seed or sizes.get(line["chunk"]) != line["steps"]:
            raise InvalidArgumentError(
                "out",
                f"{file} holds chunk {line['chunk']} of {line['steps']} steps, seed "
                f"{line['seed']}; take another folder, or the same seed, steps and chunk",
            )
        done[line["chunk"]] = line
    return done


def summarise(lines: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Add up chunks, in whatever order they ended.

    Memory is taken from the end of a worker's first chunk to the end of its last one.
    """
    total: dict[str, Any] = {key: sum(line[key] for line in lines) for key in _SUMS}
    for key in _COUNTS:
        total[key] = dict(sum((Counter(line[key]) for line in lines), Counter()))
    bins = total.pop("bins")
    by_worker = sorted(lines, key=lambda line: str(line["worker"]))  # keeps the order within each
    memory = []
    for worker, chunks in groupby(by_worker, key=lambda line: str(line["worker"])):
        sizes = [chunk["resident"] / _MEGA for chunk in chunks]
        memory.append(
            {
                "worker": worker,
                "chunks": len(sizes),
                "first_mb": sizes[0],
                "last_mb": sizes[-1],
                "growth_mb": sizes[-1] - sizes[0],
            }
        )
    examples = [example for line in lines for example in line["examples"]]
    return total | {
        "bad_calls": sum(total["refused"].values()),
        "median_ms": _quantile(bins, 0.5),
        "p99_ms": _quantile(bins, 0.99),
        "slowest_ms": 1e3 * max((line["slowest"] for line in lines), default=0.0),
        "memory": memory,
        "examples": examples[:20],
    }


def markdown(total: dict[str, Any]) -> str:
    """The summary in Markdown."""
    steps = max(total["steps"], 1)
    rows = [("control steps", f"{total['steps']:,}")]
    rows += [
        (f"`{name}`", f"{count:,} ({100 * count / steps:.2f} %)")
        for name, count in sorted(total["statuses"].items())
    ]
    rows += [
        ("inputs that cannot be applied", f"{total['invalid']:,}"),
        ("`ok` plans that violate a constraint", f"{total['lies']:,}"),
        ("bad calls, each refused by its typed error", f"{total['bad_calls']:,}"),
        ("other exceptions, bad calls accepted", f"{total['escaped']:,}"),
        ("steps compared with a controller without bad calls", f"{total['compared']:,}"),
        ("of these different", f"{total['traces']:,}"),
        ("steps with a deadline of 2 ms", f"{total['timed']:,}"),
        ("of these later than 3 ms", f"{total['late']:,}"),
        ("median, p99 [ms]", f"{total['median_ms']:.2f}, {total['p99_ms']:.2f}"),
        ("slowest step [ms]", f"{total['slowest_ms']:.1f}"),
    ]
    rows += [
        (
            f"memory of worker {k + 1} after its first and last of {one['chunks']} chunks [MB]",
            f"{one['first_mb']:.1f}, {one['last_mb']:.1f} ({one['growth_mb']:+.1f})",
        )
        for k, one in enumerate(total["memory"])
    ]
    rows += [("processor time [min]", f"{total['seconds'] / 60:.1f}")]
    return table("What | How much", "lr", rows)


def _quantile(bins: dict[str, int], share: float) -> float:
    """Upper edge [ms] of the bin below which that share of the steps lies."""
    if not bins:
        return float("nan")
    edges = sorted(int(edge) for edge in bins)
    below = np.cumsum([bins[str(edge)] for edge in edges])
    at = edges[int(np.searchsorted(below, share * below[-1]))]
    return float(1e3 * 10 ** ((at + 1) / PER_DECADE))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for chunks and results")
    parser.add_argument("--steps", type=int, default=STEPS, help="control steps in all")
    parser.add_argument("--seed", type=int, default=0, help="of the worlds")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--chunk", type=int, default=CHUNK, help="control steps per chunk")
    counted = run_soak(**vars(parser.parse_args()), echo=print)
    raise SystemExit(any(counted[what] for what in ("invalid", "lies", "escaped", "traces")))
