"""IPOPT, an interior-point method, on the original problem with exact derivatives.

Notation: as in `nlp.py` and `scp_mpc.geometry.no_go`; y = R'(p - mu), m = [cos theta, sin theta].

    axes    |y / (s sigma + r)|^2 >= 1, the square form of (14)
    exact   m'y - s |diag(sigma) m| >= r, with the angle theta_{j,i} as one more unknown

The left side of the second is largest, and then the signed distance, where m is the outward
normal: some theta meets the constraint just where p is outside. So the lifting is exact.
"""

import warnings
from collections.abc import Sequence
from time import perf_counter, thread_time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.peers.nlp import Unknowns, linear_model, read
from benchmarks.peers.plan import PeerMissingError, PeerPlan
from scp_mpc.arrays import FloatArray
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.geometry.ellipsoid import signed_distance
from scp_mpc.geometry.no_go import NoGoSets
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.scp.iterate import Iterate, as_iterate
from scp_mpc.scp.step import Step
from scp_mpc.trajectory import Trajectory

_SILENT = {
    "print_time": False,
    "show_eval_warnings": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
}
_TINY = 1e-18  # [m^2] keeps the root of n'Sigma n differentiable where Sigma is singular


class Ipopt:
    """Builds the nonlinear program once, with everything that changes as a parameter.

    Only the primal guess is used: an interior-point method gains little from multipliers. There
    is no slack: where nothing meets all constraints, the plan has `ok = False`.

    Args:
        problem: What to solve.
        tolerance: IPOPT's `tol`, on its scaled KKT residual.
        max_iterations: The report's MaxIterations.

    Raises:
        PeerMissingError: CasADi is not installed.
        InvalidArgumentError: The exact inflation in space, which one angle cannot lift.
    """

    def __init__(
        self, problem: Problem, tolerance: float = 1e-8, max_iterations: int = 500
    ) -> None:
        """Write down the program and derive it."""
        self.problem = problem
        self._lifted = problem.inflation == "exact"
        if self._lifted and problem.model.dim != 2:
            raise InvalidArgumentError(
                "problem.inflation", f"'exact' is planar here, not {problem.model.dim}-dimensional"
            )
        self._unknowns = Unknowns(problem)
        options = _SILENT | {
            "ipopt.tol": tolerance,
            "ipopt.constr_viol_tol": tolerance,
            "ipopt.max_iter": max_iterations,
        }
        casadi = import_casadi()
        program = _program(casadi, problem, self._unknowns, self._lifted)
        self._solver = casadi.nlpsol("ipopt", "ipopt", program, options)

    def solve(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        guess: Trajectory | Iterate,
    ) -> PeerPlan:
        """Plan from the state x0; arguments as for `SCP.solve`."""
        began, worked = perf_counter(), thread_time()
        problem, unknowns = self.problem, self._unknowns
        step, sets = read(problem, x0, x_ref, obstacles)
        nominal = as_iterate(guess, problem)
        z, lower, upper = unknowns.pack(nominal), unknowns.lower, unknowns.upper
        if self._lifted:
            # Angles of inactive slots are fixed: IPOPT takes them out of the program.
            theta, free = self._angles(sets, nominal)
            z = np.concatenate([z, theta])
            lower, upper = np.append(lower, -free), np.append(upper, free)
        outside = np.repeat(np.where(sets.active, 0.0, -np.inf), problem.horizon)
        equal = np.zeros(problem.horizon * problem.model.nx)
        result = self._solver(
            x0=z,
            p=parameters(step, sets),
            lbx=lower,
            ubx=upper,
            lbg=np.concatenate([equal, outside]),
            ubg=np.concatenate([equal, np.full(len(outside), np.inf)]),
        )
        end = np.asarray(result["x"]).ravel()[: unknowns.size]
        point = unknowns.unpack(end, step.x0)
        stats = self._solver.stats()
        return PeerPlan.judged(
            problem,
            step,
            obstacles,
            point,
            seconds=perf_counter() - began,
            processor=thread_time() - worked,
            ok=bool(stats["success"]),
            message=str(stats["return_status"]),
        )

    def _angles(self, sets: NoGoSets, nominal: Iterate) -> tuple[FloatArray, FloatArray]:
        """The maximising angles (M N,) at the guess, and infinity where they are free, else 0."""
        positions = nominal.states[1:, self.problem.model.position]
        y = sets.to_eigenframe(positions - sets.means)
        _, m = signed_distance(y, nominal.s[:, None, None] * sets.deviations)
        on = np.broadcast_to(sets.active[:, None], m.shape[:-1])
        theta = np.where(on, np.arctan2(m[..., 1], m[..., 0]), 0.0)
        return theta.ravel(), np.where(on, np.inf, 0.0).ravel()


def import_casadi() -> Any:
    """CasADi, without its warnings.

    Raises:
        PeerMissingError: It is not installed.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            import casadi
    except ImportError as error:
        raise PeerMissingError("casadi") from error
    return casadi


def parameters(step: Step, sets: NoGoSets) -> FloatArray:
    """All that changes from step to step, in a row: x0, x_ref, mu, R, sigma, r."""
    data = (step.x0, step.x_ref[1:], sets.means, sets.rotations, sets.deviations, sets.radii[:, 0])
    return np.concatenate([part.ravel() for part in data])


def _program(casadi: Any, problem: Problem, unknowns: Unknowns, lifted: bool) -> dict[str, Any]:
    """The symbolic program: dynamics rows stage by stage, then obstacle rows slot by slot."""
    model, N, M = linear_model(problem), problem.horizon, problem.max_obstacles
    nx, nu, d = model.nx, model.nu, model.dim
    z = casadi.SX.sym("z", unknowns.size)
    theta = casadi.SX.sym("theta", N, M if lifted else 0)
    later, inputs, s = casadi.vertsplit(z, [0, *unknowns.ends, unknowns.size])
    x0 = casadi.SX.sym("x0", nx)
    x_ref = casadi.SX.sym("x_ref", nx, N)
    mu = casadi.SX.sym("mu", d, M * N)
    R = casadi.SX.sym("R", d, M * N * d)
    sigma = casadi.SX.sym("sigma", d, M * N)
    r = casadi.SX.sym("r", M)

    X, U = casadi.reshape(later, nx, N), casadi.reshape(inputs, nu, N)
    defects = X - model.A @ casadi.horzcat(x0, X[:, :-1]) - model.B @ U
    error = X - x_ref
    cost = problem.size.weight * casadi.sumsqr(s - problem.size.reference)
    for i in range(N):
        Q = problem.Q if i < N - 1 else problem.Qf
        cost += casadi.bilin(Q, error[:, i], error[:, i])
        cost += casadi.bilin(problem.R, U[:, i], U[:, i])

    P = X[model.position.tolist(), :]
    outside = []
    for j in range(M):
        for i in range(N):
            k = j * N + i
            # R arrives row by row, so that columns here are rows there: this is R' already.
            y = R[:, k * d : (k + 1) * d] @ (P[:, i] - mu[:, k])
            if lifted:
                m = casadi.vertcat(casadi.cos(theta[i, j]), casadi.sin(theta[i, j]))
                width = casadi.sqrt(casadi.sumsqr(sigma[:, k] * m) + _TINY)
                outside.append(casadi.dot(m, y) - s[j] * width - r[j])
            else:
                outside.append(casadi.sumsqr(y / (s[j] * sigma[:, k] + r[j])) - 1)
    return {
        "x": casadi.veccat(z, theta),
        "p": casadi.veccat(x0, x_ref, mu, R, sigma, r),
        "f": cost,
        "g": casadi.veccat(defects, *outside),
    }
