"""Real-time model predictive control among moving, Gaussian-predicted obstacles."""

from importlib.metadata import version

from scp_mpc.control import MPC, CircularReference
from scp_mpc.errors import (
    BoundsError,
    ConcurrentUseError,
    CovarianceError,
    InvalidArgumentError,
    NotFiniteError,
    ScpMpcError,
    ShapeError,
    StaleDataError,
    TooManyObstaclesError,
)
from scp_mpc.obstacles import (
    CircularObstacle,
    ConstantVelocityPredictor,
    ObstaclePrediction,
    ReportPredictor,
)
from scp_mpc.problem import Problem
from scp_mpc.robots import DoubleIntegrator, LinearModel
from scp_mpc.safety import Containment, JointRisk, Margin, StageRisk
from scp_mpc.settings import Freshness, QPSettings, Settings
from scp_mpc.solver import SCP, Iterate, Plan, Status
from scp_mpc.trajectory import Trajectory

__version__ = version("scp-mpc")

__all__ = [
    "MPC",
    "SCP",
    "BoundsError",
    "CircularObstacle",
    "CircularReference",
    "ConcurrentUseError",
    "ConstantVelocityPredictor",
    "Containment",
    "CovarianceError",
    "DoubleIntegrator",
    "Freshness",
    "InvalidArgumentError",
    "Iterate",
    "JointRisk",
    "LinearModel",
    "Margin",
    "NotFiniteError",
    "ObstaclePrediction",
    "Plan",
    "Problem",
    "QPSettings",
    "ReportPredictor",
    "ScpMpcError",
    "Settings",
    "ShapeError",
    "StageRisk",
    "StaleDataError",
    "Status",
    "TooManyObstaclesError",
    "Trajectory",
    "__version__",
]
