"""A robot among recorded people, who do not react to it: as they were, or many times as many.

A recorded crowd is made dense by laying copies of it, each shifted in time, over one another. The
copies do not know of each other, so people turn up in front of the robot, and walk through others.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.crowds_judge import judged
from scp_mpc.arrays import FloatArray
from scp_mpc.control.mpc import MPC
from scp_mpc.settings import Settings, StalenessPolicy
from scp_mpc.simulation.crossing import Crossing
from scp_mpc.simulation.recording import Recording, along
from scp_mpc.simulation.recordings import read_recording
from scp_mpc.simulation.replay import DT, replay, replay_problem
from scp_mpc.simulation.run import Run
from scp_mpc.simulation.scene import Body
from scp_mpc.simulation.sensor import TrackedSensor
from scp_mpc.simulation.simulate import simulate
from scp_mpc.simulation.there_and_back import ThereAndBack, arrivals

PEOPLE = 40  # per frame
SECONDS = 200.0
RADIUS = 0.3  # [m]
_FORGETFUL = StalenessPolicy(keep=0)  # the tracker remembers


def dense(
    seed: int,
    file: Path,
    options: dict[str, Any],
    seconds: float = SECONDS,
    solver: str = "osqp",
) -> dict[str, Any]:
    """Cross a dense crowd, there and back again; options are of the problem."""
    run = dense_run(seed, read_recording(file), options, seconds, solver)
    return {"seed": seed, **judged(run), **_progress(run)}


def dense_run(
    seed: int,
    recording: Recording,
    options: dict[str, Any],
    seconds: float = SECONDS,
    solver: str = "osqp",
) -> Run:
    """The same, as a run."""
    problem, steps = replace(replay_problem(), **options), round(seconds / DT)
    people = thickened(recording, steps, np.random.default_rng(seed))
    crossing = Crossing.through(recording, "along")
    return simulate(
        MPC(problem, Settings(deadline=None, solver=solver, staleness=_FORGETFUL)),
        ThereAndBack(crossing, problem.model, problem.horizon, people),
        sensor=TrackedSensor(),
        steps=steps,
        seed=seed,
    )


def thickened(recording: Recording, steps: int, rng: np.random.Generator) -> list[Body]:
    """Copies of a crowd, shifted in time, until `PEOPLE` are there on average."""
    times = DT * np.arange(steps + 1, dtype=np.float64)
    begin, last = recording.times[0], recording.times[-1] - recording.times[0]
    paths: list[FloatArray] = []
    count = 0.0
    while count < PEOPLE:
        shift = rng.uniform(0, last)
        for t, positions in recording.paths.values():
            for lap in range(int(times[-1] // last) + 2):
                path = along(t - begin - shift + lap * last, positions, times)
                here = ~np.isnan(path[:, 0])
                if here.any():
                    paths.append(path)
                    count += here.mean()
    return [Body(partial(_at, path), RADIUS) for path in paths]


def _at(path: FloatArray, time: float) -> FloatArray:
    place: FloatArray = path[round(time / DT)]
    return place


def as_they_were(
    seed: int,
    file: Path,
    options: dict[str, Any],
    steps: int | None = None,
    solver: str = "osqp",
) -> dict[str, Any]:
    """Cross a recorded crowd for as long as it lasts; options are of the settings."""
    settings = Settings(staleness=_FORGETFUL, solver=solver, **options)
    run = replay(read_recording(file), seed=seed, steps=steps, settings=settings)
    return {"seed": seed, **judged(run), **_progress(run)}


def _progress(run: Run) -> dict[str, Any]:
    """How many people there were on average, and durations of finished passes [s]."""
    there = ~np.isnan(run.bodies[:, :, 0])
    return {
        "people": float(there.sum(axis=1).mean()),
        "passes": np.diff(run.times[[0, *arrivals(run)]]).round(3).tolist(),
    }
