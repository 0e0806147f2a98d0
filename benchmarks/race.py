"""All engines drive the same scenes, in turns, on one core: what a step takes, and what it plans.

    python -m benchmarks.peers.acados               once, if acados is to take part
    python benchmarks/race.py --out out/race        or: benchmarks/run.py --only race
    python benchmarks/race.py --out out/race --scenes "N = 8" --steps 40

Time is taken from Python around everything that a user does for one step: from the state, the
reference and arrays of means and covariances to an input. Each engine drives a closed loop of its
own, without disturbance, from the same start. The same loop is driven several times, engines taking
turns of twenty steps in shuffled order; the least time of each step says what the code costs, and
stands beside what the clock said in all of them. On a machine that is shared even that is not what
a long step costs: its processor time is. An interrupted race goes on where it stopped.

    scp_mpc, native    the core in C, all ways past the obstacles
    scp_mpc, osqp      the loop in Python with OSQP, likewise
    acados             SQP to 1e-6, and its real-time iteration; keeps its side (`peers/acados.py`)
    ipopt, fatrop      keep their side; linear robots only; predictions are checked before the clock

A plan that an engine disowns is not applied: the last one is, shifted. In the plane obstacles of
crowds and circuits have round covariances, where both inflations are the same: all take "axes".
"""

import argparse
import gc
import logging
import os
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter, thread_time
from typing import Any, Protocol
from zlib import crc32

import numpy as np
from matplotlib.figure import Figure

from benchmarks.circuits import Circuit
from benchmarks.figures import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    SKY,
    VERMILION,
    canvas,
    legend_below,
    plain,
)
from benchmarks.peers.acados import Acados, Installation, Method
from benchmarks.peers.ipopt import Ipopt
from benchmarks.peers.plan import Peer, PeerMissingError
from benchmarks.peers.staged import Staged
from benchmarks.peers.violation import clearances, largest_violation
from benchmarks.processes import in_one_thread
from benchmarks.progress import progress
from benchmarks.store import Store
from benchmarks.tables import table, write
from scp_mpc import MPC, ObstaclePredictions, Problem, Settings
from scp_mpc.arrays import FloatArray, as_count
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.simulation import SCENARIOS, Crowd, Scenario
from scp_mpc.trajectory import Trajectory

NAME = "race"  # of the files
REPEATS = 3
_BLOCK = 20  # steps that an engine drives in a row
_CONTACT = 1e-3  # [m] a plan closer than this to a no-go set is shaped by it
_ROOT = Path(__file__).resolve().parent.parent

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Course:
    """A scene of the race.

    Attributes:
        name: What tables call it.
        world: Who moves how.
        nodes: Nodes per interval. With more than one only scp_mpc takes part.
    """

    name: str
    world: Scenario | Crowd | Circuit
    nodes: int = 1

    @property
    def problem(self) -> Problem:
        """What all engines solve."""
        if not isinstance(self.world, Circuit):
            return self.world.problem("axes", nodes_per_interval=self.nodes)
        problem = replace(self.world.problem, nodes_per_interval=self.nodes)
        return replace(problem, inflation="axes") if problem.model.dim == 2 else problem


COURSES = (
    Course("N = 8, 1 obstacle", SCENARIOS["scenario-2"]),
    Course("N = 30, 1 obstacle", SCENARIOS["scenario-1"]),
    Course("N = 30, 5 obstacles", Crowd(30, 5)),
    Course("N = 30, 12 obstacles", Crowd(30, 12)),
    Course("N = 200, 1 obstacle", Crowd(200, 1)),
    Course("unicycle, N = 30, 5 obstacles", Circuit("unicycle", 30, 5)),
    Course("bicycle, N = 30, 5 obstacles", Circuit("bicycle", 30, 5)),
    Course("3-D, N = 30, 12 balls, 4 nodes", Circuit("double integrator 3-D", 30, 12), 4),
)


