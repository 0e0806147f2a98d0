"""Whether plans are near the best optimum that is known, and robots arrive.

    python benchmarks/optima.py --kind goals --episodes 500 --out out/optima

goals       closed loops of unicycle and bicycle from random poses to random goals, no obstacles
robots      first plans of all nonlinear robots, N = 20 and 30, with up to three obstacles and none,
            against the best of IPOPT's random starts
weights     first plans past one obstacle with weights up to six decades apart, likewise

Each episode is drawn from its seed. A rerun with the same folder does what is missing.
"""

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

from benchmarks.peers.referee import ModelReferee
from benchmarks.processes import in_one_thread
from benchmarks.progress import progress
from benchmarks.tables import table, write
from scp_mpc import MPC, SCP, Containment, DoubleIntegrator, ObstaclePrediction, Problem, Settings
from scp_mpc.arrays import FloatArray
from scp_mpc.models import KinematicBicycle, Model, PlanarQuadrotor, Quadrotor, Unicycle
from scp_mpc.simulation.episodes import run_episodes
from scp_mpc.trajectory import rollout

STARTS = 24
KINDS = {"goals": 500, "robots": 640, "weights": 60}  # and how many episodes
ROBOTS = ("unicycle", "bicycle", "planar quadrotor", "quadrotor")
_DT, _INF = 0.1, np.inf
_NEAR, _SECONDS = 0.15, 15.0  # of a goal [m], after so long
_WITHIN, _FAR = 0.01, 0.25  # of the best cost
_STEERING = 0.6  # [rad]


def main(
    kind: str,
    out: Path,
    episodes: int | None = None,
    starts: int = STARTS,
    jobs: int = 1,
    echo: Callable[[str], object] = lambda _: None,
) -> None:
    """Run what is missing and write table and numbers.

    Args:
        kind: One of `KINDS`.
        out: Folder for optima_kind.jsonl, .md and .json.
        episodes: How many; their seeds are 0, 1, ...
        starts: IPOPT's, of each instance.
        jobs: Processes.
        echo: Takes the Markdown table.
    """
    name = f"optima_{kind}"
    count = KINDS[kind] if episodes is None else episodes
    rows = in_one_thread(_rows, kind, count, starts, out / f"{name}.jsonl", jobs)
    total = summarise_goals(rows) if kind == "goals" else summarise_plans(rows)
    missed = [row for row in rows if not row["good"]]
    write(out, name, markdown(total), {"rows": total, "missed": missed}, echo=echo)


def _rows(kind: str, count: int, starts: int, file: Path, jobs: int) -> list[dict[str, Any]]:
    one = (
        goal if kind == "goals" else partial(robot if kind == "robots" else weights, starts=starts)
    )
    with progress(count, "episode") as advance:
        return run_episodes(one, range(count), file=file, jobs=jobs, advance=advance)


