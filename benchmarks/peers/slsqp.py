"""The report's own method: full-space SQP with derivatives from finite differences (III.F).

SciPy's SLSQP stands in for the report's solver: dense quasi-Newton SQP on all states, inputs and
sizes at once. Nothing tells it that the dynamics are linear or that the problem has stages.
"""

import warnings
from collections.abc import Sequence
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import Bounds, minimize

from benchmarks.peers.nlp import Unknowns, linear_model, read
from benchmarks.peers.plan import PeerPlan
from scp_mpc.arrays import FloatArray
from scp_mpc.geometry.no_go import NoGoSets
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.scp.iterate import Iterate, as_iterate
from scp_mpc.scp.step import Step
from scp_mpc.trajectory import Trajectory


class Slsqp:
    """Solves the nonlinear program of `nlp.py` with SciPy's SLSQP.

    Args:
        problem: What to solve.
        tolerance: The report's ConstraintTolerance. SLSQP's `ftol` bounds both the last change
            of the cost and the sum of all violations.
        max_iterations: The report's MaxIterations.
    """

    def __init__(
        self, problem: Problem, tolerance: float = 1e-6, max_iterations: int = 500
    ) -> None:
        """Lay out the unknowns."""
        self.problem = problem
        self._unknowns = Unknowns(problem)
        self._bounds = Bounds(self._unknowns.lower, self._unknowns.upper)
        self._options: Any = {"ftol": tolerance, "maxiter": max_iterations}

    def solve(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        guess: Trajectory | Iterate,
    ) -> PeerPlan:
        """Plan from the state x0; arguments as for `SCP.solve`."""
        began = perf_counter()
        problem, unknowns = self.problem, self._unknowns
        step, sets = read(problem, x0, x_ref, obstacles)

        def cost(z: FloatArray) -> float:
            return problem.cost(*unknowns.unpack(z, step.x0), step.x_ref)

        constraints: list[Any] = [{"type": "eq", "fun": lambda z: self._defects(z, step)}]
        if step.count:
            constraints.append({"type": "ineq", "fun": lambda z: self._outside(z, step, sets)})
        with warnings.catch_warnings():
            # SLSQP may step out of the bounds by rounding, says so, and goes back.
            warnings.filterwarnings("ignore", "Values in x were outside bounds", RuntimeWarning)
            result = minimize(
                cost,
                unknowns.pack(as_iterate(guess, problem)),
                method="SLSQP",
                bounds=self._bounds,
                constraints=constraints,
                options=self._options,
            )
        return PeerPlan.judged(
            problem,
            step,
            obstacles,
            unknowns.unpack(result.x, step.x0),
            seconds=perf_counter() - began,
            ok=bool(result.success),
            message=str(result.message),
        )

    def _defects(self, z: FloatArray, step: Step) -> FloatArray:
        """x_{i+1} - A x_i - B u_i, (N nx,)."""
        X, U, _ = self._unknowns.unpack(z, step.x0)
        model = linear_model(self.problem)
        return (X[1:] - X[:-1] @ model.A.T - U @ model.B.T).ravel()

    def _outside(self, z: FloatArray, step: Step, sets: NoGoSets) -> FloatArray:
        """The obstacles' g of `nlp.py`, (M N,) of the slots in use."""
        X, _, s = self._unknowns.unpack(z, step.x0)
        positions = X[1:, self.problem.model.position]
        if self.problem.inflation == "exact":
            start = np.ones((len(s), positions.shape[1]))
            start[: step.count] = step.here - step.means[:, 0]
            value = self.problem.no_go.linearise(sets, positions, s, start).value
            return value[: step.count].ravel()
        y = sets.to_eigenframe(positions - sets.means)
        w = y / (s[:, None, None] * sets.deviations + sets.radii[..., None])
        return (np.square(w).sum(axis=-1) - 1)[: step.count].ravel()