@dataclass(frozen=True, eq=False)
class Given:
    """What an engine is given at one step.

    Attributes:
        x0: (nx,) state.
        x_ref: (N+1, nx) reference.
        means: (J, N+1, d) of the obstacles [m].
        covariances: (J, N+1, d, d) [m^2].
        radii: (J,) [m].
        checked: The same predictions as an object, for peers that take it and are not to pay.
    """

    x0: FloatArray
    x_ref: FloatArray
    means: FloatArray
    covariances: FloatArray
    radii: FloatArray
    checked: ObstaclePredictions

    @classmethod
    def at(cls, course: Course, problem: Problem, time: float, x: FloatArray) -> "Given":
        """What there is to know at a time [s] in state x (nx,)."""
        told = course.world.predictions(time, problem.model.dt, problem.horizon)
        arrays = (
            np.array([one.means for one in told]),
            np.array([one.covariances for one in told]),
            np.array([one.radius for one in told]),
        )
        return cls(x, course.world.x_ref(time, x), *arrays, ObstaclePredictions(*arrays))


@dataclass(frozen=True, eq=False)
class Planned:
    """What an engine made of it.

    Attributes:
        seconds: How long it took.
        processor: Seconds of processor time, likewise.
        X: (N+1, nx) states.
        U: (N, nu) inputs.
        s: (J,) sizes of the ellipsoids.
        ok: Whether the engine stands by it.
        shaped: Whether an obstacle shapes it; None where the engine does not tell.
    """

    seconds: float
    processor: float
    X: FloatArray
    U: FloatArray
    s: FloatArray
    ok: bool
    shaped: bool | None = None


class Engine(Protocol):
    """Plans step by step, each time from its last plan."""

    label: str

    def plan(self, given: Given) -> Planned:
        """Plan, and say how long it took."""
        ...

    def reset(self) -> None:
        """Forget the last plan."""
        ...


class _Ours:
    def __init__(self, problem: Problem, solver: str) -> None:
        self.label = f"scp_mpc, {solver}"
        self._mpc = MPC(problem, Settings(solver=solver, deadline=None))

    def plan(self, given: Given) -> Planned:
        began, worked = perf_counter(), thread_time()
        obstacles = ObstaclePredictions(given.means, given.covariances, given.radii)
        plan = self._mpc.step(given.x0, given.x_ref, obstacles)
        u0 = plan.u0
        processor, seconds = thread_time() - worked, perf_counter() - began
        assert np.array_equal(u0, plan.U[0])
        return Planned(seconds, processor, plan.X, plan.U, plan.s, plan.ok, plan.iterate.touches)

    def reset(self) -> None:
        self._mpc.reset()


class _Acados:
    def __init__(self, problem: Problem, method: Method) -> None:
        self._solver = Acados(problem, method)
        self.label = f"{self._solver.version}, {method.replace('SQP_', '')}"

    def plan(self, given: Given) -> Planned:
        solver = self._solver
        began, worked = perf_counter(), thread_time()
        status = solver.step(given.x0, given.x_ref, given.means, given.covariances, given.radii)
        u0 = solver.U[0].copy()
        processor, seconds = thread_time() - worked, perf_counter() - began
        U = solver.U.copy()
        assert np.array_equal(u0, U[0])
        sizes = solver.s[: len(given.radii)].copy()
        return Planned(seconds, processor, solver.X.copy(), U, sizes, status == 0)

    def reset(self) -> None:
        self._solver.reset()


class _Peer:
    def __init__(self, label: str, peer: Peer, problem: Problem) -> None:
        self.label, self._peer, self._model = label, peer, problem.model
        self._last: Trajectory | None = None

    def plan(self, given: Given) -> Planned:
        guess = self._last
        if guess is None:
            guess = Trajectory(given.x_ref, np.zeros((len(given.x_ref) - 1, self._model.nu)))
        plan = self._peer.solve(given.x0, given.x_ref, given.checked, guess)
        X, U = (plan.X, plan.U) if plan.ok else (guess.states, guess.inputs)
        end = self._model.step(X[-1], U[-1])
        self._last = Trajectory(np.vstack([X[1:], end]), np.vstack([U[1:], U[-1:]]))
        return Planned(plan.seconds, plan.processor, X, U, plan.s, plan.ok)

    def reset(self) -> None:
        self._last = None


