"""Solvers that use the stages of an optimal control problem, through CasADi.

Fatrop (Vanroye et al., 2023), and CasADi's own SQP with the QP solvers qrqp, HPIPM or OSQP, on one
and the same program: the unknowns of a stage stand together, and every size s_j is a state that
stays as it is. Constraints are the report's (14) in its square form, as for IPOPT.

Notation:
    xi_i = [x_i, s]     state of stage i, with the sizes
    w = [xi_0, u_0, xi_1, u_1, .., xi_N]
"""

from collections.abc import Sequence
from time import perf_counter, thread_time
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.peers.ipopt import import_casadi, parameters
from benchmarks.peers.nlp import linear_model, read, refuse_limits
from benchmarks.peers.plan import PeerPlan
from scp_mpc.arrays import FloatArray
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.scp.iterate import Iterate, as_iterate
from scp_mpc.trajectory import Trajectory

_QUIET = {"print_time": False, "show_eval_warnings": False}
_QP: dict[str, dict[str, Any]] = {
    "qrqp": {"print_iter": False, "print_header": False, "print_info": False},
    "hpipm": {},
    "osqp": {"osqp": {"verbose": False, "eps_abs": 1e-8, "eps_rel": 1e-8, "max_iter": 20000}},
}
SOLVERS = ("fatrop", *(f"sqp-{name}" for name in _QP))


class Staged:
    """One of these solvers, set up once for a problem.

    Args:
        problem: What to solve; its inflation is "axes".
        solver: "fatrop", "sqp-qrqp", "sqp-hpipm" or "sqp-osqp".

    Raises:
        PeerMissingError: CasADi is not installed.
        InvalidArgumentError: Another solver, the exact inflation, or bounds of states or rates.
    """

    def __init__(self, problem: Problem, solver: str) -> None:
        """Write down the program and set up the solver."""
        if solver not in SOLVERS:
            raise InvalidArgumentError("solver", f"{solver!r} is none of {', '.join(SOLVERS)}")
        if problem.inflation != "axes":
            raise InvalidArgumentError("problem.inflation", f"{problem.inflation!r} is not 'axes'")
        refuse_limits(problem)
        self.problem = problem
        casadi = import_casadi()
        program, equality = _program(casadi, problem)
        if solver == "fatrop":
            options: dict[str, Any] = {
                "structure_detection": "auto",
                "equality": equality,
                "fatrop": {"print_level": 0, "tol": 1e-8},
            }
        else:
            qp = solver.removeprefix("sqp-")
            quiet = {"print_time": False, "error_on_fail": False}
            options = {
                "qpsol": qp,
                "qpsol_options": quiet | _QP[qp],
                "convexify_strategy": "eigen-clip",
                "tol_pr": 1e-6,
                "tol_du": 1e-6,
                "max_iter": 100,
                "error_on_fail": False,
                "print_header": False,
                "print_iteration": False,
                "print_status": False,
            }
        plugin = "fatrop" if solver == "fatrop" else "sqpmethod"
        self._solver = casadi.nlpsol("staged", plugin, program, _QUIET | options)
        self._bounds = _bounds(problem, np.array(equality))

    def solve(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        guess: Trajectory | Iterate,
    ) -> PeerPlan:
        """Plan from the state x0; arguments as for `SCP.solve`."""
        began, worked = perf_counter(), thread_time()
        problem = self.problem
        model, N, M = problem.model, problem.horizon, problem.max_obstacles
        step, sets = read(problem, x0, x_ref, obstacles)
        nominal = as_iterate(guess, problem)
        sizes = np.broadcast_to(nominal.s, (N + 1, M))
        stages = np.concatenate([nominal.states, sizes], axis=1)
        body = np.concatenate([stages[:-1], nominal.inputs], axis=1)
        unused = np.repeat(np.arange(M)[None] >= step.count, N, axis=0).ravel()
        lbg = self._bounds["lbg"].copy()
        lbg[np.flatnonzero(np.isinf(self._bounds["ubg"]))[unused]] = -np.inf
        result = self._solver(
            x0=np.concatenate([body.ravel(), stages[-1]]),
            p=parameters(step, sets),
            lbx=self._bounds["lbx"],
            ubx=self._bounds["ubx"],
            lbg=lbg,
            ubg=self._bounds["ubg"],
        )
        w = np.asarray(result["x"]).ravel()
        parts = w[: body.size].reshape(body.shape)
        end = np.concatenate([parts[:, : model.nx + M], w[None, body.size :]])
        ok, message = self._outcome()
        return PeerPlan.judged(
            problem,
            step,
            obstacles,
            (end[:, : model.nx], parts[:, model.nx + M :], end[-1, model.nx :]),
            seconds=perf_counter() - began,
            processor=thread_time() - worked,
            ok=ok,
            message=message,
        )

    def _outcome(self) -> tuple[bool, str]:
        try:
            stats = self._solver.stats()
        except RuntimeError as error:  # a QP solver that broke down has no status to tell
            return False, str(error)
        return bool(stats["success"]), str(stats["return_status"])


