"""Promised against measured risk, by Monte Carlo.

    python benchmarks/risk.py --out benchmarks/results
    python benchmarks/risk.py --out out/risk --samples 5000 --episodes 20

Writes risk.md, risk.json and risk.png, and risk.jsonl from which an interrupted run goes on.

Open loop: each scene is planned once per promise. Obstacles are then drawn from the very
predictions that the plan was made with, by every coupling of their stages that has these marginals
(`scp_mpc.simulation.realisations`), and contact is counted, swept between the samples
(`scp_mpc.simulation.contact`). What is measured is what was promised:

    sample                          the largest frequency over i and j of contact with j at t_i
    stage, containment, ...         the largest frequency over stages i and obstacles j of contact
                                    with j in (t_{i-1}, t_i]
    joint                           the frequency of any contact over horizon and obstacles

The worst scene and coupling count. Intervals are those of Clopper and Pearson (1934), 95 %: the
promise is kept if the upper end is at most delta, and broken if the lower end is above it. Being
the worst of many, the measured number errs on the high side.

Closed loop: see `risk_episodes.py`.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from benchmarks.processes import in_one_thread
from benchmarks.progress import progress
from benchmarks.risk_episodes import drive
from benchmarks.risk_report import markdown, risk_figure
from benchmarks.risk_scenes import Scene, all_scenes
from benchmarks.risk_settings import (
    RiskSetting,
    all_settings,
    driven_settings,
    problem_for,
)
from benchmarks.store import Store
from benchmarks.tables import write
from scp_mpc.arrays import FloatArray
from scp_mpc.scp.plan import Plan
from scp_mpc.scp.solver import SCP
from scp_mpc.simulation.contact import contacts, robot_path, sampled_contacts
from scp_mpc.simulation.realisations import (
    COUPLINGS,
    Coupling,
    applicable_couplings,
    sample_paths,
)

NAME = "risk"  # of the files
SAMPLES = 100_000
EPISODES = 200
_CONFIDENCE = 0.95

Row = dict[str, Any]


def main(
    out: Path,
    samples: int = SAMPLES,
    episodes: int = EPISODES,
    seed: int = 0,
    echo: Callable[[str], object] = lambda _: None,
) -> None:
    """Measure everything in a process of one thread and write table, numbers and figure.

    Measurements that an interrupted run left in `out` are kept.

    Args:
        out: Folder for risk.md, risk.json, risk.png and risk.jsonl.
        samples: Realisations per scene, coupling and promise.
        episodes: Closed-loop episodes per promise.
        seed: Of everything that is drawn.
        echo: Takes the Markdown table.
    """
    store = out / f"{NAME}.jsonl"
    opened = in_one_thread(open_loop, samples, seed, store=store)
    closed = in_one_thread(closed_loop, episodes, seed, store=store)
    numbers = {
        "samples": samples,
        "episodes": episodes,
        "seed": seed,
        "open_loop": opened,
        "closed_loop": closed,
    }
    write(out, NAME, markdown(opened, closed), numbers, risk_figure(opened, closed), echo)


def open_loop(
    samples: int,
    seed: int = 0,
    scenes: Sequence[Scene] | None = None,
    settings: Sequence[RiskSetting] | None = None,
    store: Path | None = None,
) -> list[Row]:
    """One row per promise, with the worst scene's frequency and every scene's in "scenes".

    Args:
        samples: Realisations per scene, coupling and promise.
        seed: Of starts and realisations.
        scenes: What to plan; all if None.
        settings: The promises; all if None.
        store: File of finished measurements.
    """
    scenes = all_scenes(seed) if scenes is None else scenes
    settings = all_settings() if settings is None else settings
    kept = Store(store, samples=samples, seed=seed)
    table: dict[str, list[Row]] = {setting.name: [] for setting in settings}
    with progress(len(scenes) * len(settings)) as advance:
        for scene in scenes:
            draws = _Draws(scene, samples, seed)
            for setting in settings:

                def measure(setting: RiskSetting = setting, draws: _Draws = draws) -> Row:
                    return _measured(setting, draws)

                row = kept.get(f"open loop, {setting.name}, {scene.name}", measure)
                table[setting.name].append(row)
                advance()
    return [_summary(setting, table[setting.name], samples) for setting in settings]


def closed_loop(
    episodes: int,
    seed: int = 0,
    settings: Sequence[RiskSetting] | None = None,
    store: Path | None = None,
) -> list[Row]:
    """One row per promise: how many episodes ended in contact.

    Args:
        episodes: How many per promise.
        seed: Of the encounters.
        settings: The promises; `driven_settings` if None.
        store: File of finished measurements.
    """
    settings = driven_settings() if settings is None else settings
    kept = Store(store, episodes=episodes, seed=seed)
    rows = []
    with progress(len(settings)) as advance:
        for setting in settings:

            def measure(setting: RiskSetting = setting) -> Row:
                return asdict(drive(setting, episodes, seed))

            row = kept.get(f"closed loop, {setting.name}", measure)
            rows.append(asdict(setting) | row | interval(row["contacts"], row["episodes"]))
            advance()
    return rows


def interval(count: int, samples: int) -> Row:
    """Frequency with the ends of its 95 % interval by Clopper and Pearson."""
    ends = binomtest(count, samples).proportion_ci(_CONFIDENCE, method="exact")
    return {"measured": count / samples, "low": float(ends.low), "high": float(ends.high)}


class _Draws:
    """Obstacle paths of a scene, the same for every promise; drawn when first asked for."""

    def __init__(self, scene: Scene, samples: int, seed: int) -> None:
        self.scene = scene
        every = (set(applicable_couplings(o)) for o in scene.obstacles)
        shared = reduce(set.intersection, every)
        self.couplings: list[Coupling] = [c for c in COUPLINGS if c in shared]
        self._samples, self._seed = samples, seed
        self._paths: dict[Coupling, list[FloatArray]] = {}

    def paths(self, coupling: Coupling) -> list[FloatArray]:
        """(n, N+1, d) for each obstacle; they err independently of each other."""
        if coupling not in self._paths:
            source = [self._seed, COUPLINGS.index(coupling), *self.scene.name.encode()]
            rng = np.random.default_rng(source)
            self._paths[coupling] = [
                sample_paths(o, self._samples, rng, coupling) for o in self.scene.obstacles
            ]
        return self._paths[coupling]


def _measured(setting: RiskSetting, draws: _Draws) -> Row:
    """Plan one scene and count contacts by every coupling; the worst one's counts."""
    scene = draws.scene
    problem = problem_for(
        setting,
        scene.model,
        len(scene.x_ref) - 1,
        len(scene.obstacles),
        robot_radius=scene.robot_radius,
    )
    plan = SCP(problem).solve(scene.x0, scene.x_ref, scene.obstacles)
    row: Row = {
        "scene": scene.name,
        "ok": plan.ok,
        "status": plan.status.name,
        "cost": plan.cost,
        "committed": plan.risk.joint if setting.joint else float(plan.risk.stages.max()),
    }
    if not plan.ok:
        return row
    counts = {c: _counts(setting, scene, plan, draws.paths(c)) for c in draws.couplings}
    worst = max(draws.couplings, key=lambda c: counts[c]["count"])
    return row | {"coupling": worst, **counts[worst], "couplings": counts}


