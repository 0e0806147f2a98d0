"""A robot among people who avoid it and each other, by ORCA, and walk to and fro in a square.

The robot goes from corner to corner. People see it as it was when the interval began, and take half
of the burden of avoiding it, as ORCA does; they turn and speed up no faster than people can. Once
it has arrived they are gone.

J. van den Berg, S. Guy, M. Lin, D. Manocha, Reciprocal n-body collision avoidance, ISRR 2009; here
in the RVO2 library's implementation, from the package pyrvo.

Notation:
    M   number of people
"""

from time import process_time
from typing import Any

import numpy as np

from benchmarks.crowds_judge import judged
from scp_mpc.arrays import FloatArray
from scp_mpc.control.mpc import MPC
from scp_mpc.control.path import Path
from scp_mpc.control.path_reference import PathReference
from scp_mpc.models.double_integrator import DoubleIntegrator
from scp_mpc.models.model import Model
from scp_mpc.models.unicycle import Unicycle
from scp_mpc.problem import Problem
from scp_mpc.settings import Settings, StalenessPolicy
from scp_mpc.simulation.run import Run
from scp_mpc.simulation.scene import Body, Scene
from scp_mpc.simulation.sensor import TrackedSensor
from scp_mpc.simulation.simulate import simulate

ROBOTS = ("unicycle", "omnidirectional")
SIDE, START, GOAL, NEAR = 12.0, np.array([1.5, 1.5]), np.array([10.5, 10.5]), 0.3  # [m]
DT, SECONDS, HORIZON = 0.1, 60.0, 25
RADIUS, SPEED = 0.3, 1.0  # of robot and people [m]; of the robot [m/s]
_ROOM = {"robot": 0.35, "people": 0.33}  # [m], radii that people keep
_AHEAD, _SIGHT, _COUNT = 2.5, 6.0, 10  # [s], [m], and people whom a person looks at
_PACES, _HURRY = (1.0, 1.3), 1.4  # [m/s], of people left alone and at most
_TURN, _PUSH = 1.5, 2.5  # [rad/s], [m/s^2]
_CLOSE, _BORED, _FAR = 0.6, 20.0, 3.0  # [m], [s], [m]: when there is a new goal, and how far away


class Square(Scene):
    """People in a square, and a robot that crosses it.

    Args:
        model: Of the robot.
        count: M.
    """

    def __init__(self, model: Model, count: int) -> None:
        """Put the robot in its corner, at rest, its nose towards the other one."""
        self._model, self._count = model, count
        way = (GOAL - START) / np.linalg.norm(GOAL - START)
        places, velocities = np.stack([START, START]), np.stack([np.zeros(2), way])
        self._follow = PathReference(
            Path.polyline([START, GOAL]), speed=SPEED, model=model, horizon=HORIZON
        )
        super().__init__(
            model.state(places, velocities)[0],
            lambda _, x: self._follow.states(x),
            [Body(np.zeros(2), RADIUS, name=who) for who in range(count)],
        )

    def reset(self, rng: np.random.Generator) -> FloatArray:
        """See `Scene`; draw people who walk somewhere."""
        from pyrvo import RVOSimulator

        self._follow.reset()
        self._rng = np.random.default_rng(rng.integers(2**32))  # whatever the sensor draws
        self._robot, self._arrived = START, False
        self._places = self._drawn()
        self._paces = self._rng.uniform(*_PACES, self._count)
        self._goals = self._rng.uniform(0, SIDE, (self._count, 2))
        self._since = np.zeros(self._count)
        self._courses = _angles(self._goals - self._places)
        self._velocities = self._paces[:, None] * _units(self._courses)
        self._orca = RVOSimulator(DT, _SIGHT, _COUNT, _AHEAD, _AHEAD, _ROOM["people"], _HURRY)
        for place in (START, *self._places):
            self._orca.add_agent(place.tolist())
        self._orca.set_agent_radius(0, _ROOM["robot"])
        return self._places

    def _drawn(self) -> FloatArray:
        """Places (M, 2) apart from each other and from the robot."""
        places: list[FloatArray] = []
        while len(places) < self._count:
            place = self._rng.uniform(0, SIDE, 2)
            apart = all(np.linalg.norm(place - other) > 3 * RADIUS for other in places)
            if apart and np.linalg.norm(place - START) > 5 * RADIUS:
                places.append(place)
        return np.array(places).reshape(-1, 2)

    def advance(self, time: float, x: FloatArray) -> FloatArray:  # noqa: ARG002
        """See `Scene`; people decide on what they saw when the interval began."""
        before, self._robot = self._robot, x[self._model.position]
        self._arrived |= bool(np.linalg.norm(self._robot - GOAL) < NEAR)
        if self._arrived:
            return np.full_like(self._places, np.nan)
        self._choose_goals()
        turn = _angles(self._goals - self._places) - self._courses
        turn = (turn + np.pi) % (2 * np.pi) - np.pi
        self._courses = self._courses + np.clip(turn, -_TURN * DT, _TURN * DT)
        wanted = self._avoiding(before, (self._robot - before) / DT)
        change = wanted - self._velocities
        size = np.linalg.norm(change, axis=1, keepdims=True)
        self._velocities = self._velocities + change * np.minimum(
            1, _PUSH * DT / np.maximum(size, 1e-9)
        )
        self._places = self._places + DT * self._velocities
        return self._places

    def _choose_goals(self) -> None:
        self._since += DT
        for who, place in enumerate(self._places):
            if np.linalg.norm(self._goals[who] - place) < _CLOSE or self._since[who] > _BORED:
                self._since[who] = 0.0
                while np.linalg.norm(self._goals[who] - place) < _FAR:
                    self._goals[who] = self._rng.uniform(0, SIDE, 2)

    def _avoiding(self, robot: FloatArray, velocity: FloatArray) -> FloatArray:
        """Velocities (M, 2) by ORCA, with the robot as one of the agents."""
        places = np.vstack([robot, self._places]).tolist()
        velocities = np.vstack([velocity, self._velocities]).tolist()
        wanted = np.vstack([velocity, self._paces[:, None] * _units(self._courses)]).tolist()
        for who in range(self._count + 1):
            self._orca.set_agent_position(who, places[who])
            self._orca.set_agent_velocity(who, velocities[who])
            self._orca.set_agent_pref_velocity(who, wanted[who])
        self._orca.do_step()
        new = (self._orca.get_agent_velocity(who + 1) for who in range(self._count))
        return np.array([(v.x, v.y) for v in new]).reshape(-1, 2)


