"""Whether what is ok stays ok, and who arrives, in random worlds that keep their word.

    python benchmarks/safety.py --kind moving --episodes 2000 --out out/safety

Each episode draws a world and drives through it: `MPC` without a deadline, whose model is exact and
whose predictions come true. Its reference is the shortest path around what stands; in the first few
worlds it drives once more, with the goal alone as reference. From the first ok step on, every step
is to be ok, and there is to be no contact in continuous time. Goals count as reachable where a grid
search proves them to be, with clearance and time to spare. A rerun with the same folder does what
is missing; one folder for each version of the code.
"""

import argparse
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from benchmarks.processes import in_one_thread
from benchmarks.progress import progress
from benchmarks.safety_drive import Drive, drive
from benchmarks.safety_search import is_reachable
from benchmarks.safety_worlds import SHARES, World
from benchmarks.tables import table, write
from scp_mpc.scp.braking import AT_REST
from scp_mpc.simulation.episodes import run_episodes

EPISODES, ALONE = 2000, 60
TOUCHING = -1e-5  # [m], beyond the tolerance of the plans and of the judge
_KINDS = ("standing", "moving")


def main(
    kind: str,
    out: Path,
    episodes: int = EPISODES,
    alone: int = ALONE,
    jobs: int = 1,
    solver: str = "osqp",
    echo: Callable[[str], object] = lambda _: None,
) -> None:
    """Run what is missing and write table and numbers.

    Args:
        kind: Of the obstacles, "standing" or "moving".
        out: Folder for safety-kind.jsonl, -alone.jsonl, .md and .json.
        episodes: How many; their seeds are 0, 1, ...
        alone: How many of them once more, with the goal alone as reference.
        jobs: Processes.
        solver: "osqp" or "native".
        echo: Takes the Markdown table.
    """
    name = f"safety-{kind}"
    rows = in_one_thread(_rows, kind, episodes, out / f"{name}.jsonl", jobs, True, solver)
    less = in_one_thread(_rows, kind, alone, out / f"{name}-alone.jsonl", jobs, False, solver)
    totals = {"path": summarise(rows), "goal alone": summarise(less)}
    content = {"kind": kind, **totals, "broken": broken(rows)}
    write(out, name.replace("-", "_"), markdown(totals), content, echo=echo)


def _rows(
    kind: str, episodes: int, file: Path, jobs: int, along: bool, solver: str
) -> list[dict[str, Any]]:
    with progress(episodes, "episode") as advance:
        one = partial(episode, moving=kind == "moving", along=along, solver=solver)
        return run_episodes(one, range(episodes), file=file, jobs=jobs, advance=advance)


def episode(seed: int, moving: bool, along: bool = True, solver: str = "osqp") -> dict[str, Any]:
    """Drive through a world; what the world was and what happened."""
    world, began = World(seed, moving), process_time()
    run = drive(world, along=along, solver=solver)
    seconds = process_time() - began
    return {
        "seed": seed,
        "robot": world.robot,
        "horizon": world.horizon,
        "dt": world.dt,
        "inflation": world.problem.inflation,
        "speed_max": world.speed_max,
        "obstacles": len(world.things),
        "reachable": is_reachable(world),
        "seconds": seconds,
        **judged(run),
    }


def judged(run: Drive) -> dict[str, Any]:
    """What happened, ready for JSON; not ok, contact and gap are from the first ok step on."""
    first, plans = run.first_ok(), run.plans
    begin = len(plans) if first is None else first
    gaps, speeds = run.gaps(), run.speeds()
    touching = np.argwhere((gaps[begin:] < TOUCHING).any(axis=-1))
    contact = None
    if len(touching):
        step, instant = touching[0] + [begin, 0]
        contact = {
            "step": int(step),
            "share": float(SHARES[instant]),
            "thing": int(gaps[step, instant].argmin()),
            "speed": float(speeds[step, instant]),
        }
    return {
        "steps": len(plans),
        "first_ok": first,
        "not_ok": [
            {
                "step": k,
                "status": plans[k].status.name,
                "before": plans[k - 1].status.name,
                "slack": float(plans[k].slack.max(initial=0.0)),
                "x_slack": float(plans[k].x_slack.max(initial=0.0)),
                "speed": float(speeds[k, 0]),
                "gap": float(gaps[k, 0].min()),
            }
            for k in range(begin, len(plans))
            if not plans[k].ok
        ],
        "contact": contact,
        "gap": float(gaps[begin:].min(initial=np.inf)) if first is not None else None,
        "arrived": run.arrived,
        "speed": float(speeds[-1, -1]),
        "statuses": dict(Counter(plan.status.name for plan in plans)),
        "away": float(np.linalg.norm(run.places()[-1] - run.world.goal)),
        "milliseconds": (1e3 * run.seconds).round(1).tolist(),
    }


def summarise(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Add episodes up."""
    contacts = [row["contact"] for row in rows if row["contact"]]
    reachable = [row for row in rows if row["reachable"]]
    times = np.concatenate([row["milliseconds"] for row in rows])
    return {
        "episodes": len(rows),
        "steps": len(times),
        "never_ok": sum(row["first_ok"] is None for row in rows),
        "not_ok_steps": sum(len(row["not_ok"]) for row in rows),
        "not_ok_episodes": sum(bool(row["not_ok"]) for row in rows),
        "contacts_moving": sum(contact["speed"] > AT_REST for contact in contacts),
        "contacts_at_rest": sum(contact["speed"] <= AT_REST for contact in contacts),
        "reachable": len(reachable),
        "arrived": sum(row["arrived"] for row in reachable),
        "median_ms": float(np.median(times)),
        "max_ms": float(times.max()),
        "seconds": sum(row["seconds"] for row in rows),
    }


def broken(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Episodes that break the promise, or do not arrive where they could."""
    kept = [{key: row[key] for key in row if key != "milliseconds"} for row in rows]
    return [
        row
        for row in kept
        if row["first_ok"] is None
        or row["not_ok"]
        or row["contact"]
        or (row["reachable"] and not row["arrived"])
    ]


def markdown(totals: dict[str, dict[str, Any]]) -> str:
    """The summaries in Markdown, a column for each reference."""
    columns = [_cells(total) for total in totals.values()]
    names = f"Reference: | {' | '.join(totals)}"
    return table(
        names,
        "l" + "r" * len(totals),
        [(name, *(cells[name] for cells in columns)) for name in columns[0]],
    )


def _cells(total: dict[str, Any]) -> dict[str, str]:
    share = 100 * total["arrived"] / max(total["reachable"], 1)
    return {
        "episodes, control steps": f"{total['episodes']:,}, {total['steps']:,}",
        "episodes without an ok step": f"{total['never_ok']:,}",
        "steps that are not ok after the first ok one (episodes)": (
            f"{total['not_ok_steps']:,} ({total['not_ok_episodes']:,})"
        ),
        "first contacts of a robot that moves, at rest": (
            f"{total['contacts_moving']:,}, {total['contacts_at_rest']:,}"
        ),
        "arrived, of those whose goal is reachable": (
            f"{total['arrived']:,} of {total['reachable']:,} ({share:.1f} %)"
        ),
        "median, slowest step [ms]": f"{total['median_ms']:.1f}, {total['max_ms']:.0f}",
        "processor time [min]": f"{total['seconds'] / 60:.1f}",
    }


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kind", choices=_KINDS, required=True, help="of the obstacles")
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="worlds")
    parser.add_argument("--alone", type=int, default=ALONE, help="of these without a path as well")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--solver", default="osqp", help="or native")
    main(**vars(parser.parse_args()), echo=print)
