"""Control: the receding horizon, the references it tracks, and what disturbs it."""

from scp_mpc.control.estimator import (
    DisturbanceEstimator,
    Estimate,
)
from scp_mpc.control.mpc import MPC
from scp_mpc.control.path import Path
from scp_mpc.control.path_reference import PathReference
from scp_mpc.control.preview import Preview
from scp_mpc.control.reference import CircularReference
from scp_mpc.control.regulator import Regulator
from scp_mpc.control.shortest_path import shortest_path
from scp_mpc.control.speed import (
    Schedule,
    SpeedLimits,
)
from scp_mpc.control.wind_aware import (
    WindAwareMPC,
    disturbed,
)

__all__ = [
    "MPC",
    "CircularReference",
    "DisturbanceEstimator",
    "Estimate",
    "Path",
    "PathReference",
    "Preview",
    "Regulator",
    "Schedule",
    "SpeedLimits",
    "WindAwareMPC",
    "disturbed",
    "shortest_path",
]
