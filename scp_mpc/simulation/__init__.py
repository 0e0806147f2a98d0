"""Simulation: named scenarios, the closed loop, obstacles drawn from predictions, contact."""

from scp_mpc.simulation.closed_loop import ClosedLoop, simulate
from scp_mpc.simulation.contact import contacts, robot_path, sampled_contacts
from scp_mpc.simulation.crowds import Crowd
from scp_mpc.simulation.disturbance import CorrelatedDisturbance
from scp_mpc.simulation.realisations import COUPLINGS, applicable_couplings, sample_paths
from scp_mpc.simulation.scenarios import DT, SCENARIOS, STEPS, Scenario

__all__ = [
    "COUPLINGS",
    "DT",
    "SCENARIOS",
    "STEPS",
    "ClosedLoop",
    "CorrelatedDisturbance",
    "Crowd",
    "Scenario",
    "applicable_couplings",
    "contacts",
    "robot_path",
    "sample_paths",
    "sampled_contacts",
    "simulate",
]
