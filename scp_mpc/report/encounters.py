"""Encounters: when the obstacle comes near, and when it shapes the plan."""

from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import BoolArray, FloatArray
from scp_mpc.geometry.no_go import NoGoSets
from scp_mpc.simulation.closed_loop import ClosedLoop


@dataclass(frozen=True)
class Encounter:
    """A run of control steps with the robot near the obstacle.

    Attributes:
        first: First control step.
        closest: Control step with the smallest distance.
        last: Last control step.
    """

    first: int
    closest: int
    last: int


def find_encounters(run: ClosedLoop) -> list[Encounter]:
    """Return the encounters in order; never none, if need be the step of the smallest distance.

    Near is what is closer than the longest semi-axis of the no-go set at s = s_ref.
    """
    distances = run.distances[: run.steps]
    near = distances < _reaches(run)
    spans = spans_of(near)
    if not spans:
        closest = int(np.argmin(distances))
        return [Encounter(closest, closest, closest)]
    return [
        Encounter(first, first + int(np.argmin(distances[first : last + 1])), last)
        for first, last in spans
    ]


def active_steps(run: ClosedLoop) -> BoolArray:
    """Return at which steps (K,) an obstacle's constraint is active somewhere along the plan."""
    return np.array(
        [
            plan.multipliers is not None
            and bool((np.abs(plan.multipliers.obstacles) > run.settings.tolerance).any())
            for plan in run.plans
        ]
    )


def slack_steps(run: ClosedLoop) -> BoolArray:
    """Return at which steps (K,) the plan's largest slack exceeds the solver's tolerance."""
    return np.array(
        [plan.slack.max(initial=0.0) > run.settings.tolerance for plan in run.plans], dtype=np.bool_
    )


def spans_of(marked: BoolArray) -> list[tuple[int, int]]:
    """Return the first and last index of each run of consecutive True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]]).astype(np.int8)))
    return [(int(first), int(end) - 1) for first, end in zip(edges[::2], edges[1::2], strict=True)]


def _reaches(run: ClosedLoop) -> FloatArray:
    """Longest semi-axis (K,) of the no-go sets [m]."""
    s_ref, radius = run.problem.size.reference, run.problem.robot_radius
    sets = [NoGoSets.now([prediction], radius) for prediction in run.predictions]
    return np.array([s_ref * o.deviations.max() + o.radii[0, 0] for o in sets])
