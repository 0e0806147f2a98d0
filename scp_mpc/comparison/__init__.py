"""Comparison: the same problems, solved by others; IPOPT is optional and imported when used."""

from scp_mpc.comparison.ipopt import Ipopt
from scp_mpc.comparison.ours import Ours
from scp_mpc.comparison.peer_plan import Peer, PeerMissingError, PeerPlan
from scp_mpc.comparison.runner import BENCHMARKS, run
from scp_mpc.comparison.sequence import RecordedStep, record
from scp_mpc.comparison.slsqp import Slsqp
from scp_mpc.comparison.soak import run_soak
from scp_mpc.comparison.staged import Staged
from scp_mpc.comparison.violation import largest_violation

__all__ = [
    "BENCHMARKS",
    "Ipopt",
    "Ours",
    "Peer",
    "PeerMissingError",
    "PeerPlan",
    "RecordedStep",
    "Slsqp",
    "Staged",
    "largest_violation",
    "record",
    "run",
    "run_soak",
]
