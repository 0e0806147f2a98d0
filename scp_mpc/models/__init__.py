"""Models: the discrete-time dynamics f, one family per file."""

from scp_mpc.models.bicycle import KinematicBicycle
from scp_mpc.models.casadi import CasadiModel
from scp_mpc.models.disturbed import Disturbed
from scp_mpc.models.double_integrator import DoubleIntegrator
from scp_mpc.models.function import FunctionModel
from scp_mpc.models.linear import LinearModel
from scp_mpc.models.model import (
    Linearisation,
    Model,
)
from scp_mpc.models.planar_quadrotor import PlanarQuadrotor
from scp_mpc.models.quadrotor import Quadrotor
from scp_mpc.models.riccati import (
    lqr_gain,
    lqr_preview,
    lqr_weight,
)
from scp_mpc.models.runge_kutta import ContinuousModel
from scp_mpc.models.unicycle import Unicycle

__all__ = [
    "CasadiModel",
    "ContinuousModel",
    "Disturbed",
    "DoubleIntegrator",
    "FunctionModel",
    "KinematicBicycle",
    "LinearModel",
    "Linearisation",
    "Model",
    "PlanarQuadrotor",
    "Quadrotor",
    "Unicycle",
    "lqr_gain",
    "lqr_preview",
    "lqr_weight",
]