# Who takes part, and how it is drawn. No engine but ours is told of nodes between the samples.
ENGINES: dict[str, tuple[Callable[[Problem], Engine], str]] = {
    "native": (partial(_Ours, solver="native"), BLUE),
    "osqp": (partial(_Ours, solver="osqp"), SKY),
    "acados SQP": (partial(_Acados, method="SQP"), VERMILION),
    "acados RTI": (partial(_Acados, method="SQP_RTI"), ORANGE),
    "fatrop": (lambda problem: _Peer("fatrop", Staged(problem, "fatrop"), problem), GREEN),
    "ipopt": (lambda problem: _Peer("ipopt", Ipopt(problem), problem), BLACK),
}


def rows(
    steps: int,
    repeats: int = REPEATS,
    seed: int = 0,
    courses: Sequence[Course] = COURSES,
    store: Path | None = None,
) -> list[dict[str, Any]]:
    """Race in this process; one row per course and engine, also for those that cannot take part.

    Args:
        steps: Control steps of each closed loop.
        repeats: How often each is driven.
        seed: Of the turns.
        courses: The scenes.
        store: Keeps what is finished: one repeat of one scene at a time.
    """
    as_count("steps", steps)
    as_count("repeats", repeats)
    kept = Store(store, steps=steps, seed=seed, compiled=_compiled())
    found = []
    with progress(len(courses) * repeats, "loop") as advance:
        for course in courses:
            driven = []
            engines: dict[str, Engine | str] = {}
            for repeat in range(repeats):
                key = f"{course.name}/{repeat}"
                if key not in kept and not engines:
                    engines = _engines(course.problem)
                turns = np.random.default_rng([seed, repeat])
                driven.append(kept.get(key, partial(_race, course, engines, steps, turns)))
                advance()
            found += [_row(course, name, [one[name] for one in driven]) for name in ENGINES]
    return found


def main(
    out: Path,
    steps: int,
    seed: int,
    echo: Callable[[str], object] = _log.info,
    repeats: int = REPEATS,
    scenes: Sequence[str] = (),
) -> None:
    """Race in a process of one thread on one core, echo the table and write the files.

    Args:
        out: Folder for the table, the numbers, the figure, and what is finished.
        steps: Control steps of each closed loop.
        seed: Of the turns.
        echo: Takes the Markdown table.
        repeats: How often each loop is driven.
        scenes: Beginnings of the names of the scenes; none for all.
    """
    courses = [one for one in COURSES if one.name.startswith(tuple(scenes) or "")]
    if not courses:
        raise InvalidArgumentError("scenes", f"{list(scenes)} begin no name of a scene")
    store = out / f"{NAME}.jsonl"
    found = in_one_thread(_alone, steps, repeats, seed, courses, store)
    write(out, NAME, markdown(found), {"rows": found}, figure(found), echo)


def markdown(found: Sequence[dict[str, Any]]) -> str:
    """The table in Markdown, and who did not take part."""
    names = (
        "Scene | Engine | Least [us] | Least processor time [us] | Shaped by an obstacle [us] "
        "| First step [us] | All [us] | Sum of plan costs | Driven cost | Violation [m] | Failures"
    )
    raced = [row for row in found if row["missing"] is None]
    text = table(names, "llrrrrrrrrr", map(_cells, raced))
    notes = [
        "Times: median / p99 / max; least: of each step, in all repeats of a loop. Shaped: median "
        "of the least times of such steps. First step: its processor time, which counts among the "
        "others, too. Sum of plan costs: over all steps, without slack. Driven: the stage costs of "
        "what was driven. Violation: the largest of a plan that its engine stands by. Failures: "
        "steps whose plan it disowns."
    ]
    reasons = defaultdict(list)
    for row in found:
        if row["missing"] is not None:
            reasons[row["engine"], row["missing"]].append(row["scene"])
    for (engine, reason), scenes in reasons.items():
        notes.append(f"Without {engine} ({'; '.join(scenes)}): {reason}.")
    notes += [
        f"{row['scene']}, {row['label']}: repeats differ by {row['deviation']:.0e} in the state."
        for row in raced
        if row["deviation"] > 0
    ]
    return "\n\n".join([text, *notes])


