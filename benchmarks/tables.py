"""A benchmark's table in Markdown, and the files in which it is handed out."""

import json
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from scp_mpc.provenance import provenance

_RULES = {"l": ":--", "r": "--:"}


def table(names: str, align: str, rows: Iterable[Sequence[object]]) -> str:
    """Rows under their names, which bars part; `align` has an "l" or an "r" for each column."""
    rule = "|".join(_RULES[side] for side in align)
    lines = ("| " + " | ".join(map(str, row)) + " |" for row in rows)
    return "\n".join([f"| {names} |", f"|{rule}|", *lines])


def command() -> str:
    """What was typed to get here, without folders that only this machine has."""
    script = Path(sys.argv[0])
    if script.parent.name != "benchmarks":
        return ""
    return " ".join(["python", f"benchmarks/{script.name}", *sys.argv[1:]])


def measured_on(origin: Mapping[str, str | int | None]) -> str:
    """A line on machine, versions, commit, date and command."""
    names = ("osqp", "piqp", "casadi")
    versions = ", ".join(f"{name} {origin[name] or 'missing'}" for name in names)
    line = (
        f"Measured on {origin['machine']}, {origin['cores']} cores, one thread, "
        f"Python {origin['python']}, {versions}, "
        f"commit {origin['commit'] or 'unknown'}, {origin['date']}"
    )
    return f"{line}: `{origin['command']}`." if origin.get("command") else f"{line}."


def write(
    out: Path,
    name: str,
    text: str,
    content: Mapping[str, Any],
    figure: Figure | None = None,
    echo: Callable[[str], object] = lambda _: None,
) -> None:
    """Write name.md, name.json and, if there is a figure, name.png.

    Args:
        out: The folder, made if it is not there.
        name: Of the files.
        text: The tables.
        content: The numbers; where they come from is added.
        figure: The figure.
        echo: Takes the tables, too.
    """
    origin = provenance() | {"command": command()}
    text = f"{text}\n\n{measured_on(origin)}"
    echo(text)
    out.mkdir(parents=True, exist_ok=True)
    (out / f"{name}.md").write_text(text + "\n", encoding="utf-8")
    numbers = json.dumps({**content, "provenance": origin}, indent=2)
    (out / f"{name}.json").write_text(numbers + "\n", encoding="utf-8")
    if figure is not None:
        figure.savefig(out / f"{name}.png", dpi=150)
