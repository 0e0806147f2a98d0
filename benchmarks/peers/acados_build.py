"""acados's C code for a problem, written by its Python interface: a script of its own.

    python -m benchmarks.peers.acados_build FOLDER

In FOLDER is `problem.pickle`, a problem and the name of a method ("SQP" or "SQP_RTI"); the code
goes to `c_generated_code` there. `acados.py` runs it where acados's interface is on the path, so
that nothing of that interface, its messages included, gets into the process that races.

    minimise   sum_i |x_i - xref_i|^2_Q + sum_i |u_i|^2_R + sum_j w (s_j - s_ref)^2 + v sum |slack|
    subject to h_j(x_i, s_j) >= -slack_ij at the samples i = 1 .. N, bounds on inputs and states

h is the constraint function of `scp_mpc.geometry.inflation`, smooth and in metres. Where a size
s_j has nothing to gain (s_min = s_ref) it is a number, otherwise a state that stays as it is.

Notation:
    p, q    (2,)    position of the robot; likewise in the ellipse's axes
    sigma   (2,)    standard deviations along them, the larger first
    r               sum of the radii
"""

import pickle
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import casadi
import numpy as np

from benchmarks.peers.referee import symbolic
from scp_mpc.models.unicycle import Unicycle
from scp_mpc.problem import Problem

NAME = "peer"  # of the solver: prefix of its C functions
PER_OBSTACLE = 7  # parameters: mean, cosine and sine of the first axis, sigma, r
_FAR = 1e4  # [m] above all h; where one side of a bound cannot be masked it must not be huge
_MASKED = 1e10  # acados's infinity
_WARM = 100  # horizon up to which warm starts of the second program and later ones pay
_TINY = 1e-18  # [m^2] keeps roots differentiable
_NEWTON = 8  # iterations for the nearest point of an ellipse: 1e-7 m even at axes of 150 : 1


def sizes_are_free(problem: Problem) -> bool:
    """Whether a smaller size than the reference is allowed."""
    return problem.size.lower < problem.size.reference