def figure(found: Sequence[dict[str, Any]]) -> Figure:
    """Draw per scene and engine the least processor times: median, p99 and maximum."""
    raced = [row for row in found if row["missing"] is None]
    scenes = list(dict.fromkeys(row["scene"] for row in raced))
    drawing, (axes,) = canvas(11.5, 2.0 + 1.1 * len(scenes))
    gap = 0.8 / len(ENGINES)
    for place, (name, (_, colour)) in enumerate(ENGINES.items()):
        part = [row for row in raced if row["engine"] == name]
        if not part:
            continue
        shift = (place - (len(ENGINES) - 1) / 2) * gap
        y = np.array([scenes.index(row["scene"]) for row in part]) + shift
        median, p99, most = (
            [row["processor_us"][key] / 1e3 for row in part] for key in _STATISTICS
        )
        axes.hlines(y, median, most, color=colour, linewidth=1.2)
        axes.hlines(y, median, p99, color=colour, linewidth=4.0)
        axes.plot(median, y, "o", color=colour, markersize=7, label=part[0]["label"])
        axes.plot(most, y, "|", color=colour, markersize=9)
    for place in range(1, len(scenes)):
        axes.axhline(place - 0.5, color="0.8", linewidth=0.8)
    plain(axes, "x")
    axes.set_yticks(range(len(scenes)), [_wrapped(scene) for scene in scenes], fontsize=12)
    axes.set_ylim(len(scenes) - 0.5, -0.5)
    axes.grid(axis="y", visible=False)
    axes.set_xlabel(
        "least processor time of each control step [ms]: median (dot), p99 (bar), maximum",
        fontsize=13,
    )
    legend_below(drawing, axes, 3)
    return drawing


_STATISTICS = ("median", "p99", "max")


def _alone(
    steps: int, repeats: int, seed: int, courses: Sequence[Course], store: Path
) -> list[dict[str, Any]]:
    """`rows` on one core; what acados's library prints goes nowhere."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)
    return rows(steps, repeats, seed, courses, store)


def _engines(problem: Problem) -> dict[str, Engine | str]:
    """All engines by name; for one that cannot take part the reason."""
    engines: dict[str, Engine | str] = {}
    for name, (build, _) in ENGINES.items():
        try:
            engines[name] = build(problem)
        except (PeerMissingError, InvalidArgumentError) as error:
            engines[name] = str(error)
            _log.warning("%s does not take part: %s", name, error)
    return engines


def _race(
    course: Course, engines: dict[str, Engine | str], steps: int, turns: np.random.Generator
) -> dict[str, Any]:
    """All engines once along a course."""
    problem = course.problem
    present = {name: one for name, one in engines.items() if not isinstance(one, str)}
    first = Given.at(course, problem, 0.0, course.world.start())
    for engine in present.values():
        engine.plan(first)
        engine.reset()
    loops = {name: _loop(course, problem, one) for name, one in present.items()}
    driven: dict[str, list[dict[str, Any]]] = {name: [] for name in present}
    gc.collect()
    gc.freeze()
    try:
        for begin in range(0, steps, _BLOCK):
            for name in turns.permutation(list(present)):
                for _ in range(min(_BLOCK, steps - begin)):
                    driven[name].append(next(loops[name]))
    finally:
        gc.unfreeze()
    record: dict[str, Any] = {
        name: {"label": present[name].label, **{key: [s[key] for s in all_] for key in all_[0]}}
        for name, all_ in driven.items()
    }
    return record | {name: {"missing": why} for name, why in engines.items() if name not in present}


def _loop(course: Course, problem: Problem, engine: Engine) -> Iterator[dict[str, Any]]:
    """One engine's closed loop, step by step, in numbers."""
    model, x, k = problem.model, course.world.start(), 0
    while True:
        given = Given.at(course, problem, k * model.dt, x)
        plan = engine.plan(given)
        shaped = plan.shaped
        if shaped is None:
            g = clearances(problem, given.checked, plan.X[:, model.position], plan.s)
            shaped = bool(g.min() < _CONTACT)
        told = given.x0, given.checked, plan.X, plan.U, plan.s
        u = np.clip(plan.U[0], problem.u_min, problem.u_max)
        x, k = model.step(x, u), k + 1
        error = x - given.x_ref[1]
        yield {
            "us": 1e6 * plan.seconds,
            "processor_us": 1e6 * plan.processor,
            "cost": problem.cost(plan.X, plan.U, plan.s, given.x_ref),
            "driven": float(error @ problem.Q @ error + u @ problem.R @ u),
            "violation": largest_violation(problem, *told) if plan.ok else 0.0,
            "failed": not plan.ok,
            "shaped": shaped,
            "x": x.tolist(),
        }


