"""Obstacles: predicted Gaussians and shapes, predictors, the report's obstacle."""

from scp_mpc.obstacles.circular import CircularObstacle
from scp_mpc.obstacles.polytope import Polytope
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.obstacles.predictions import ObstaclePredictions
from scp_mpc.obstacles.predictors import ConstantVelocityPredictor, Predictor, ReportPredictor
from scp_mpc.obstacles.propagation import propagated

__all__ = [
    "CircularObstacle",
    "ConstantVelocityPredictor",
    "ObstaclePrediction",
    "ObstaclePredictions",
    "Polytope",
    "Predictor",
    "ReportPredictor",
    "propagated",
]
