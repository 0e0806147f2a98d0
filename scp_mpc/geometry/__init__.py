"""Geometry: no-go sets, signed distances, half-spaces and risk; knows no optimisation."""

from scp_mpc.geometry.ellipsoid import signed_distance
from scp_mpc.geometry.inflation import AxesInflation, ExactInflation, Inflation
from scp_mpc.geometry.margin import Containment, JointRisk, Margin, MarginSpec, StageRisk
from scp_mpc.geometry.no_go import HalfSpaces, NoGoSets
from scp_mpc.geometry.risk import containment_size, risk_bound, size_at_risk

__all__ = [
    "AxesInflation",
    "Containment",
    "ExactInflation",
    "HalfSpaces",
    "Inflation",
    "JointRisk",
    "Margin",
    "MarginSpec",
    "NoGoSets",
    "StageRisk",
    "containment_size",
    "risk_bound",
    "signed_distance",
    "size_at_risk",
]
