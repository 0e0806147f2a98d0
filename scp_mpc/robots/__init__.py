"""Robots: the discrete-time dynamics f, one family per file."""

from scp_mpc.robots.bicycle import KinematicBicycle
from scp_mpc.robots.disturbed import Disturbed
from scp_mpc.robots.double_integrator import DoubleIntegrator
from scp_mpc.robots.function import FunctionModel
from scp_mpc.robots.linear import LinearModel
from scp_mpc.robots.model import (
    Linearisation,
    Model,
    NonlinearModel,
)
from scp_mpc.robots.planar_quadrotor import PlanarQuadrotor
from scp_mpc.robots.quadrotor import Quadrotor
from scp_mpc.robots.riccati import (
    lqr_gain,
    lqr_preview,
    lqr_weight,
)
from scp_mpc.robots.runge_kutta import ContinuousModel
from scp_mpc.robots.unicycle import Unicycle

__all__ = [
    "ContinuousModel",
    "Disturbed",
    "DoubleIntegrator",
    "FunctionModel",
    "KinematicBicycle",
    "LinearModel",
    "Linearisation",
    "Model",
    "NonlinearModel",
    "PlanarQuadrotor",
    "Quadrotor",
    "Unicycle",
    "lqr_gain",
    "lqr_preview",
    "lqr_weight",
]
