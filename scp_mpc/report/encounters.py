"""Encounters of a scenario's run: how near the obstacle comes, and when."""

import numpy as np
from numpy.typing import NDArray

from scp_mpc.arrays import BoolArray, FloatArray
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.geometry.no_go import NoGoSets
from scp_mpc.simulation.run import Run
from scp_mpc.simulation.scenarios import Scenario


def scenario_of(run: Run) -> Scenario:
    """Return the scenario that was run.

    Raises:
        InvalidArgumentError: It was another scene.
    """
    if not isinstance(run.scene, Scenario):
        raise InvalidArgumentError("run", f"of a {type(run.scene).__name__}, not of a scenario")
    return run.scene


def centre_distances(run: Run) -> FloatArray:
    """Distances (K+1,) between the true centres of robot and obstacle [m]."""
    return np.linalg.norm(run.positions - run.bodies[:, 0], axis=1)


def no_go_clearances(run: Run) -> FloatArray:
    """Signed distances (K,) to each step's no-go set at s = s_ref [m], negative inside."""
    no_go, sets = run.problem.no_go, _sets(run)
    pairs = zip(sets, run.positions, strict=False)
    return np.array([no_go.clearance(around, p[None])[0, 0] for around, p in pairs])


def find_encounters(run: Run) -> list[int]:
    """Return the closest step of each encounter; never none, if need be the closest of all.

    In an encounter the robot is closer than the longest semi-axis of the no-go set at s = s_ref.
    """
    distances, s_ref = centre_distances(run)[:-1], run.problem.size.reference
    reaches = [s_ref * o.deviations.max() + o.radii[0, 0] for o in _sets(run)]
    near = spans_of(distances < reaches)
    return [int(k[distances[k].argmin()]) for k in near] or [int(distances.argmin())]


def spans_of(marked: BoolArray) -> list[NDArray[np.intp]]:
    """Return the indices of each run of consecutive True."""
    k = np.flatnonzero(marked)
    return [part for part in np.split(k, np.flatnonzero(np.diff(k) > 1) + 1) if len(part)]


def _sets(run: Run) -> list[NoGoSets]:
    return [NoGoSets.now(told, run.problem.robot_radius) for told in run.predictions]
