"""Meetings of robot and people in a replay: how close they came, and whether they touched.

Between control steps the robot follows its curve and people walk straight; see `contact`.
"""

from dataclasses import dataclass

import numpy as np

from scp_mpc.simulation.contact import FINE, contacts, robot_path
from scp_mpc.simulation.replay import Replay


@dataclass(frozen=True)
class Meeting:
    """The robot's closest approach to one person while that person is present.

    Attributes:
        name: Of the person.
        step: Control step in which they are closest.
        time: Of that step [s].
        clearance: Smallest distance between both discs [m]; negative where they overlap.
        touched: Whether they touch at any time.
        seen: Seconds from the person's first annotation to the closest approach.
        speed: Of the robot at that step [m/s].
    """

    name: int
    step: int
    time: float
    clearance: float
    touched: bool
    seen: float
    speed: float


def find_meetings(run: Replay) -> list[Meeting]:
    """Return one meeting for each person who is present at two control steps, closest first."""
    model, radii = run.problem.model, run.problem.robot_radius + run.radius
    path = robot_path(model, run.states, run.inputs)
    fractions = np.linspace(0.0, 1.0, FINE + 1)[:, None]
    found = []
    for name, places in run.people().items():
        present = np.flatnonzero(~np.isnan(places[:, 0]))
        if len(present) < 2:
            continue
        first, last = present[0], present[-1]
        robot, person = path[first:last], places[first : last + 1]
        walk = person[:-1, None] + fractions * (person[1:] - person[:-1])[:, None]
        distance = np.linalg.norm(robot - walk, axis=-1).min(axis=1)
        touched = bool(contacts(robot, person[None], radii).any())
        step = int(first + distance.argmin())
        found.append(
            Meeting(
                name=name,
                step=step,
                time=float(run.times[step]),
                clearance=float(distance.min() - radii),
                touched=touched,
                seen=float(run.times[step] - run.recording.paths[name][0][0]),
                speed=float(run.speeds[step]),
            )
        )
    return sorted(found, key=lambda meeting: meeting.clearance)
