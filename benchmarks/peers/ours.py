"""Our own solver in the clothes of a peer."""

from collections.abc import Sequence
from time import perf_counter

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.peers.plan import PeerPlan
from benchmarks.peers.violation import largest_violation
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.scp.iterate import Iterate
from scp_mpc.scp.solver import SCP
from scp_mpc.settings import Settings
from scp_mpc.trajectory import Trajectory


class Ours:
    """`SCP`, judged like the others.

    Args:
        problem: What to solve.
        settings: How to solve it.
        multi_start: Try the other sides at every step, not only where the guess's own fails.
    """

    def __init__(
        self, problem: Problem, settings: Settings | None = None, multi_start: bool = False
    ) -> None:
        """Set up the solver."""
        self._solver = SCP(problem, settings)
        self._multi_start = multi_start

    def solve(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        guess: Trajectory | Iterate,
    ) -> PeerPlan:
        """Plan from the state x0; arguments as for `SCP.solve`."""
        began = perf_counter()
        plan = self._solver.solve(x0, x_ref, obstacles, guess, self._multi_start)
        seconds = perf_counter() - began
        problem, start = self._solver.problem, np.asarray(x0, dtype=np.float64)
        return PeerPlan(
            X=plan.X,
            U=plan.U,
            s=plan.s,
            cost=plan.cost,
            violation=largest_violation(problem, start, obstacles, plan.X, plan.U, plan.s),
            seconds=seconds,
            ok=plan.ok,
            message=plan.status.value,
            qps=plan.qps,
        )