def _angles(vectors: FloatArray) -> FloatArray:
    angles: FloatArray = np.arctan2(vectors[:, 1], vectors[:, 0])
    return angles


def _units(angles: FloatArray) -> FloatArray:
    return np.stack([np.cos(angles), np.sin(angles)], axis=1)


def problem(robot: str, count: int) -> Problem:
    """Of a robot among that many people."""
    common: dict[str, Any] = {
        "horizon": HORIZON,
        "R": [0.05, 0.05],
        "u_min": -1.5,
        "u_max": 1.5,
        "robot_radius": RADIUS,
        "max_obstacles": count,
        "speed_max": SPEED,
    }
    if robot == "omnidirectional":
        return Problem(DoubleIntegrator(DT), Q=[1.0, 0.1, 1.0, 0.1], **common)
    free = [-np.inf] * 3
    return Problem(Unicycle(DT), Q=[1.0, 1.0, 0.01, 0.1], x_min=[*free, -0.3], **common)


def reacting(
    seed: int, robot: str, count: int, seconds: float = SECONDS, solver: str = "osqp"
) -> dict[str, Any]:
    """Cross the square; what happened until the robot arrived, ready for JSON."""
    run = reacting_run(seed, robot, count, seconds, solver)
    there = np.linalg.norm(run.positions - GOAL, axis=1) < NEAR
    arrived = bool(there.any())
    end = int(there.argmax()) if arrived else run.steps
    row = judged(run, end)
    straight = float(np.linalg.norm(run.positions[end] - START))
    return {
        "seed": seed,
        "arrived": float(run.times[end]) if arrived else None,
        "ratio": row["way"] / straight if arrived else None,
        **row,
    }


def reacting_run(
    seed: int, robot: str, count: int, seconds: float = SECONDS, solver: str = "osqp"
) -> Run:
    """The same, as a run; the deadline counts processor time, whatever else the machine does."""
    task, forgetful = problem(robot, count), StalenessPolicy(keep=0)
    return simulate(
        MPC(task, Settings(solver=solver, staleness=forgetful), timer=process_time),
        Square(task.model, count),
        sensor=TrackedSensor(noise=0.05, outage_rate=0.1, outage_time=1.0),
        steps=round(seconds / DT),
        seed=seed,
    )
