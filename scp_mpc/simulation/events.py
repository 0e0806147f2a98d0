"""Contacts and meetings of a run: events, one for each body and encounter, in continuous time.

A contact is

    at rest     if the robot's speed is at most 0.05 m/s where it begins,
    struck      if the robot moves, but closes at less than 0.3 m/s or slower than the body does,
    at fault    else: it closes at more than 0.3 m/s, and faster than the body.

Notation:
    n   (d,)    unit vector from the body to the robot where they touch first
    v, w        velocities of robot and body [m/s]; they close at -n'v and n'w
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.scp.braking import AT_REST
from scp_mpc.simulation.contact import FINE
from scp_mpc.simulation.run import Run, disc_centres, separation

_CLOSING = 0.3  # [m/s]
_APART = 1.0  # [s] without touching after which the next contact is another one


@dataclass(frozen=True)
class Contact:
    """The beginning of a contact.

    Attributes:
        body: Index of the body.
        time: When it begins [s].
        kind: Who ran into whom; see the module.
        speed: Of the robot then [m/s].
        closing: How fast the robot closes [m/s].
        body_closing: How fast the body does [m/s].
        depth: Deepest overlap until they part [m].
        seen: Seconds for which the body had been there.
    """

    body: int
    time: float
    kind: Literal["at rest", "struck", "at fault"]
    speed: float
    closing: float
    body_closing: float
    depth: float
    seen: float


@dataclass(frozen=True)
class Meeting:
    """The robot's closest approach to one body while that body is there.

    Attributes:
        body: Index of the body.
        step: Control step in which they are closest.
        time: Of that step [s].
        clearance: Smallest distance [m]; negative where they overlap.
        seen: Seconds for which the body had been there.
        speed: Of the robot then [m/s].
    """

    body: int
    step: int
    time: float
    clearance: float
    seen: float
    speed: float

    @property
    def touched(self) -> bool:
        """Whether they touch."""
        return self.clearance <= 0


def find_meetings(run: Run) -> list[Meeting]:
    """Return one meeting for each body that is there at two control steps, closest first."""
    found = []
    for body, clearances in enumerate(run.clearances.T):
        if not np.isfinite(clearances).any():
            continue
        step = int(clearances.argmin())
        piece = int(run.gaps(body)[:, step].argmin())
        found.append(
            Meeting(
                body=body,
                step=step,
                time=float(run.times[step]),
                clearance=float(clearances[step]),
                seen=_seen(run, body, step),
                speed=float(np.linalg.norm(_velocity(run.path[:, step], piece, run))),
            )
        )
    return sorted(found, key=lambda meeting: meeting.clearance)


def find_contacts(run: Run) -> list[Contact]:
    """Return all contacts in order of time."""
    found = []
    apart = int(np.ceil(_APART / run.problem.model.dt * FINE))
    for body in np.flatnonzero((run.clearances <= 0).any(axis=0)):
        within = run.gaps(int(body))
        # an interval's end begins the next one, unless the body is gone by then
        gaps = np.concatenate([within[:-1].T.ravel(), within[-1, -1:]])
        gaps[FINE::FINE] = np.minimum(gaps[FINE::FINE], within[-1])
        touching = np.flatnonzero(gaps <= 0)
        for event in np.split(touching, np.flatnonzero(np.diff(touching) > apart) + 1):
            depth = -float(gaps[event[0] : event[-1] + 1].min())
            step, piece = divmod(int(event[0]), FINE)
            if step == run.steps or within[piece, step] > 0:
                step, piece = step - 1, FINE
            found.append(_contact(run, int(body), step, piece, depth))
    return sorted(found, key=lambda contact: contact.time)


def _contact(run: Run, body: int, step: int, piece: int, depth: float) -> Contact:
    dt, model = run.problem.model.dt, run.problem.model
    share = piece / FINE
    begin, end = run.bodies[step : step + 2, body]
    state = model.advance(run.states[step], run.inputs[step], share)
    discs = disc_centres(model, state, run.problem.discs)
    distances, normals = separation(run.scene.bodies[body], discs - (begin + share * (end - begin)))
    n = normals[distances.argmin()]
    v, w = _velocity(run.path[:, step], piece, run), (end - begin) / dt
    speed, closing, other = float(np.linalg.norm(v)), float(-n @ v), float(n @ w)
    kind: Literal["at rest", "struck", "at fault"] = "struck"
    if speed <= AT_REST:
        kind = "at rest"
    elif closing > _CLOSING and closing > other:
        kind = "at fault"
    time = float((step + share) * dt)
    return Contact(body, time, kind, speed, closing, other, depth, _seen(run, body, step))


def _velocity(path: FloatArray, piece: int, run: Run) -> FloatArray:
    """Velocity (d,) of the robot at a piece of an interval's path (FINE+1, d) [m/s]."""
    at = min(piece, FINE - 1)
    return (path[at + 1] - path[at]) * FINE / run.problem.model.dt


def _seen(run: Run, body: int, step: int) -> float:
    """Seconds for which a body has been there, without a break, at a control step."""
    there = ~np.isnan(run.bodies[: step + 1, body, 0])
    absent = np.flatnonzero(~there)
    first = int(absent[-1]) + 1 if len(absent) else 0
    return float((step - first) * run.problem.model.dt)
