"""An independent formulation of the problem in CasADi: the referee of the convergence tests.

Nothing here comes from the package but the numbers of the problem. The signed distance of the
`exact` inflation is lifted: outside means that some direction n(theta) has
n'(p - mu) - s sqrt(n' Sigma n) >= r, so theta joins the variables.
"""

from copy import copy
from dataclasses import dataclass

import casadi
import numpy as np

from scp_mpc import ObstaclePrediction, Plan, Problem

_TWO_PI = 2 * np.pi


@dataclass(frozen=True)
class Verdict:
    """What IPOPT found."""

    X: np.ndarray
    U: np.ndarray
    s: float
    cost: float
    ok: bool


class Referee:
    """The hard problem with one planar obstacle, over w = [X_1..N | U | s | theta].

    The numbers of the step are parameters of the program, so that `at` another one nothing is
    derived or compiled again.
    """

    def __init__(self, problem: Problem, x0, x_ref, obstacle: ObstaclePrediction) -> None:
        self.problem = problem
        N, model, margin = problem.horizon, problem.model, problem.margin
        X, U = casadi.SX.sym("X", model.nx, N), casadi.SX.sym("U", model.nu, N)
        s, theta = casadi.SX.sym("s"), casadi.SX.sym("theta", N)
        start, ref = casadi.SX.sym("x0", model.nx), casadi.SX.sym("x_ref", model.nx, N)
        means, Sigmas = casadi.SX.sym("mu", 2, N), casadi.SX.sym("Sigma", 2, 2 * N)
        axes, deviations = casadi.SX.sym("axes", 2, 2 * N), casadi.SX.sym("deviations", 2, N)
        reach = casadi.SX.sym("r")
        Q, R = casadi.DM(problem.Q), casadi.DM(problem.R)
        cost = margin.weight * (s - margin.reference) ** 2
        defects, outside = [], []
        previous = start
        for i in range(N):
            error = X[:, i] - ref[:, i]
            cost += error.T @ Q @ error + U[:, i].T @ R @ U[:, i]
            defects.append(X[:, i] - model.A @ previous - model.B @ U[:, i])
            previous = X[:, i]
            delta = casadi.vertcat(X[0, i], X[2, i]) - means[:, i]
            if problem.inflation == "axes":
                y = axes[:, 2 * i : 2 * i + 2].T @ delta
                semi = s * deviations[:, i] + reach
                outside.append(casadi.sqrt(casadi.sumsqr(y / semi)) - 1)
            else:
                n = casadi.vertcat(casadi.cos(theta[i]), casadi.sin(theta[i]))
                spread = casadi.sqrt(n.T @ Sigmas[:, 2 * i : 2 * i + 2] @ n)
                outside.append(n.T @ delta - s * spread - reach)
        self.z = casadi.vertcat(casadi.vec(X), casadi.vec(U), s)
        self.theta = theta
        self.cost = cost
        self.defects, self.outside = casadi.vertcat(*defects), casadi.vertcat(*outside)
        self.size_x, self.size_u = N * model.nx, N * model.nu
        parameters = (start, ref, means, Sigmas, axes, deviations, reach)
        self.parameters = casadi.vertcat(*map(casadi.vec, parameters))
        self.compiled: dict[str, casadi.Function] = {}
        self._given(x0, x_ref, obstacle)

    def at(self, x0, x_ref, obstacle: ObstaclePrediction) -> "Referee":
        """The same problem at another step."""
        other = copy(self)
        other._given(x0, x_ref, obstacle)
        return other

    def _given(self, x0, x_ref, obstacle: ObstaclePrediction) -> None:
        self.obstacle = obstacle
        Sigmas = obstacle.covariances[1:]
        variances, axes = np.linalg.eigh(Sigmas)
        by_columns = axes.transpose(0, 2, 1)
        numbers = x0, x_ref[1:], obstacle.means[1:], Sigmas, by_columns, np.sqrt(variances)
        reach = self.problem.robot_radius + obstacle.radius
        self.p = np.concatenate([*map(np.ravel, numbers), [reach]])

    def angles(self, positions: np.ndarray, s: float) -> np.ndarray:
        """Angle of the outward normal at each position, by search on a grid and bisection."""
        deltas = positions - self.obstacle.means[1:]
        Sigmas = self.obstacle.covariances[1:]

        def best(theta):
            """The one of (N, K) angles at which each position is farthest out, (N, 1)."""
            n = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
            spreads = np.sqrt(np.einsum("nki,nij,nkj->nk", n, Sigmas, n))
            farthest = np.argmax(np.einsum("nki,ni->nk", n, deltas) - s * spreads, axis=1)
            return np.take_along_axis(theta, farthest[:, None], axis=1)

        grid = np.linspace(0.0, _TWO_PI, 721)
        centre, width = best(np.tile(grid, (len(deltas), 1))), grid[1]
        for _ in range(12):
            centre, width = best(centre + width * np.linspace(-1.0, 1.0, 41)), width / 10
        found = zip(centre[:, 0], deltas, Sigmas, strict=True)
        return np.array([_polished(theta, delta, Sigma, s) for theta, delta, Sigma in found])

    def kkt(self, plan: Plan) -> dict[str, float]:
        """KKT residuals of the original problem at a plan and its multipliers."""
        duals = plan.multipliers
        assert duals is not None
        theta = self.angles(plan.X[1:, [0, 2]], float(plan.s[0]))
        if "kkt" not in self.compiled:
            y_defects = casadi.SX.sym("y_defects", self.defects.numel())
            y_outside = casadi.SX.sym("y_outside", len(theta))
            lagrangian = self.cost + y_defects.T @ self.defects + y_outside.T @ self.outside
            self.compiled["kkt"] = casadi.Function(
                "kkt",
                [self.z, self.theta, self.parameters, y_defects, y_outside],
                [casadi.gradient(lagrangian, self.z), self.defects, self.outside],
            )
        evaluate = self.compiled["kkt"]
        scale = self._row_scale()
        z = np.concatenate([plan.X[1:].ravel(), plan.U.ravel(), plan.s])
        gradient, defects, outside = (
            np.array(v).ravel()
            for v in evaluate(z, theta, self.p, duals.dynamics.ravel(), duals.obstacles[0] * scale)
        )
        gradient[self.size_x : -1] += duals.inputs.ravel()
        gradient[-1] += duals.margin[0]
        problem, U = self.problem, plan.U
        bounds = np.concatenate([(U - problem.u_max).ravel(), (problem.u_min - U).ravel()])
        size = np.array([plan.s[0] - problem.margin.upper, problem.margin.lower - plan.s[0]])
        at_bound = np.where(duals.inputs > 0, problem.u_max - U, U - problem.u_min)
        at_size = np.where(
            duals.margin > 0, problem.margin.upper - plan.s, plan.s - problem.margin.lower
        )
        return {
            "stationarity": np.abs(gradient).max(),
            "defect": np.abs(defects).max(),
            "violation": max(bounds.max(), size.max(), (-outside).max()),
            "sign": max(0.0, duals.obstacles.max()),
            "complementarity": max(
                np.abs(duals.obstacles[0] * scale * outside).max(),
                np.abs(duals.inputs * at_bound).max(),
                np.abs(duals.margin * at_size).max(),
            ),
        }

    def solve(self, X, U, s: float, near: bool) -> Verdict:
        """Run IPOPT from a plan; `near` keeps the barrier small so that it stays close by."""
        problem, N = self.problem, self.problem.horizon
        theta = self.angles(X[1:, [0, 2]], s)
        solver, free = self._ipopt(near), np.full(self.size_x, np.inf)
        result = solver(
            p=self.p,
            x0=np.concatenate([X[1:].ravel(), U.ravel(), [s], theta]),
            lbx=np.concatenate(
                [-free, np.tile(problem.u_min, N), [problem.margin.lower], np.full(N, -np.inf)]
            ),
            ubx=np.concatenate(
                [free, np.tile(problem.u_max, N), [problem.margin.upper], np.full(N, np.inf)]
            ),
            lbg=np.zeros(self.size_x + N),
            ubg=np.concatenate([np.zeros(self.size_x), np.full(N, np.inf)]),
        )
        w = np.array(result["x"]).ravel()
        ends = w[: self.size_x].reshape(N, -1)
        inputs = w[self.size_x : self.size_x + self.size_u].reshape(N, -1)
        size = float(w[self.size_x + self.size_u])
        ok = bool(solver.stats()["success"])
        return Verdict(np.vstack([X[:1], ends]), inputs, size, float(result["f"]), ok)

    def _ipopt(self, near: bool) -> casadi.Function:
        which = "near" if near else "far"
        if which not in self.compiled:
            w = casadi.vertcat(self.z, self.theta)
            rows = casadi.vertcat(self.defects, self.outside)
            nlp = {"x": w, "p": self.parameters, "f": self.cost, "g": rows}
            options = {
                "print_time": False,
                "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-9, "max_iter": 2000},
            }
            if near:
                options["ipopt"] |= {
                    "mu_init": 1e-9,
                    "bound_push": 1e-10,
                    "bound_frac": 1e-10,
                    "slack_bound_push": 1e-10,
                    "slack_bound_frac": 1e-10,
                }
            self.compiled[which] = casadi.nlpsol("referee", "ipopt", nlp, options)
        return self.compiled[which]

    def _row_scale(self) -> np.ndarray:
        """The package measures the `axes` constraint in metres: times the short semi-axis."""
        if self.problem.inflation == "exact":
            return np.ones(self.problem.horizon)
        deviations = np.sqrt(np.linalg.eigvalsh(self.obstacle.covariances[1:]))[:, 0]
        reach = self.problem.robot_radius + self.obstacle.radius
        return self.problem.margin.reference * deviations + reach


def _polished(theta: float, delta: np.ndarray, Sigma: np.ndarray, s: float) -> float:
    """Newton steps on the stationarity of the support function."""
    for _ in range(4):
        n = np.array([np.cos(theta), np.sin(theta)])
        t = np.array([-n[1], n[0]])
        h = np.sqrt(n @ Sigma @ n)
        slope = t @ delta - s * (t @ Sigma @ n) / h
        bend = -n @ delta - s * ((t @ Sigma @ t - n @ Sigma @ n) / h - (t @ Sigma @ n) ** 2 / h**3)
        theta -= slope / bend
    return theta
