"""Simulation: scenarios, closed loops, wind, obstacles drawn from predictions, recorded crowds."""

from scp_mpc.simulation.contact import (
    contacts,
    robot_path,
    sampled_contacts,
)
from scp_mpc.simulation.coverage import (
    LEVELS,
    Coverage,
    LeadCoverage,
    measure_coverage,
)
from scp_mpc.simulation.crossing import Crossing
from scp_mpc.simulation.crowds import Crowd
from scp_mpc.simulation.disturbance import (
    ConstantPush,
    CorrelatedDisturbance,
    Disturbance,
)
from scp_mpc.simulation.episodes import run_episodes
from scp_mpc.simulation.events import Contact, Meeting, find_contacts, find_meetings
from scp_mpc.simulation.gust import DrydenGust
from scp_mpc.simulation.lag import ActuatorLag
from scp_mpc.simulation.plant import ModelPlant, Plant
from scp_mpc.simulation.realisations import (
    COUPLINGS,
    applicable_couplings,
    sample_paths,
)
from scp_mpc.simulation.recording import Recording
from scp_mpc.simulation.recordings import (
    RecordingError,
    read_recording,
)
from scp_mpc.simulation.replay import (
    RecordedSensor,
    control_steps,
    recorded_people,
    replay,
    replay_problem,
)
from scp_mpc.simulation.run import Run
from scp_mpc.simulation.scenarios import (
    DT,
    SCENARIOS,
    STEPS,
    Scenario,
)
from scp_mpc.simulation.scene import Body, Scene
from scp_mpc.simulation.sensor import PerfectSensor, Sensor, TrackedSensor
from scp_mpc.simulation.simulate import Controller, simulate
from scp_mpc.simulation.there_and_back import ThereAndBack, arrivals, crossing_of, time_alone

__all__ = [
    "COUPLINGS",
    "DT",
    "LEVELS",
    "SCENARIOS",
    "STEPS",
    "ActuatorLag",
    "Body",
    "ConstantPush",
    "Contact",
    "Controller",
    "CorrelatedDisturbance",
    "Coverage",
    "Crossing",
    "Crowd",
    "Disturbance",
    "DrydenGust",
    "LeadCoverage",
    "Meeting",
    "ModelPlant",
    "PerfectSensor",
    "Plant",
    "RecordedSensor",
    "Recording",
    "RecordingError",
    "Run",
    "Scenario",
    "Scene",
    "Sensor",
    "ThereAndBack",
    "TrackedSensor",
    "applicable_couplings",
    "arrivals",
    "contacts",
    "control_steps",
    "crossing_of",
    "find_contacts",
    "find_meetings",
    "measure_coverage",
    "read_recording",
    "recorded_people",
    "replay",
    "replay_problem",
    "robot_path",
    "run_episodes",
    "sample_paths",
    "sampled_contacts",
    "simulate",
    "time_alone",
]