def _program(casadi: Any, problem: Problem) -> tuple[dict[str, Any], list[bool]]:
    """The program and which rows are equations: per stage dynamics first, then the others."""
    model, N, M = linear_model(problem), problem.horizon, problem.max_obstacles
    nx, nu, d = model.nx, model.nu, model.dim
    x0, x_ref = casadi.SX.sym("x0", nx), casadi.SX.sym("x_ref", nx, N)
    mu, R = casadi.SX.sym("mu", d, M * N), casadi.SX.sym("R", d, M * N * d)
    sigma, r = casadi.SX.sym("sigma", d, M * N), casadi.SX.sym("r", M)
    stages = [casadi.SX.sym(f"xi{i}", nx + M) for i in range(N + 1)]
    inputs = [casadi.SX.sym(f"u{i}", nu) for i in range(N)]
    w, g, equality = [], [], []
    cost = problem.size.weight * casadi.sumsqr(stages[0][nx:] - problem.size.reference)
    for i, xi in enumerate(stages):
        w.append(xi)
        if i < N:
            w.append(inputs[i])
            cost += casadi.bilin(problem.R, inputs[i], inputs[i])
            after = casadi.vertcat(model.A @ xi[:nx] + model.B @ inputs[i], xi[nx:])
            g.append(stages[i + 1] - after)
            equality += [True] * (nx + M)
        if i == 0:
            g.append(xi[:nx] - x0)
            equality += [True] * nx
            continue
        error = xi[:nx] - x_ref[:, i - 1]
        cost += casadi.bilin(problem.Q if i < N else problem.Qf, error, error)
        for j in range(M):
            k = j * N + i - 1
            # R arrives row by row, so that columns here are rows there: this is R' already.
            y = R[:, k * d : (k + 1) * d] @ (xi[model.position.tolist()] - mu[:, k])
            g.append(casadi.sumsqr(y / (xi[nx + j] * sigma[:, k] + r[j])) - 1)
            equality.append(False)
    parameters = casadi.veccat(x0, x_ref, mu, R, sigma, r)
    program = {"x": casadi.veccat(*w), "p": parameters, "f": cost, "g": casadi.veccat(*g)}
    return program, equality


def _bounds(problem: Problem, equality: Any) -> dict[str, FloatArray]:
    N, margin, M = problem.horizon, problem.size, problem.max_obstacles
    free = np.full(problem.model.nx, np.inf)
    low = np.concatenate([-free, np.full(M, margin.lower)])
    high = np.concatenate([free, np.full(M, margin.upper)])
    return {
        "lbx": np.concatenate([np.tile(np.concatenate([low, problem.u_min]), N), low]),
        "ubx": np.concatenate([np.tile(np.concatenate([high, problem.u_max]), N), high]),
        "lbg": np.zeros(len(equality)),
        "ubg": np.where(equality, 0.0, np.inf),
    }
