"""A drive through a random world, along the shortest path around what stands or to the goal alone.

Notation:
    K   control steps       T   instants in an interval
"""

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.safety_worlds import SHARES, World
from scp_mpc.arrays import FloatArray
from scp_mpc.control.mpc import MPC
from scp_mpc.control.path_reference import PathReference
from scp_mpc.control.shortest_path import shortest_path
from scp_mpc.control.speed import SpeedLimits
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.scp.plan import Plan
from scp_mpc.settings import Settings

SECONDS, NEAR, STAY = 20.0, 0.3, 1.0  # a drive ends after so long, or so near the goal so long
_SEEK = 1.0  # [s] after which the path is sought again
_STANDING = 0.3, 0.0  # [m/s] up to which a thing is in the way; the last where there is no way else
_SPEED = 2.0  # [m/s] along a path of who knows no limit
_ACROSS, _ALONG = (1.0, None), 1.0  # [m/s^2] at a path's corners, and along it
_HELD_UP, _PATIENCE = 0.1, 2.5  # [m] or less in a second, [s] before it takes them otherwise


class Controller(Protocol):
    """What drives: `MPC`, or something worse."""

    def step(
        self, x0: ArrayLike, x_ref: ArrayLike, obstacles: Sequence[ObstaclePrediction], /
    ) -> Plan:
        """Return the plan for this control step."""
        ...


@dataclass(frozen=True, eq=False)
class Drive:
    """What happened.

    Attributes:
        world: Where.
        states: (K+1, nx) of the robot.
        plans: K of them.
        seconds: (K,) for each plan.
        arrived: Whether it stayed near the goal.
    """

    world: World
    states: FloatArray
    plans: list[Plan]
    seconds: FloatArray
    arrived: bool

    def places(self) -> FloatArray:
        """(K+1, 2) positions of the robot [m]."""
        return self.states[:, self.world.problem.model.position]

    def first_ok(self) -> int | None:
        """Index of the first ok step, from which on the promise holds; None for never."""
        return next((k for k, plan in enumerate(self.plans) if plan.ok), None)

    def gaps(self) -> FloatArray:
        """(K, T, M) between the robot and each obstacle within each interval [m]."""
        world, K = self.world, len(self.plans)
        path = world.path(self.states[:-1], np.array([plan.u0 for plan in self.plans]))
        times = world.dt * (np.arange(K)[:, None] + SHARES)
        return np.stack([thing.gaps(path, times) for thing in world.things], -1) - world.radius

    def speeds(self) -> FloatArray:
        """(K, T) of the robot [m/s]."""
        path = self.world.path(self.states[:-1], np.array([plan.u0 for plan in self.plans]))
        step = np.diff(path, axis=1) / (SHARES[1] * self.world.dt)
        speed = np.linalg.norm(step, axis=-1)
        return np.concatenate([speed, speed[:, -1:]], axis=1)


class Way:
    """What to track: the shortest path around what stands, or the goal itself where there is none.

    It is sought again every second. The reference takes its corners slowly, so that the robot goes
    round them, too; where that holds it up, quickly, then slowly again, and so on.

    Args:
        world: Where.
    """

    def __init__(self, world: World) -> None:
        """Nothing is known yet."""
        self._world, self._turn, self._since, self._last = world, 0, 0.0, np.full(2, np.inf)
        self._follow: PathReference | None = None

    def states(self, x: FloatArray, k: int) -> FloatArray:
        """References (N+1, nx), or (nx,) of the goal, in state x (nx,) at control step k."""
        if k % round(_SEEK / self._world.dt) == 0:
            self._seek(x[self._world.problem.model.position], k * self._world.dt)
        return self._world.x_ref if self._follow is None else self._follow.states(x)

    def _seek(self, start: FloatArray, time: float) -> None:
        world, problem, told = self._world, self._world.problem, self._world.predictions(time)
        if time >= self._since + _PATIENCE and np.linalg.norm(start - self._last) < _HELD_UP:
            self._turn, self._since = self._turn + 1, time
        self._last, self._follow = start, None
        for speed in _STANDING:
            path = shortest_path(
                problem, start, world.goal, told, tolerance=0.9 * NEAR, standing=speed
            )
            if path is not None:
                across = _ACROSS[self._turn % len(_ACROSS)]
                limits = SpeedLimits(world.speed_max or _SPEED, across, _ALONG)
                self._follow = PathReference(
                    path, speed=limits, model=problem.model, horizon=problem.horizon
                )
                break


def drive(
    world: World,
    controller: Controller | None = None,
    along: bool = True,
    solver: str = "osqp",
) -> Drive:
    """Drive through a world until the robot stays near its goal or the time is over.

    Args:
        world: Where.
        controller: Who; `MPC` without a deadline if None.
        along: Whether to follow the shortest path around what stands, or to track the goal alone.
        solver: Of that `MPC`.
    """
    problem = world.problem
    if controller is None:
        controller = MPC(problem, Settings(deadline=None, solver=solver))
    way = Way(world) if along else None
    states, plans, seconds, near = [world.start], list[Plan](), list[float](), 0
    for k in range(round(SECONDS / world.dt)):
        x_ref = world.x_ref if way is None else way.states(states[-1], k)
        told = world.predictions(k * world.dt)
        began = perf_counter()
        plans.append(controller.step(states[-1], x_ref, told))
        seconds.append(perf_counter() - began)
        states.append(problem.model.step(states[-1], plans[-1].u0))
        away = np.linalg.norm(states[-1][problem.model.position] - world.goal)
        near = near + 1 if away < NEAR else 0
        if near * world.dt > STAY:
            break
    return Drive(world, np.array(states), plans, np.array(seconds), near * world.dt > STAY)
