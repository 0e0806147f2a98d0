"""Obstacles: their predicted Gaussians, the predictors, and the report's obstacle."""

from scp_mpc.obstacles.ageing import aged
from scp_mpc.obstacles.circular import CircularObstacle
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.obstacles.predictors import ConstantVelocityPredictor, Predictor, ReportPredictor

__all__ = [
    "CircularObstacle",
    "ConstantVelocityPredictor",
    "ObstaclePrediction",
    "Predictor",
    "ReportPredictor",
    "aged",
]
