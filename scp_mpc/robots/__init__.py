"""Robots: the discrete-time dynamics f, one family per file."""

from scp_mpc.robots.double_integrator import DoubleIntegrator
from scp_mpc.robots.linear import LinearModel

__all__ = ["DoubleIntegrator", "LinearModel"]
