"""The risk that a plan commits to, for the predictions it was made with.

Notation:
    J, N, C     obstacles, stages, points: K in each stage
"""

from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.safety.no_go import NoGoSets
from scp_mpc.safety.risk import risk_bound
from scp_mpc.scp.iterate import Iterate
from scp_mpc.scp.step import Step


@dataclass(frozen=True, eq=False)
class PlanRisk:
    """Upper bounds of the probability that the robot touches an obstacle if it follows the plan.

    They hold for the Gaussians that were predicted, with Boole's inequality over points, stages
    and obstacles, whatever the correlation between them, and for a robot that is clear now. With
    `nodes_per_interval=1` they are about the samples only.

    Attributes:
        stages: (J, N) of touching obstacle j between samples i - 1 and i, which takes one of the
            points there, the one at i - 1 included, too near.
        obstacles: (J,) of touching obstacle j at all.
        joint: Of touching any.
    """

    stages: FloatArray
    obstacles: FloatArray
    joint: float


def point_risks(step: Step, path: FloatArray) -> FloatArray:
    """Half-space bounds (J, C) along a path (C, d), for the covariances as predicted."""
    if not step.count:
        return np.zeros((0, step.nodes.size))
    plain = step.unscaled()
    sets = NoGoSets.stacked(
        plain.means[:, 1:], plain.covariances[:, 1:], plain.radii, plain.count, plain.shapes
    )
    return risk_bound(sets, path)


def plan_risk(step: Step, iterate: Iterate) -> PlanRisk:
    """Add the bounds up along a plan."""
    path = step.nodes.positions(iterate.states, iterate.inputs)
    points = step.nodes.stages(point_risks(step, path))
    whole = points.sum(axis=(1, 2))
    stages = points.sum(axis=2)
    if step.problem.nodes_per_interval > 1:
        stages[:, 1:] += points[:, :-1, -step.nodes.discs :].sum(axis=2)
    return PlanRisk(np.minimum(stages, 1.0), np.minimum(whole, 1.0), min(1.0, float(whole.sum())))
