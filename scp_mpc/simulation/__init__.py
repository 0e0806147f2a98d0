"""Simulation: named scenarios and the closed loop."""

from scp_mpc.simulation.closed_loop import ClosedLoop, simulate
from scp_mpc.simulation.crowds import Crowd
from scp_mpc.simulation.disturbance import CorrelatedDisturbance
from scp_mpc.simulation.scenarios import DT, SCENARIOS, STEPS, Scenario

__all__ = [
    "DT",
    "SCENARIOS",
    "STEPS",
    "ClosedLoop",
    "CorrelatedDisturbance",
    "Crowd",
    "Scenario",
    "simulate",
]
