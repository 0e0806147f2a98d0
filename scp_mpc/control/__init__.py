"""Control: the receding horizon and the references it tracks."""

from scp_mpc.control.mpc import MPC
from scp_mpc.control.preview import Preview
from scp_mpc.control.reference import CircularReference

__all__ = ["MPC", "CircularReference", "Preview"]
