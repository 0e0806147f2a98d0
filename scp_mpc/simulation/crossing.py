"""A straight line on which a robot is to cross a scene."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray, as_array, frozen
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.settings import require_positive
from scp_mpc.simulation.recording import Recording

Course = Literal["along", "across"]

_OUTERMOST = 0.1  # share of the positions that lies beyond either end: people come from there
_REACHED = 0.3  # [m] from the goal


@dataclass(frozen=True, eq=False)
class Crossing:
    """From `start` to `goal` in a straight line.

    Attributes:
        start: (2,) [m].
        goal: (2,) [m].
        speed: Of the reference [m/s].
    """

    start: FloatArray
    goal: FloatArray
    speed: float = 1.3

    def __init__(self, start: ArrayLike, goal: ArrayLike, speed: float = 1.3) -> None:
        """Copy, check and freeze."""
        a, b = as_array("start", start, (2,)), as_array("goal", goal, (2,))
        if np.linalg.norm(b - a) < 1e-3:
            raise InvalidArgumentError("goal", f"{b} is where the robot starts")
        require_positive("speed", speed)
        for name, value in (("start", frozen(a)), ("goal", frozen(b)), ("speed", float(speed))):
            object.__setattr__(self, name, value)

    @classmethod
    def through(cls, recording: Recording, course: Course, speed: float = 1.3) -> "Crossing":
        """Along the main flow, or across it, through the middle of where people walk.

        The main flow is the direction in which people move most, of either sign; the line spans
        the middle four fifths of all positions in its direction.

        Raises:
            InvalidArgumentError: The course is unknown, or nobody moves.
        """
        if course not in ("along", "across"):
            raise InvalidArgumentError("course", f"{course!r} is neither 'along' nor 'across'")
        moves = np.array([p[-1] - p[0] for _, p in recording.paths.values()])
        strength, directions = np.linalg.eigh(moves.T @ moves)
        if strength[1] <= 0:
            raise InvalidArgumentError("recording", "nobody moves: give start and goal")
        d = directions[:, 1 if course == "along" else 0]
        positions = np.concatenate(recording.positions)
        middle = np.median(positions, axis=0)
        ends = np.quantile((positions - middle) @ d, [_OUTERMOST, 1 - _OUTERMOST])
        return cls(middle + ends[0] * d, middle + ends[1] * d, speed)

    @property
    def length(self) -> float:
        """Distance from start to goal [m]."""
        return float(np.linalg.norm(self.goal - self.start))

    @property
    def direction(self) -> FloatArray:
        """Unit vector (2,) from start to goal."""
        return (self.goal - self.start) / self.length

    def reversed(self) -> "Crossing":
        """The way back."""
        return replace(self, start=self.goal, goal=self.start)

    def reached(self, position: FloatArray) -> bool:
        """Whether the goal is near enough to a position (2,)."""
        return bool(np.linalg.norm(position - self.goal) <= _REACHED)