def _row(course: Course, name: str, driven: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The repeats of one engine's loop in one row."""
    problem, one = course.problem, driven[0]
    row = {
        "scene": course.name,
        "engine": name,
        "horizon": problem.horizon,
        "obstacles": problem.max_obstacles,
        "missing": one.get("missing"),
    }
    if row["missing"] is not None:
        return row
    times, processor, states = (
        np.array([repeat[key] for repeat in driven]) for key in ("us", "processor_us", "x")
    )
    least, shaped = times.min(axis=0), np.array(one["shaped"])
    return row | {
        "label": one["label"],
        "steps": times.shape[1],
        "repeats": times.shape[0],
        "least_us": _statistics(least),
        "processor_us": _statistics(processor.min(axis=0)),
        "first_us": float(processor[:, 0].min()),
        "plain_us": _statistics(times),
        "shaped": int(shaped.sum()),
        "shaped_us": float(np.median(least[shaped])) if shaped.any() else None,
        "cost": float(sum(one["cost"])),
        "driven": float(sum(one["driven"])),
        "violation": float(max(one["violation"])),
        "failures": int(sum(one["failed"])),
        "deviation": float(np.abs(states - states[0]).max()),
    }


def _statistics(times: FloatArray) -> dict[str, float]:
    values = np.median(times), np.percentile(times, 99), times.max()
    return dict(zip(_STATISTICS, map(float, values), strict=True))


def _cells(row: dict[str, Any]) -> tuple[object, ...]:
    shaped = row["shaped_us"]
    return (
        *(row["scene"], row["label"]),
        *(_times(row[key]) for key in ("least_us", "processor_us")),
        "n/a" if shaped is None else f"{shaped:,.0f} in {row['shaped']} steps",
        f"{row['first_us']:,.0f}",
        _times(row["plain_us"]),
        *(f"{row[key]:,.2f}" for key in ("cost", "driven")),
        f"{row['violation']:.0e}",
        f"{row['failures']} of {row['steps']}",
    )


def _times(statistics: dict[str, float]) -> str:
    return " / ".join(f"{statistics[key]:,.0f}" for key in _STATISTICS)


def _wrapped(scene: str) -> str:
    """The name of a scene on two lines."""
    return ",\n".join(scene.rsplit(", ", 1))


def _compiled() -> int:
    """A number for what `Store` does not look at: our core as it was compiled, and acados."""
    files = [*(_ROOT / "scp_mpc").rglob("*.so"), *(_ROOT / "benchmarks").rglob("*.c")]
    try:
        acados = Installation.find().version
    except PeerMissingError:
        acados = ""
    return crc32(b"".join(path.read_bytes() for path in sorted(files)) + acados.encode())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    results = Path(__file__).parent / "results"
    parser.add_argument("--out", type=Path, default=results, help="folder for the results")
    parser.add_argument("--steps", type=int, default=200, help="control steps of each loop")
    parser.add_argument("--seed", type=int, default=0, help="of the turns")
    parser.add_argument("--repeats", type=int, default=REPEATS, help="how often to drive each loop")
    parser.add_argument("--scenes", nargs="+", default=(), help="beginnings of their names")
    logging.basicConfig(format="%(message)s")
    main(**vars(parser.parse_args()), echo=print)
