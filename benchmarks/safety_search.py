"""A grid search in space and time: whether a disc that goes where it likes can reach the goal.

Breadth first, over cells of 5 cm and steps of the 0.1 to 0.2 s in which the disc goes 20 cm at its
speed, or less, or waits. What happens between two steps is covered by larger radii: a chord of
length l whose ends are sqrt(r^2 + l^2 / 4) away from a point is r away from it. So what is found is
a proof; that nothing is found is none.
"""

import numpy as np
from scipy.ndimage import binary_dilation

from benchmarks.safety_drive import NEAR, SECONDS, STAY
from benchmarks.safety_worlds import World

CELL, MOST = 0.05, 4  # [m], and how many of them it goes in a step
SPARE, SHARE = 0.1, 0.6  # [m] of clearance, and of the time of a drive
_SPEED, _ROOM = 2.0, (2.0, 4.0)  # [m/s] without a limit, and [m] around start and goal


def is_reachable(world: World) -> bool:
    """Whether the goal can be reached and stayed at within a share of the time of a drive."""
    step = CELL * MOST / min(world.speed_max or _SPEED, _SPEED)
    axes = [
        np.arange(min(0.0, goal) - room, max(0.0, goal) + room, CELL)
        for goal, room in zip(world.goal, _ROOM, strict=True)
    ]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    reached = np.linalg.norm(cells, axis=-1) < CELL / 2
    goal = np.linalg.norm(cells - world.goal, axis=-1) < NEAR
    side = np.arange(-MOST, MOST + 1)
    moves = np.hypot(side[:, None], side) <= MOST
    stayed, fixed = np.zeros(goal.shape), np.ones_like(goal)
    things = sorted(world.things, key=lambda thing: bool(thing.velocity.any()))  # standing first
    for k in range(round(SHARE * SECONDS / step)):
        free = fixed.copy()
        for thing in things:
            drift = float(np.linalg.norm(thing.velocity))
            if k and not drift:
                continue
            apart = np.hypot(thing.radius + world.radius + SPARE, (CELL * MOST + drift * step) / 2)
            reach = apart + np.linalg.norm(thing.corners, axis=1).max()
            now = thing.at + k * step * thing.velocity
            part = tuple(
                slice(*np.searchsorted(axis, [at - reach, at + reach]))
                for axis, at in zip(axes, now, strict=True)
            )
            free[part] &= thing.gaps(cells[part], k * step) + thing.radius > apart
            if not drift:
                fixed = free.copy()
        reached = (binary_dilation(reached, moves) if k else reached) & free
        stayed = (stayed + 1) * (reached & goal)
        if stayed.max() > STAY / step:
            return True
    return False
