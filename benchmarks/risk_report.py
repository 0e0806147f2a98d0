"""Promised against measured risk: tables, and a figure with a step where each promise ends."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.figures import BLACK, BLUE, VERMILION, canvas, legend_below, plain
from benchmarks.tables import table

Row = dict[str, Any]

_OPEN = (
    "Promise | No-go set | delta | Measured, worst scene | 95 % interval | Kept "
    "| Scenes broken | Worst scene (coupling) | At the samples alone | All scenes | No plan"
)
_COST = "delta | uniform shares | iterative shares | saved"
_CLOSED = (
    "Promise (per plan) | No-go set | delta | Episodes | With contact | Per episode "
    "| 95 % interval | Steps | Plans not ok"
)

_COLOURS = {"exact": BLUE, "axes": VERMILION}  # filled against hollow helps in print
_MARKERS = {
    "stage": "o",
    "sample": "v",
    "samples only": "X",
    "joint, uniform": "s",
    "joint, iterative": "D",
    "containment": "^",
    "report": "*",
}
_KINDS = tuple(_MARKERS)
_MISTAKE = BLACK  # of what promises nothing between the samples
_OFFSET = 1.065  # factor between neighbours that promise the same
_FLOOR = 2e-5


def markdown(opened: Sequence[Row], closed: Sequence[Row]) -> str:
    """All tables with a line of explanation each."""
    parts = []
    if opened:
        samples = opened[0]["samples"]
        parts += [
            f"Open loop, {samples:,} realisations per scene, coupling and promise; "
            f"{opened[0]['planned']} scenes:",
            table(_OPEN, "llrrllrlrrr", map(_open_line, opened)),
            "Measured probability over delta, scene by scene (the worst coupling's):",
            _by_scene(opened),
        ]
        costs = _costs(opened)
        if costs:
            parts += [
                "What the shares of a joint risk cost (sum of plan costs, exact; scenes that both "
                "could plan):",
                table(_COST, "rrrr", costs),
            ]
    if closed:
        parts += [
            "Closed loop, the same encounters for every promise. The promise is about one plan; an "
            "episode is many of them:",
            table(_CLOSED, "llrrrrlrr", map(_closed_line, closed)),
        ]
    return "\n\n".join(parts)


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
    lines = []
    for i, name in enumerate(names):
        cells = (row["scenes"][i] | {"delta": row["delta"]} for row in shown)
        lines.append([name, *map(_ratio, cells)])
    return table(" | ".join(["Scene", *titles]), "l" + "r" * len(shown), lines)


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


def risk_figure(opened: Sequence[Row], closed: Sequence[Row] = ()) -> Figure:
    """Draw the worst scene of each promise; beside it, the episodes in contact if there are any.

    Args:
        opened: Rows of `risk.open_loop`.
        closed: Rows of `risk.closed_loop`.
    """
    figure, panels = canvas(13.0 if closed else 8.0, 7.0, 2 if closed else 1)
    _panel(panels[0], opened)
    panels[0].set_title("open loop: the worst scene", fontsize=14)
    panels[0].set_ylabel("measured probability of contact [1]", fontsize=14)
    if closed:
        _panel(panels[1], closed, promised=False)
        panels[1].set_title("closed loop: episodes in contact (not promised)", fontsize=14)
        panels[1].set_ylabel("share of episodes with contact [1]", fontsize=14)
    legend_below(figure, panels[0], 3)
    return figure


def _panel(axes: Axes, rows: Sequence[Row], promised: bool = True) -> None:
    shown = [row for row in rows if "measured" in row]
    deltas = sorted({row["delta"] for row in shown})
    span = np.array([min(deltas) / 1.8, max(deltas) * 1.8])
    floor = max(_FLOOR, min([1e-4, *(row["high"] / 2 for row in shown)]))
    axes.plot(span, span, color="black", linewidth=1.0, linestyle=":", label="diagonal")
    series = {(row["inflation"], row["kind"]) for row in shown}
    ordered = [(i, k) for i in _COLOURS for k in _KINDS if (i, k) in series]
    width = _OFFSET ** (len(ordered) / 2)
    # Neighbours stand aside of the diagonal: a step for each.
    for at, delta in enumerate(deltas if promised else []):
        step = np.array([delta / width, delta * width])
        label = "promise: at most delta" if at == 0 else None
        axes.fill_between(step, delta, 1.2, color="#999999", alpha=0.15, linewidth=0)
        axes.plot(step, [delta, delta], color="black", linewidth=2.0, label=label)
    for place, (inflation, kind) in enumerate(ordered):
        part = [row for row in shown if (row["inflation"], row["kind"]) == (inflation, kind)]
        shift = _OFFSET ** (place - (len(ordered) - 1) / 2)
        measured = np.array([row["measured"] for row in part])
        ends = np.array([[row["low"], row["high"]] for row in part]).T
        color = _MISTAKE if kind == "samples only" else _COLOURS[inflation]
        axes.errorbar(
            [shift * row["delta"] for row in part],
            np.maximum(measured, floor),
            yerr=np.abs(np.maximum(ends, floor) - np.maximum(measured, floor)),
            color=color,
            marker=_MARKERS[kind],
            markerfacecolor="white" if inflation == "axes" else color,
            markersize=14 if kind == "report" else 9,
            markeredgewidth=1.8,
            elinewidth=1.8,
            capsize=4,
            linestyle="none",
            label=f"{inflation}: {kind}",
        )
    plain(axes, "xy", deltas, size=13)
    axes.set_xlim(*span)
    top = max([span[1], *(1.3 * row["high"] for row in shown)])
    axes.set_ylim(floor, min(top, 1.2))
    axes.set_xlabel("promised probability delta [1]", fontsize=14)
    if promised:
        axes.text(
            0.03,
            0.03,
            "grey: promise broken",
            transform=axes.transAxes,
            fontsize=13,
            va="bottom",
            color="#555555",
        )