def _counts(setting: RiskSetting, scene: Scene, plan: Plan, paths: list[FloatArray]) -> Row:
    """Realisations that touch, as promised, and what the samples alone would have shown."""
    path = robot_path(scene.model, plan.X, plan.U)
    found = {}
    swept = sampled_contacts if setting.kind == "sample" else contacts
    for name, touch in (("count", swept), ("at_samples", sampled_contacts)):
        touched = [
            touch(path, o, scene.robot_radius + told.radius)
            for o, told in zip(paths, scene.obstacles, strict=True)
        ]
        if setting.joint:
            found[name] = int(np.any([t.any(axis=1) for t in touched], axis=0).sum())
        else:
            found[name] = max(int(t.sum(axis=0).max()) for t in touched)
    return found


def _summary(setting: RiskSetting, scenes: list[Row], samples: int) -> Row:
    """The worst scene of one promise, and what safety costs."""
    row: Row = asdict(setting) | {
        "name": setting.name,
        "joint": setting.joint,
        "samples": samples,
        "planned": len(scenes),
        "skipped": [scene["scene"] for scene in scenes if not scene["ok"]],
        "scenes": [s | interval(s["count"], samples) if s["ok"] else s for s in scenes],
    }
    counted = [scene for scene in row["scenes"] if scene["ok"]]
    if not counted:
        return row | {"verdict": "no plan"}
    worst = max(counted, key=lambda scene: scene["count"])
    row |= {key: worst[key] for key in ("scene", "coupling", "measured", "low", "high")}
    row["at_samples"] = max(s["at_samples"] for s in counted) / samples
    row["pooled"] = sum(s["count"] for s in counted) / (samples * len(counted))
    row["broken_in"] = [s["scene"] for s in counted if s["low"] > setting.delta]
    row["verdict"] = (
        "kept"
        if worst["high"] <= setting.delta
        else "broken"
        if worst["low"] > setting.delta
        else "open"
    )
    return row


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--samples", type=int, default=SAMPLES, help="per scene and promise")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="per promise")
    parser.add_argument("--seed", type=int, default=0, help="of everything that is drawn")
    arguments = parser.parse_args()
    main(arguments.out, arguments.samples, arguments.episodes, arguments.seed, print)
