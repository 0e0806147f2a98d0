"""Peers: the same problems, solved by others; all but SciPy are imported when used."""

from benchmarks.peers.ipopt import Ipopt
from benchmarks.peers.ours import Ours
from benchmarks.peers.plan import Peer, PeerMissingError, PeerPlan
from benchmarks.peers.slsqp import Slsqp
from benchmarks.peers.staged import Staged
from benchmarks.peers.violation import largest_violation

__all__ = [
    "Ipopt",
    "Ours",
    "Peer",
    "PeerMissingError",
    "PeerPlan",
    "Slsqp",
    "Staged",
    "largest_violation",
]
