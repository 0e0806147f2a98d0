"""The soak: a million control steps in random worlds with faults, in chunks that may be resumed.

Each finished chunk is a line of JSON; a rerun with the same folder does what is missing, and the
sum of all lines is written last.
"""

import json
from collections.abc import Callable
from concurrent.futures import as_completed
from pathlib import Path
from typing import Any

from scp_mpc.arrays import as_count
from scp_mpc.comparison.one_thread import one_thread_each
from scp_mpc.comparison.progress import progress
from scp_mpc.comparison.soak_chunk import run_chunk
from scp_mpc.comparison.soak_table import markdown, summarise
from scp_mpc.comparison.timing_table import measured_on
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.provenance import provenance

STEPS, CHUNK = 1_000_000, 10_000
NAME = "soak"  # of the files


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
    origin = provenance()
    total = summarise(list(_finished(file, seed, sizes).values()))
    text = f"{markdown(total)}\n\n{measured_on(origin)}"
    echo(text)
    (out / f"{NAME}.md").write_text(text + "\n", encoding="utf-8")
    numbers = json.dumps(total | {"seed": seed, "provenance": origin}, indent=2)
    (out / f"{NAME}.json").write_text(numbers + "\n", encoding="utf-8")
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
