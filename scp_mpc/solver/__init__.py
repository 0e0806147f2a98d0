"""The solver: sequential convex programming on warm-started quadratic programs."""

from scp_mpc.solver.iterate import Iterate, Multipliers
from scp_mpc.solver.plan import Plan, Status, Timing
from scp_mpc.solver.program import KKTResiduals
from scp_mpc.solver.scp import SCP

__all__ = ["SCP", "Iterate", "KKTResiduals", "Multipliers", "Plan", "Status", "Timing"]
