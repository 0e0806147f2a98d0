"""Real-time model predictive control among moving, Gaussian-predicted obstacles."""

from importlib.metadata import version

from scp_mpc.control import (
    MPC,
    CircularReference,
    DisturbanceEstimator,
    Path,
    PathReference,
    Preview,
    SpeedLimits,
    WindAwareMPC,
    shortest_path,
)
from scp_mpc.errors import (
    BoundsError,
    ConcurrentUseError,
    CovarianceError,
    GeometryError,
    InvalidArgumentError,
    JacobianError,
    MissingCoreError,
    MissingExtraError,
    NotFiniteError,
    ScpMpcError,
    ShapeError,
    StaleDataError,
    TooManyObstaclesError,
)
from scp_mpc.geometry import Containment, JointRisk, Margin, StageRisk
from scp_mpc.models import (
    CasadiModel,
    ContinuousModel,
    Disturbed,
    DoubleIntegrator,
    FunctionModel,
    KinematicBicycle,
    LinearModel,
    Model,
    PlanarQuadrotor,
    Quadrotor,
    Unicycle,
    lqr_weight,
)
from scp_mpc.native.export import export
from scp_mpc.obstacles import (
    CircularObstacle,
    ConstantVelocityPredictor,
    ObstaclePrediction,
    ObstaclePredictions,
    Polytope,
    ReportPredictor,
)
from scp_mpc.problem import Problem
from scp_mpc.scp import SCP, Iterate, Plan, Status
from scp_mpc.settings import QPSettings, Settings, StalenessPolicy
from scp_mpc.tracking import Tracker, TrackerSettings
from scp_mpc.trajectory import Trajectory

__version__ = version("scp-mpc")

__all__ = [
    "MPC",
    "SCP",
    "BoundsError",
    "CasadiModel",
    "CircularObstacle",
    "CircularReference",
    "ConcurrentUseError",
    "ConstantVelocityPredictor",
    "Containment",
    "ContinuousModel",
    "CovarianceError",
    "DisturbanceEstimator",
    "Disturbed",
    "DoubleIntegrator",
    "FunctionModel",
    "GeometryError",
    "InvalidArgumentError",
    "Iterate",
    "JacobianError",
    "JointRisk",
    "KinematicBicycle",
    "LinearModel",
    "Margin",
    "MissingCoreError",
    "MissingExtraError",
    "Model",
    "NotFiniteError",
    "ObstaclePrediction",
    "ObstaclePredictions",
    "Path",
    "PathReference",
    "Plan",
    "PlanarQuadrotor",
    "Polytope",
    "Preview",
    "Problem",
    "QPSettings",
    "Quadrotor",
    "ReportPredictor",
    "ScpMpcError",
    "Settings",
    "ShapeError",
    "SpeedLimits",
    "StageRisk",
    "StaleDataError",
    "StalenessPolicy",
    "Status",
    "TooManyObstaclesError",
    "Tracker",
    "TrackerSettings",
    "Trajectory",
    "Unicycle",
    "WindAwareMPC",
    "__version__",
    "export",
    "lqr_weight",
    "shortest_path",
]
