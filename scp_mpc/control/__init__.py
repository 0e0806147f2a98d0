"""Control: the receding horizon and the references it tracks."""

from scp_mpc.control.mpc import MPC
from scp_mpc.control.path import Path
from scp_mpc.control.path_reference import PathReference
from scp_mpc.control.preview import Preview
from scp_mpc.control.reference import CircularReference
from scp_mpc.control.speed import Schedule, SpeedLimits

__all__ = [
    "MPC",
    "CircularReference",
    "Path",
    "PathReference",
    "Preview",
    "Schedule",
    "SpeedLimits",
]
