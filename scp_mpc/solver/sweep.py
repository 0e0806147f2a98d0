"""What the robot and the obstacles do between two points of a plan, and the room it takes.

If the robot's and the obstacle's centres are r' apart at two points, and in between move l relative
to each other along a straight line, then they never come closer than sqrt(r'^2 - (l/2)^2). A held
input bends the robot's way by a sag b off its chord. So the radii r are kept everywhere if the
points keep

    r' = sqrt((r + b)^2 + (l/2)^2)

Notation:
    C       points of the plan, K in each interval
    l       relative way between two points: the robot's longest chord, and the obstacle's mean way
            with three standard deviations of what its covariance grows by
"""

from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.solver.step_data import StepData

_RESERVE = 1.2  # of what is assumed about a plan over what is known of the one before


@dataclass(frozen=True)
class Sweep:
    """Bounds of a robot's motion between two neighbouring points.

    Attributes:
        chord: Longest straight way [m].
        sag: Largest distance of the path from it [m].
    """

    chord: float
    sag: float

    @classmethod
    def of(cls, path: FloatArray) -> "Sweep":
        """Measure a path (C+1, d), or those of several discs (C+1, n, d)."""
        way = path[1:] - path[:-1]
        turn = way[1:] - way[:-1]
        chord = np.sqrt(np.add.reduce(way * way, axis=-1).max(initial=0.0))
        sag = np.sqrt(np.add.reduce(turn * turn, axis=-1).max(initial=0.0)) / 8
        return cls(float(chord), float(sag))

    def and_more(self, *others: "Sweep") -> "Sweep":
        """What covers this and others, with a reserve."""
        return Sweep(
            _RESERVE * max(self.chord, *(o.chord for o in others)),
            _RESERVE * max(self.sag, *(o.sag for o in others)),
        )

    def covers(self, other: "Sweep") -> bool:
        """Whether another motion stays within these bounds."""
        return other.chord <= self.chord and other.sag <= self.sag


def too_fast(step: StepData, sweep: Sweep) -> bool:
    """Whether the relative way from sample to sample exceeds the radii."""
    return bool((sweep.chord + step.drift > step.radii).any())


def swept(step: StepData, sweep: Sweep) -> StepData:
    """The step with radii that leave room for what happens between its points."""
    way = (sweep.chord + step.drift) / 2
    return step.widened(np.hypot(step.radii + sweep.sag, way))
