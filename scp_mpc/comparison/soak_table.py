"""What the chunks of a soak add up to, and the table of it."""

from collections import Counter
from collections.abc import Sequence
from itertools import groupby
from typing import Any

import numpy as np

from scp_mpc.comparison.soak_chunk import PER_DECADE

_SUMS = ("steps", "invalid", "lies", "escaped", "traces", "compared", "late", "timed", "seconds")
_COUNTS = ("statuses", "kinds", "refused", "bins")
_MEGA = 1e6


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
    table = "\n".join(f"| {name} | {value} |" for name, value in rows)
    return f"| What | How much |\n|:--|--:|\n{table}"


def _quantile(bins: dict[str, int], share: float) -> float:
    """Upper edge [ms] of the bin below which that share of the steps lies."""
    if not bins:
        return float("nan")
    edges = sorted(int(edge) for edge in bins)
    below = np.cumsum([bins[str(edge)] for edge in edges])
    at = edges[int(np.searchsorted(below, share * below[-1]))]
    return float(1e3 * 10 ** ((at + 1) / PER_DECADE))
