"""Safety: no-go sets, signed distances and half-spaces; knows no optimisation."""

from scp_mpc.safety.ellipsoid import signed_distance
from scp_mpc.safety.halfspaces import HalfSpaces
from scp_mpc.safety.inflation import AxesInflation, ExactInflation, Inflation
from scp_mpc.safety.no_go import NoGoSets

__all__ = [
    "AxesInflation",
    "ExactInflation",
    "HalfSpaces",
    "Inflation",
    "NoGoSets",
    "signed_distance",
]
