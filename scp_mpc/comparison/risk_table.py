"""Promised against measured risk as Markdown tables."""

from collections.abc import Sequence
from typing import Any

Row = dict[str, Any]

_OPEN = (
    "| Promise | No-go set | delta | Measured, worst scene | 95 % interval | Kept "
    "| Scenes broken | Worst scene (coupling) | At the samples alone | All scenes | No plan |\n"
    "|:--|:--|--:|--:|:--|:--|--:|:--|--:|--:|--:|"
)
_COST = "| delta | uniform shares | iterative shares | saved |\n|--:|--:|--:|--:|"
_CLOSED = (
    "| Promise (per plan) | No-go set | delta | Episodes | With contact | Per episode "
    "| 95 % interval | Steps | Plans not ok |\n"
    "|:--|:--|--:|--:|--:|--:|:--|--:|--:|"
)


def markdown(opened: Sequence[Row], closed: Sequence[Row]) -> str:
    """All tables with a line of explanation each."""
    parts = []
    if opened:
        samples = opened[0]["samples"]
        parts += [
            f"Open loop, {samples:,} realisations per scene, coupling and promise; "
            f"{opened[0]['planned']} scenes:",
            _lines(_OPEN, [_open_line(row) for row in opened]),
            "Measured probability over delta, scene by scene (the worst coupling's):",
            _by_scene(opened),
        ]
        costs = _costs(opened)
        if costs:
            parts += [
                "What the shares of a joint risk cost (sum of plan costs, exact; scenes that both "
                "could plan):",
                _lines(_COST, costs),
            ]
    if closed:
        parts += [
            "Closed loop, the same encounters for every promise. The promise is about one plan; an "
            "episode is many of them:",
            _lines(_CLOSED, [_closed_line(row) for row in closed]),
        ]
    return "\n\n".join(parts)


def _lines(head: str, lines: Sequence[Sequence[object]]) -> str:
    return "\n".join([head, *("| " + " | ".join(map(str, line)) + " |" for line in lines)])


def _open_line(row: Row) -> list[object]:
    start = [_promise(row), row["inflation"], f"{row['delta']:g}"]
    if row["verdict"] == "no plan":
        return [*start, "n/a", "n/a", "n/a", 0, "n/a", "n/a", "n/a", row["planned"]]
    return [
        *start,
        f"{row['measured']:.5f}",
        _interval(row),
        {"kept": "yes", "broken": "**no**", "open": "undecided"}[row["verdict"]],
        len(row["broken_in"]),
        f"{row['scene']} ({row['coupling']})",
        f"{row['at_samples']:.5f}",
        f"{row['pooled']:.5f}",
        len(row["skipped"]),
    ]


def _by_scene(opened: Sequence[Row]) -> str:
    """Scenes down, promises across: measured / delta, the report's and the stages' only."""
    shown = [row for row in opened if row["kind"] in ("stage", "sample", "samples only", "report")]
    names = [scene["scene"] for scene in opened[0]["scenes"]]
    titles = [f"{_promise(row)}, {row['inflation']}, {row['delta']:g}" for row in shown]
    head = "| Scene | " + " | ".join(titles) + " |\n|:--" + "|--:" * len(shown) + "|"
    lines = []
    for i, name in enumerate(names):
        cells = (row["scenes"][i] | {"delta": row["delta"]} for row in shown)
        lines.append([name, *map(_ratio, cells)])
    return _lines(head, lines)


def _ratio(scene: Row) -> str:
    if not scene["ok"]:
        return "no plan"
    text = f"{scene['measured'] / scene['delta']:.2f}"
    return f"**{text}**" if scene["low"] > scene["delta"] else text


def _costs(opened: Sequence[Row]) -> list[list[str]]:
    rows = {(row["kind"], row["delta"]): row for row in opened if row["inflation"] == "exact"}
    lines = []
    for kind, delta in rows:
        if kind != "joint, uniform" or ("joint, iterative", delta) not in rows:
            continue
        pairs = [
            (a["cost"], b["cost"])
            for a, b in zip(
                rows[kind, delta]["scenes"], rows["joint, iterative", delta]["scenes"], strict=True
            )
            if a["ok"] and b["ok"]
        ]
        uniform, iterative = (sum(costs) for costs in zip(*pairs, strict=True)) if pairs else (0, 0)
        saved = 1 - iterative / uniform if uniform else 0.0
        lines.append([f"{delta:g}", f"{uniform:.3f}", f"{iterative:.3f}", f"{100 * saved:.1f} %"])
    return lines


def _closed_line(row: Row) -> list[object]:
    return [
        _promise(row),
        row["inflation"],
        f"{row['delta']:g}",
        row["episodes"],
        row["contacts"],
        f"{row['measured']:.4f}",
        _interval(row, 4),
        row["steps"],
        row["unsafe"],
    ]


def _promise(row: Row) -> str:
    return row["kind"] if row["scale"] == 1 else f"{row['kind']} x {row['scale']:g}"


def _interval(row: Row, digits: int = 5) -> str:
    return f"{row['low']:.{digits}f} to {row['high']:.{digits}f}"