def goal(seed: int) -> dict[str, Any]:
    """Drive to a goal. Who may not reverse needs room ahead: a horizon in which it can turn."""
    rng = np.random.default_rng([7, seed])
    name, reverse = ROBOTS[seed % 2], bool(seed // 2 % 2)
    steered = name == "bicycle"
    horizon = int(rng.choice([20, 30])) if reverse or not steered else 40
    course, heading = rng.uniform(-np.pi, np.pi, 2)
    reach = rng.uniform(0.3, 5.0) if reverse or not steered else rng.uniform(3.0, 5.0)
    target = reach * np.array([np.cos(course), np.sin(course)])
    model = _model(name)
    x, x_ref = np.zeros((2, model.nx))
    x[2], x_ref[:2] = heading, target
    lowest, highest = np.full((2, model.nx), _INF)
    lowest[2 + 1], highest[2 + 1] = float(reverse), 1.5
    lowest[4:] = highest[4:] = _STEERING
    problem = Problem(
        model,
        horizon=horizon,
        Q=[1.0, 1.0, 0.0, 0.05, 0.01][: model.nx],
        R=[0.02, 0.02],
        u_min=-2.0,
        u_max=2.0,
        x_min=-lowest,
        x_max=highest,
    )
    mpc, plans = MPC(problem, Settings(deadline=None), timer=process_time), []
    for _ in range(round(_SECONDS / _DT)):
        plans.append(mpc.step(x, x_ref))
        x = model.step(x, plans[-1].u0)
    away = float(np.linalg.norm(x[model.position] - target))
    saddles = sum(plan.status.name == "CONVERGED" and plan.kkt.curvature < -1e-6 for plan in plans)
    times = [1e3 * plan.timing.total for plan in plans]
    return {
        "seed": seed,
        "robot": name,
        "reverse": reverse,
        "horizon": horizon,
        "reach": float(reach),
        "away": away,
        "saddles": saddles,
        "statuses": dict(Counter(plan.status.name for plan in plans)),
        "first_ms": times[0],
        "median_ms": float(np.median(times)),
        "good": away <= _NEAR and not saddles,
    }


def robot(seed: int, starts: int = STARTS) -> dict[str, Any]:
    """Plan for a nonlinear robot, with obstacles and without, and let IPOPT try."""
    name = ROBOTS[seed % 4]
    horizon, crowded = (20, 30)[seed // 4 % 2], bool(seed // 8 % 2)
    rng, model = np.random.default_rng([3, seed]), _model(name)
    Q, R, lower, upper = {
        "unicycle": ([1, 1, 0.01, 0.1], [0.02] * 2, [-2, -2], [2, 2]),
        "bicycle": ([1, 1, 0.01, 0.1, 0.01], [0.02] * 2, [-2, -2], [2, 2]),
        "planar quadrotor": ([1, 1, 0.05, 0.1, 0.1, 0.01], [0.02] * 2, [2, -6], [18, 6]),
        "quadrotor": ([1] * 3 + [0.1] * 3 + [0.05] * 3, [0.02] * 4, [2, -4, -4, -4], [18, 4, 4, 4]),
    }[name]
    bounds: dict[str, Any] = {}
    if name == "bicycle":
        highest = np.array([_INF, _INF, _INF, _INF, _STEERING])
        bounds = {"x_min": -highest, "x_max": highest}
    count, dim = int(rng.integers(1, 4)) * crowded, model.dim
    problem = _past(model, horizon, Q, R, lower, upper, max(count, 1), **bounds)
    way = rng.normal(size=dim)
    way /= np.linalg.norm(way)
    x0 = model.state(np.zeros(dim), np.zeros(dim))
    if model.heading is not None:
        x0[2:4] = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, 1.0)
    else:
        x0[dim + (dim == 2) :][:dim] = 0.5 * rng.normal(size=dim)
    t, speed, moves = (
        _DT * np.arange(horizon + 1)[:, None],
        rng.uniform(0.3, 1.5),
        rng.random() < 0.5,
    )
    target = rng.uniform(0.5, 4.0) * way
    at = rng.uniform(-0.3, 0.3, dim) + speed * t * way if moves else target + 0 * t
    x_ref = model.state(at, np.tile(speed * way * moves, (horizon + 1, 1)))
    if model.heading is not None:
        course = np.arctan2(way[1], way[0])
        x_ref[:, 2] = x0[2] + (course - x0[2] + np.pi) % (2 * np.pi) - np.pi
    obstacles: list[ObstaclePrediction] = []
    while len(obstacles) < count:
        mean, radius = (
            rng.uniform(0.3, 2.5) * way + 0.5 * rng.normal(size=dim),
            rng.uniform(0.1, 0.4),
        )
        if np.linalg.norm(mean) > radius + 0.8:
            velocity = 0.4 * rng.normal(size=dim) * (rng.random() < 0.5)
            Sigma = np.diag(rng.uniform(0.0, 0.15, dim) ** 2)
            obstacles.append(ObstaclePrediction(mean + t * velocity, Sigma, radius))
    case = f"{name}, {'obstacles' if crowded else 'none'}"
    found = judged(problem, x0, x_ref, obstacles, starts, rng, **bounds)
    return {"seed": seed, "case": case, "horizon": horizon} | found


def weights(seed: int, starts: int = STARTS) -> dict[str, Any]:
    """Plan past an obstacle with random weights, and let IPOPT try."""
    rng, model = np.random.default_rng([9, seed]), DoubleIntegrator(_DT)
    horizon = int(rng.choice([20, 30]))
    along, across, slower, faster = rng.uniform([-3, -3, -4, -4], [3, 3, 0, 0])
    Q = 10.0 ** np.array([along, along + slower, across, across + faster])
    R = 10.0 ** rng.uniform(-3, 1) * np.ones(2)
    problem = _past(model, horizon, Q, R, [-3, -3], [3, 3], 1)
    x0 = model.state(np.zeros(2), rng.uniform([0.0, -0.3], [1.5, 0.3]))
    t, speed, aside = _DT * np.arange(horizon + 1)[:, None], *rng.uniform([0.5, -0.2], [1.5, 0.2])
    way = np.tile([speed, 0.0], (horizon + 1, 1))
    x_ref = model.state(np.hstack([speed * t, 0 * t + aside]), way)
    velocity = 0.3 * rng.normal(size=2) * (rng.random() < 0.5)
    Sigma = np.diag(rng.uniform(0.0, 0.2, 2) ** 2)
    mean, radius = rng.uniform([1.0, -0.4], [3.0, 0.4]), rng.uniform(0.1, 0.4)
    obstacle = [ObstaclePrediction(mean + t * velocity, Sigma, radius)]
    found = judged(problem, x0, x_ref, obstacle, starts, rng)
    return {"seed": seed, "case": "weights", "decades": float(abs(along - across))} | found


def judged(
    problem: Problem,
    x0: FloatArray,
    x_ref: FloatArray,
    obstacles: Sequence[ObstaclePrediction],
    starts: int,
    rng: np.random.Generator,
    **bounds: Any,
) -> dict[str, Any]:
    """Our plan, and how far above the best that IPOPT finds: from rest, from it, and at random."""
    model, N = problem.model, problem.horizon
    solver, began = SCP(problem), process_time()
    plan = solver.solve(x0, x_ref, obstacles)
    seconds = process_time() - began
    referee = ModelReferee(problem, x0, x_ref, list(obstacles), **bounds)
    rest, best = model.equilibrium_input, np.inf
    for k in range(starts):
        pieces = int(rng.integers(1, 6))
        held = rest + rng.uniform() * (
            rng.uniform(problem.u_min, problem.u_max, (pieces, model.nu)) - rest
        )
        inputs = (np.tile(rest, (N, 1)), plan.U, held[np.arange(N) * pieces // N])[min(k, 2)]
        way = rollout(model.step, x0, inputs)
        found = referee.solve(way.states, way.inputs, near=k == 1)
        best = min(best, found.cost) if found.ok else best
    residuals = referee.kkt(plan) if plan.status.name == "CONVERGED" and not bounds else {}
    scale = max(1.0, plan.cost)
    solvable = best < np.inf
    gap = plan.cost / best - 1 if solvable else 0.0
    return {
        "status": plan.status.name,
        "cost": plan.cost,
        "best": best if solvable else None,  # nothing meets all constraints, as far as IPOPT knows
        "gap": gap,
        "residual": max(residuals.values(), default=0.0) / scale,
        "ms": 1e3 * seconds,
        "good": plan.ok and gap <= _WITHIN,
    }


def _model(name: str) -> Model:
    if name == "bicycle":
        return KinematicBicycle(_DT, 0.5, 0.25)
    kinds = {"unicycle": Unicycle, "planar quadrotor": PlanarQuadrotor, "quadrotor": Quadrotor}
    return kinds[name](_DT)


def _past(
    model: Model, horizon: int, Q: Any, R: Any, lower: Any, upper: Any, count: int, **bounds: Any
) -> Problem:
    """A problem that is constrained at the samples alone, as IPOPT's is."""
    return Problem(
        model,
        horizon=horizon,
        Q=Q,
        R=R,
        u_min=lower,
        u_max=upper,
        robot_radius=0.3,
        margin=Containment(0.95),
        max_obstacles=count,
        nodes_per_interval=1,
        **bounds,
    )


def summarise_goals(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Arrivals by robot, and whether it may reverse."""
    total = []
    for name, reverse in sorted({(row["robot"], row["reverse"]) for row in rows}):
        some = [row for row in rows if (row["robot"], row["reverse"]) == (name, reverse)]
        total.append(
            {
                "case": f"{name}, {'may' if reverse else 'may not'} reverse",
                "episodes": len(some),
                "good": sum(row["away"] <= _NEAR for row in some),
                "saddles": sum(row["saddles"] for row in some),
                "median_ms": float(np.median([row["median_ms"] for row in some])),
                "first_ms": float(np.median([row["first_ms"] for row in some])),
                "worst": max(row["away"] for row in some),
            }
        )
    return total


def summarise_plans(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Gaps by case."""
    total = []
    for case in sorted({row["case"] for row in rows}):
        every = [row for row in rows if row["case"] == case]
        some = [row for row in every if row["best"] is not None]
        total.append(
            {
                "case": case,
                "episodes": len(some),
                "unsolvable": len(every) - len(some),
                "good": sum(row["good"] for row in some),
                "far": sum(row["gap"] > _FAR for row in some),
                "converged": sum(row["status"] == "CONVERGED" for row in some),
                "residual": max(row["residual"] for row in some),
                "median_ms": float(np.median([row["ms"] for row in some])),
                "worst": max(row["gap"] for row in some),
            }
        )
    return total


def markdown(total: Sequence[dict[str, Any]]) -> str:
    """The table in Markdown."""
    if "saddles" in total[0]:
        names = "Robot | Episodes | Arrived | Saddles CONVERGED | Step, first [ms] | Farthest [m]"
        arrivals = [
            (
                row["case"],
                row["episodes"],
                f"{row['good']} ({100 * row['good'] / row['episodes']:.1f} %)",
                row["saddles"],
                f"{row['median_ms']:.1f}, {row['first_ms']:.0f}",
                f"{row['worst']:.2f}",
            )
            for row in total
        ]
        return table(names, "lrrrrr", arrivals)
    names = (
        "Case | Plans, none exists | CONVERGED | Within 1 % of IPOPT's best | More than 25 % above "
        "| Largest gap | Largest residual by CasADi | Median [ms]"
    )
    cells = [
        (
            row["case"],
            f"{row['episodes']}, {row['unsolvable']}",
            row["converged"],
            f"{row['good']} ({100 * row['good'] / row['episodes']:.1f} %)",
            row["far"],
            f"{row['worst']:.1%}",
            f"{row['residual']:.0e}" if row["residual"] else "-",
            f"{row['median_ms']:.0f}",
        )
        for row in total
    ]
    return table(names, "lrrrrrrr", cells)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kind", choices=KINDS, required=True)
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--episodes", type=int, help="how many; their seeds are 0, 1, ...")
    parser.add_argument("--starts", type=int, default=STARTS, help="of IPOPT")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    main(**vars(parser.parse_args()), echo=print)
