"""What every solver of the comparison returns, judged by one and the same yardstick."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import nan
from typing import Protocol

from numpy.typing import ArrayLike

from benchmarks.peers.violation import largest_violation
from scp_mpc.arrays import FloatArray
from scp_mpc.errors import ScpMpcError
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.scp.iterate import Iterate
from scp_mpc.scp.step import Step
from scp_mpc.trajectory import Trajectory


class PeerMissingError(ScpMpcError, ImportError):
    """A peer is not installed, or does not run here."""

    def __init__(self, package: str, reason: str = "it comes with the extra 'peers'") -> None:
        """Say what is missing and how to get it."""
        super().__init__(f"{package} is not installed; {reason}")


@dataclass(frozen=True, eq=False)
class PeerPlan:
    """The plan of one control step. M counts the obstacles that were passed.

    Attributes:
        X: (N+1, nx) states, row 0 the given one.
        U: (N, nu) inputs.
        s: (M,) sizes of the obstacles' ellipsoids.
        cost: Value of the objective.
        violation: Largest violation of the original constraints; see `largest_violation`.
        seconds: Wall time of the solve, without the judging.
        ok: Whether the solver itself reported success.
        message: What it reported.
        qps: Quadratic programs by the solver that finished them; empty if it does not tell.
        processor: Seconds of processor time of the solve; NaN if nobody looked.
    """

    X: FloatArray
    U: FloatArray
    s: FloatArray
    cost: float
    violation: float
    seconds: float
    ok: bool
    message: str
    qps: Mapping[str, int] = field(default_factory=dict)
    processor: float = nan

    @classmethod
    def judged(
        cls,
        problem: Problem,
        step: Step,
        obstacles: Sequence[ObstaclePrediction],
        point: tuple[FloatArray, FloatArray, FloatArray],
        *,
        seconds: float,
        ok: bool,
        message: str,
        processor: float = nan,
    ) -> "PeerPlan":
        """Add cost and violation to the states, inputs and sizes of all slots in `point`."""
        states, inputs, s = point
        used = s[: step.count]
        return cls(
            X=states,
            U=inputs,
            s=used,
            cost=problem.cost(states, inputs, s, step.x_ref),
            violation=largest_violation(problem, step.x0, obstacles, states, inputs, used),
            seconds=seconds,
            ok=ok,
            message=message,
            processor=processor,
        )


class Peer(Protocol):
    """A solver of the problem of `scp_mpc.problem` that starts from a guess."""

    def solve(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        guess: Trajectory | Iterate,
    ) -> PeerPlan:
        """Plan from the state x0; arguments as for `SCP.solve`."""
        ...