def describe(problem: Problem, method: str, template: Any) -> Any:
    """The problem in the words of acados's Python interface.

    Args:
        problem: What to solve.
        method: "SQP" or "SQP_RTI".
        template: The module `acados_template`.
    """
    ocp, model = template.AcadosOcp(), template.AcadosModel()
    nx, nu, N, M = problem.model.nx, problem.model.nu, problem.horizon, problem.max_obstacles
    ns = M if sizes_are_free(problem) else 0
    x, u = casadi.SX.sym("x", nx + ns), casadi.SX.sym("u", nu)
    p = casadi.SX.sym("p", PER_OBSTACLE, M)
    sizes = x[nx:] if ns else casadi.DM.ones(M) * problem.size.reference
    model.name, model.x, model.u, model.p = NAME, x, u, casadi.vec(p)
    after = _next(problem.model, x[:nx], u)
    model.disc_dyn_expr = casadi.vertcat(after, x[nx:])
    position = x[problem.model.position.tolist()]
    shape = {"exact": _exact, "axes": _axes}[problem.inflation]
    h = [shape(position, sizes[j], p[:, j], problem.size.reference) for j in range(M)]
    if M:
        model.con_h_expr = model.con_h_expr_e = casadi.vertcat(*h)
    ocp.model, ocp.parameter_values = model, np.zeros(M * PER_OBSTACLE)

    options = ocp.solver_options
    recent = hasattr(options, "N_horizon")
    if recent:
        options.N_horizon = N
    else:
        ocp.dims.N = N
    _cost(ocp.cost, problem, ns)
    _constraints(ocp, problem, ns, _MASKED if recent else _FAR)
    options.tf = float(N)  # acados multiplies costs by the interval, which is 1 then
    options.integrator_type = "DISCRETE"
    options.hessian_approx = "GAUSS_NEWTON"
    options.nlp_solver_type = method
    options.nlp_solver_max_iter = 100
    for which in ("stat", "eq", "ineq", "comp"):
        setattr(options, f"nlp_solver_tol_{which}", 1e-6)
    # The quickest of what was tried: full condensing, other numbers of blocks, exact Hessians with
    # three regularisations, line search, the other modes and tolerances of HPIPM, -O3.
    options.qp_solver = "PARTIAL_CONDENSING_HPIPM"
    options.hpipm_mode = "SPEED"
    options.qp_solver_cond_N = min(N, max(5, N // 6))
    options.qp_solver_warm_start = 2 if N <= _WARM else 0
    options.qp_solver_iter_max = 100
    return ocp


def _next(model: Any, x: Any, u: Any) -> Any:
    """The state after; the unicycle's by series of j_0 and j_1, to 1e-12 up to 0.4 rad a step."""
    if not isinstance(model, Unicycle):
        return symbolic(model)(x, u)
    h, mu2 = model.dt, (0.5 * model.dt * u[1]) ** 2
    j0 = 1 - mu2 / 6 * (1 - mu2 / 20 * (1 - mu2 / 42 * (1 - mu2 / 72)))
    j1 = 0.5 * h * u[1] / 3 * (1 - mu2 / 10 * (1 - mu2 / 28 * (1 - mu2 / 54)))
    along, aside = h * (x[3] + 0.5 * h * u[0]) * j0, 0.5 * h**2 * u[0] * j1
    c, s = casadi.cos(x[2] + 0.5 * h * u[1]), casadi.sin(x[2] + 0.5 * h * u[1])
    way = casadi.vertcat(along * c - aside * s, along * s + aside * c)
    return casadi.vertcat(x[:2] + way, x[2] + h * u[1], x[3] + h * u[0])


def _in_axes(position: Any, p: Any) -> Any:
    d = position - p[:2]
    return casadi.vertcat(p[2] * d[0] + p[3] * d[1], p[2] * d[1] - p[3] * d[0])


def _axes(position: Any, s: Any, p: Any, reference: float) -> Any:
    """The report's ellipse: c (|q / (s sigma + r)| - 1), c the shorter semi-axis at s_ref."""
    w = _in_axes(position, p) / (s * p[4:6] + p[6])
    return (reference * p[5] + p[6]) * (casadi.sqrt(casadi.sumsqr(w) + _TINY) - 1)


def _exact(position: Any, s: Any, p: Any, reference: float) -> Any:  # noqa: ARG001
    """The signed distance: n'q - |s diag(sigma) n| - r at the normal n of the nearest point.

    By as many steps as always of what `scp_mpc.geometry.ellipsoid` does; n has an effect of second
    order only.
    """
    q, e = _in_axes(position, p), s * p[4:6]
    gap, reach = e * e - e[1] ** 2, e * casadi.fabs(q)
    tau = casadi.fmax(reach[0] - gap[0], reach[1]) + _TINY
    for _ in range(_NEWTON):
        w2 = (reach / (tau + gap)) ** 2
        norm2 = w2[0] + w2[1]
        descent = w2[0] / (tau + gap[0]) + w2[1] / tau
        tau = tau + (casadi.sqrt(norm2 + _TINY) - 1) * norm2 / descent
    n = q / (tau + gap)
    n = n / casadi.sqrt(casadi.sumsqr(n) + _TINY)
    return casadi.dot(n, q) - casadi.sqrt(casadi.sumsqr(e * n) + _TINY) - p[6]


def _cost(cost: Any, problem: Problem, ns: int) -> None:
    """Linear least squares without factor 1/2: weights are doubled."""
    nx, nu = problem.model.nx, problem.model.nu
    on_x, on_u = np.eye(nx, nx + ns), np.eye(nu)
    on_s = np.eye(ns, nx + ns, nx)
    cost.cost_type_0 = cost.cost_type = cost.cost_type_e = "LINEAR_LS"
    cost.W_0 = 2 * _diagonal(problem.R, problem.size.weight * np.eye(ns))
    cost.Vu_0 = np.concatenate([on_u, np.zeros((ns, nu))])
    cost.Vx_0 = np.concatenate([np.zeros((nu, nx + ns)), on_s])
    cost.yref_0 = np.concatenate([np.zeros(nu), np.full(ns, problem.size.reference)])
    cost.W = 2 * _diagonal(problem.Q, problem.R)
    cost.Vx = np.concatenate([on_x, np.zeros((nu, nx + ns))])
    cost.Vu = np.concatenate([np.zeros((nx, nu)), on_u])
    cost.yref = np.zeros(nx + nu)
    cost.W_e, cost.Vx_e, cost.yref_e = 2 * problem.Qf, on_x, np.zeros(nx)
    weight = np.full(problem.max_obstacles, problem.slack_weight)
    cost.zl = cost.zu = cost.zl_e = cost.zu_e = weight
    cost.Zl = cost.Zu = cost.Zl_e = cost.Zu_e = np.zeros(problem.max_obstacles)


def _constraints(ocp: Any, problem: Problem, ns: int, infinity: float) -> None:
    nx, nu, M = problem.model.nx, problem.model.nu, problem.max_obstacles
    constraints, size, each = ocp.constraints, problem.size, np.arange(M)
    constraints.lbu, constraints.ubu, constraints.idxbu = (
        problem.u_min,
        problem.u_max,
        np.arange(nu),
    )
    constraints.lbx_0 = np.concatenate([np.zeros(nx), np.full(ns, size.lower)])
    constraints.ubx_0 = np.concatenate([np.zeros(nx), np.full(ns, size.upper)])
    constraints.idxbx_0 = np.arange(nx + ns)
    # Which of them are equations, to be eliminated; HPIPM ends in NaN if that leaves a state over.
    constraints.idxbxe_0 = np.zeros(0) if ns else np.arange(nx)
    bounded = problem.bounded_states
    if len(bounded):
        low = np.maximum(problem.x_min[bounded], -infinity)
        high = np.minimum(problem.x_max[bounded], infinity)
        constraints.lbx, constraints.ubx, constraints.idxbx = low, high, bounded
        constraints.lbx_e, constraints.ubx_e, constraints.idxbx_e = low, high, bounded
    constraints.lh = constraints.lh_e = np.zeros(M)
    constraints.uh = constraints.uh_e = np.full(M, infinity)
    constraints.idxsh = constraints.idxsh_e = each


def _diagonal(first: Any, second: Any) -> Any:
    m, n = len(first), len(second)
    return np.block([[first, np.zeros((m, n))], [np.zeros((n, m)), second]])


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    given, kind = pickle.loads((folder / "problem.pickle").read_bytes())
    interface = import_module("acados_template")
    description = describe(given, kind, interface)
    interface.AcadosOcpSolver.generate(description, json_file=str(folder / "ocp.json"))
