"""Robots: the discrete-time dynamics f, one family per file."""

from scp_mpc.robots.double_integrator import DoubleIntegrator
from scp_mpc.robots.linear import LinearModel
from scp_mpc.robots.model import Linearisation, Model, NonlinearModel
from scp_mpc.robots.riccati import lqr_gain, lqr_preview, lqr_weight
from scp_mpc.robots.unicycle import Unicycle

__all__ = [
    "DoubleIntegrator",
    "LinearModel",
    "Linearisation",
    "Model",
    "NonlinearModel",
    "Unicycle",
    "lqr_gain",
    "lqr_preview",
    "lqr_weight",
]
