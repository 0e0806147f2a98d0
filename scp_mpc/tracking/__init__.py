"""Tracking: from measured positions to Gaussian predictions of every obstacle."""

from scp_mpc.tracking.motion import Motion
from scp_mpc.tracking.tracker import WALKING, WALKING_AND_TURNING, Tracker, TrackerSettings

__all__ = [
    "WALKING",
    "WALKING_AND_TURNING",
    "Motion",
    "Tracker",
    "TrackerSettings",
]
