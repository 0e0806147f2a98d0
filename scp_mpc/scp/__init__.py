"""Sequential convex programming on warm-started quadratic programs."""

from scp_mpc.qp.program import KKTResiduals
from scp_mpc.scp.iterate import Iterate, Multipliers
from scp_mpc.scp.plan import Plan, Status, Timing
from scp_mpc.scp.solver import SCP

__all__ = ["SCP", "Iterate", "KKTResiduals", "Multipliers", "Plan", "Status", "Timing"]
