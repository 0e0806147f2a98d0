"""The closed loop: sense, plan, apply, and the world moves on.

    x_{k+1} = plant(x_k, u_k),   u_k = plan(sensor(x_k, all bodies))

The same seed gives the same run, bit for bit, of a controller without a deadline: one that looks at
the clock depends on the machine.
"""

from collections.abc import Callable, Sequence
from time import perf_counter
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import as_count
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.provenance import library_version
from scp_mpc.scp.plan import Plan
from scp_mpc.settings import Settings
from scp_mpc.simulation.plant import ModelPlant, Plant
from scp_mpc.simulation.run import Run
from scp_mpc.simulation.scene import Scene
from scp_mpc.simulation.sensor import PerfectSensor, Sensor


class Controller(Protocol):
    """What plans at each step: `MPC`, or something around it."""

    @property
    def problem(self) -> Problem:
        """What it solves."""
        ...

    @property
    def settings(self) -> Settings:
        """How it plans."""
        ...

    def step(
        self, x0: ArrayLike, x_ref: ArrayLike, obstacles: Sequence[ObstaclePrediction], /
    ) -> Plan:
        """Return the plan for this control step."""
        ...


def simulate(
    controller: Controller,
    scene: Scene,
    *,
    plant: Plant | None = None,
    sensor: Sensor | None = None,
    steps: int = 100,
    seed: int | np.random.Generator = 0,
    advance: Callable[[], object] = lambda: None,
) -> Run:
    """Drive a robot through a scene.

    Args:
        controller: What plans; new, or as it is.
        scene: Where the robot starts, what it is to track and what is in its way.
        plant: What the robot truly does; the controller's own model if None.
        sensor: What the controller is told; the truth, as the scene predicts it, if None.
        steps: Number of control steps K.
        seed: Of all noise, in plant, sensor and scene.
        advance: Called after each step, for a progress bar.
    """
    problem, count = controller.problem, as_count("steps", steps)
    plant = ModelPlant(problem.model) if plant is None else plant
    sensor = PerfectSensor() if sensor is None else sensor
    rng, dt = np.random.default_rng(seed), problem.model.dt
    bodies = [scene.reset(rng)]
    plant.reset(rng)
    sensor.reset(scene, problem, rng)
    states, measured, references, predictions, plans = [scene.start()], [], [], [], []
    sensing, seconds = [], []
    for k in range(count):
        began = perf_counter()
        y, told = sensor.observe(k * dt, states[-1], bodies[-1])
        x_ref = scene.x_ref(k * dt, y)
        ready = perf_counter()
        plan = controller.step(y, x_ref, told)
        done = perf_counter()
        states.append(plant.step(states[-1], plan.u0))
        bodies.append(scene.advance((k + 1) * dt, states[-1]))
        measured.append(y)
        references.append(x_ref)
        predictions.append(told)
        plans.append(plan)
        sensing.append(ready - began)
        seconds.append(done - ready)
        advance()
    return Run(
        scene=scene,
        problem=problem,
        settings=controller.settings,
        seed=seed if isinstance(seed, int) else None,
        version=library_version(),
        states=np.array(states),
        measured=np.array(measured),
        inputs=np.array([plan.u0 for plan in plans]),
        references=references,
        bodies=np.array(bodies).reshape(count + 1, -1, problem.model.dim),
        predictions=predictions,
        plans=plans,
        sensing=np.array(sensing),
        seconds=np.array(seconds),
    )
