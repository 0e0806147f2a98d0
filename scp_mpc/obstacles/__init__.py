"""Obstacles: predicted Gaussians and shapes, predictors, the tracker, the report's obstacle."""

from scp_mpc.obstacles.ageing import aged
from scp_mpc.obstacles.circular import CircularObstacle
from scp_mpc.obstacles.motion import Motion
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.obstacles.predictors import ConstantVelocityPredictor, Predictor, ReportPredictor
from scp_mpc.obstacles.shape import Polytope
from scp_mpc.obstacles.tracker import Tracker
from scp_mpc.obstacles.tracker_settings import WALKING, WALKING_AND_TURNING, TrackerSettings

__all__ = [
    "WALKING",
    "WALKING_AND_TURNING",
    "CircularObstacle",
    "ConstantVelocityPredictor",
    "Motion",
    "ObstaclePrediction",
    "Polytope",
    "Predictor",
    "ReportPredictor",
    "Tracker",
    "TrackerSettings",
    "aged",
]
