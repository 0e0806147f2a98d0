"""An independent formulation for every model in CasADi: the referee of nonlinear plans.

Nothing here comes from the package but the numbers of the problem. The dynamics are written anew;
the unicycle's arc is a Gauss-Legendre quadrature. Outside an obstacle means that some n, |n| <= 1,
has n'(p - mu) - s sqrt(n' Sigma n) >= r, so that n joins the variables: by its angle in the plane,
by its three entries in space. The sizes s are fixed, and nothing is softened.
"""

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass
from typing import Any

import casadi
import numpy as np

from scp_mpc.arrays import FloatArray

_OPTIONS = {"print_level": 0, "sb": "yes", "tol": 1e-9, "max_iter": 3000}
_NEAR = {
    "mu_init": 1e-9,
    "bound_push": 1e-10,
    "bound_frac": 1e-10,
    "slack_bound_push": 1e-10,
    "slack_bound_frac": 1e-10,
}


@dataclass(frozen=True)
class Verdict:
    """What IPOPT found."""

    X: FloatArray
    U: FloatArray
    cost: float
    ok: bool


def symbolic(model: Any) -> Callable[[Any, Any], Any]:
    """The next state in CasADi, of a state and an input in CasADi."""
    kind = type(model).__name__
    if hasattr(model, "A"):
        return lambda x, u: (
            casadi.mtimes(casadi.DM(model.A), x) + casadi.mtimes(casadi.DM(model.B), u)
        )
    if kind == "Unicycle":
        return lambda x, u: _arc(x, u, model.dt)
    rates = {"KinematicBicycle": _bicycle, "PlanarQuadrotor": _planar, "Quadrotor": _space}[kind]
    return lambda x, u: _classical(lambda x: rates(model, x, u), x, model.dt, model.substeps)


class ModelReferee:
    """The hard problem over w = [X_1..N | U | n], with any number of obstacles.

    The numbers of the step are parameters of the program, so that `at` another one nothing is
    derived or compiled again.

    Args:
        problem: model, horizon, Q, R, Qf, u_min, u_max, robot_radius are read, and
            `size.reference` where no `size` is given.
        x0, x_ref: As in a control step.
        obstacles: Predictions.
        size: s of all obstacles.
        bounds: Hard bounds x_min, x_max (nx,), du_min, du_max (nu,) on u_i - u_(i-1).
        u_before: u_(-1); without it the first difference is free.
        dynamics: The next state in CasADi, for a model that is not known here.
    """

    def __init__(
        self,
        problem: Any,
        x0: Any,
        x_ref: Any,
        obstacles: Sequence[Any],
        *,
        size: float | None = None,
        u_before: Any = None,
        dynamics: Callable[[Any, Any], Any] | None = None,
        **bounds: Any,
    ) -> None:
        self.problem = problem
        self.size = float(problem.size.reference if size is None else size)
        model, N = problem.model, problem.horizon
        advance = dynamics or symbolic(model)
        self.nx, self.nu, self.dim = model.nx, model.nu, len(model.position)
        self.position = [int(i) for i in model.position]
        X, U = casadi.SX.sym("X", self.nx, N), casadi.SX.sym("U", self.nu, N)
        self.width = 1 if self.dim == 2 else 3
        sides = casadi.SX.sym("n", self.width, N * len(obstacles))
        start, ref = casadi.SX.sym("x0", self.nx), casadi.SX.sym("x_ref", self.nx, N)
        means = casadi.SX.sym("mu", self.dim, N * len(obstacles))
        spreads = casadi.SX.sym("Sigma", self.dim, self.dim * N * len(obstacles))
        reaches = casadi.SX.sym("r", len(obstacles))
        weights = [casadi.DM(W) for W in (problem.Q, problem.Qf, problem.R)]
        cost, rows, lower, upper = 0, [], [], []
        self.kinds: list[str] = []  # of all rows

        def demand(kind: str, row: Any, low: Any, high: Any) -> None:
            self.kinds += [kind] * row.numel()
            rows.append(row)
            lower.append(np.broadcast_to(low, row.numel()))
            upper.append(np.broadcast_to(high, row.numel()))

        previous, idle = start, casadi.DM(model.equilibrium_input)
        for i in range(N):
            error = X[:, i] - ref[:, i]
            cost += casadi.bilin(weights[i == N - 1], error) + casadi.bilin(
                weights[2], U[:, i] - idle
            )
            demand("dynamics", X[:, i] - advance(previous, U[:, i]), 0.0, 0.0)
            previous = X[:, i]
            before = U[:, i - 1] if i else (None if u_before is None else casadi.DM(u_before))
            if before is not None and {"du_min", "du_max"} & set(bounds):
                low, high = bounds.get("du_min", -np.inf), bounds.get("du_max", np.inf)
                demand("rates", U[:, i] - before, low, high)
            for j in range(len(obstacles)):
                k = j * N + i
                n = sides[:, k]
                if self.dim == 2:
                    n = casadi.vertcat(casadi.cos(n), casadi.sin(n))
                else:
                    demand("unit", casadi.sumsqr(n), -np.inf, 1.0)
                Sigma = spreads[:, k * self.dim : (k + 1) * self.dim]
                outwards = casadi.dot(n, X[self.position, i] - means[:, k])
                gap = outwards - self.size * casadi.sqrt(casadi.bilin(Sigma, n)) - reaches[j]
                demand("obstacles", gap, 0.0, np.inf)
        w = casadi.vertcat(casadi.vec(X), casadi.vec(U), casadi.vec(sides))
        p = casadi.vertcat(*map(casadi.vec, (start, ref, means, spreads, reaches)))
        self.nlp = {"x": w, "p": p, "f": cost, "g": casadi.vertcat(*rows)}
        self.compiled: dict[str, casadi.Function] = {}
        self.rows = np.concatenate(lower), np.concatenate(upper)
        free = np.full(sides.numel(), np.inf)
        x_min, x_max = bounds.pop("x_min", -np.inf), bounds.pop("x_max", np.inf)
        assert set(bounds) <= {"du_min", "du_max"}, bounds
        self.box = tuple(
            np.concatenate([np.tile(np.broadcast_to(x, self.nx), N), np.tile(u, N), sign * free])
            for x, u, sign in ((x_min, problem.u_min, -1), (x_max, problem.u_max, 1))
        )
        self._given(x0, x_ref, obstacles)

    def at(self, x0: Any, x_ref: Any, obstacles: Sequence[Any]) -> "ModelReferee":
        """The same problem at another step, with as many obstacles."""
        assert len(obstacles) == len(self.obstacles)
        other = copy(self)
        other._given(x0, x_ref, obstacles)
        return other

    def _given(self, x0: Any, x_ref: Any, obstacles: Sequence[Any]) -> None:
        self.obstacles = obstacles
        numbers = [x0, x_ref[1:], *(o.means[1:] for o in obstacles)]
        numbers += [*(o.covariances[1:] for o in obstacles)]  # symmetric
        numbers += [self.problem.robot_radius + o.radius for o in obstacles]
        self.p = np.concatenate([np.ravel(number) for number in numbers])

    def solve(self, X: FloatArray, U: FloatArray, near: bool) -> Verdict:
        """Run IPOPT from a plan; `near` keeps the barrier small so that it stays close by."""
        which = "near" if near else "far"
        if which not in self.compiled:
            options: dict[str, Any] = {
                "print_time": False,
                "ipopt": _OPTIONS | (_NEAR if near else {}),
            }
            self.compiled[which] = casadi.nlpsol("referee", "ipopt", self.nlp, options)
        solver = self.compiled[which]
        result = solver(
            p=self.p,
            x0=np.concatenate([X[1:].ravel(), U.ravel(), self._sides(X[1:, self.position])]),
            lbx=self.box[0],
            ubx=self.box[1],
            lbg=self.rows[0],
            ubg=self.rows[1],
        )
        w, N = np.array(result["x"]).ravel(), self.problem.horizon
        ends = w[: N * self.nx].reshape(N, self.nx)
        inputs = w[N * self.nx : N * (self.nx + self.nu)].reshape(N, self.nu)
        ok = bool(solver.stats()["success"])
        return Verdict(np.vstack([X[:1], ends]), inputs, float(result["f"]), ok)

    def kkt(self, plan: Any) -> dict[str, float]:
        """KKT residuals of the original problem at a plan and its multipliers.

        One point in each interval; rates are not looked at.
        """
        duals, kinds = plan.multipliers, np.array(self.kinds)
        if "kkt" not in self.compiled:
            x, p, f, g = (self.nlp[key] for key in "xpfg")
            y = casadi.SX.sym("y", g.numel())
            gradient = casadi.gradient(f + casadi.dot(y, g), x)
            self.compiled["kkt"] = casadi.Function("kkt", [x, p, y], [gradient, g])
        values = np.zeros(len(kinds))
        values[kinds == "dynamics"] = duals.dynamics.ravel()
        # The rows go by stage, then by obstacle.
        values[kinds == "obstacles"] = duals.obstacles[: len(self.obstacles)].T.ravel()
        w = np.concatenate([plan.X[1:].ravel(), plan.U.ravel()])
        w_all = np.append(w, self._sides(plan.X[1:, self.position]))
        slope, rows = self.compiled["kkt"](w_all, self.p, values)
        slope, rows, count = np.array(slope).ravel(), np.array(rows).ravel(), len(w)
        forces = np.zeros(count)
        if duals.states.size:
            on_x = forces[: self.problem.horizon * self.nx].reshape(-1, self.nx)
            on_x[:, self.problem.bounded_states] = duals.states
        forces[self.problem.horizon * self.nx :] = duals.inputs.ravel()
        low, high = (bound[:count] for bound in self.box)
        room = np.where(forces > 0, high - w, w - low)
        gap = (rows - self.rows[0])[kinds == "obstacles"]
        push = values[kinds == "obstacles"]
        pushed = forces != 0
        return {
            "stationarity": np.abs(slope[:count] + forces).max(),
            "defect": np.abs(rows[kinds == "dynamics"]).max(),
            "violation": max(0.0, (low - w).max(), (w - high).max(), -gap.min(initial=0.0)),
            "sign": push.max(initial=0.0),
            "complementarity": max(
                np.abs(push * gap).max(initial=0.0),
                np.abs(forces[pushed] * room[pushed]).max(initial=0.0),
            ),
        }

    def normals(self, positions: FloatArray) -> FloatArray:
        """Outward normals (M, N, d) at positions (N, d), by search in ever smaller caps."""
        rng = np.random.default_rng(0)
        means = np.array([obstacle.means[1:] for obstacle in self.obstacles])
        Sigma = np.array([obstacle.covariances[1:] for obstacle in self.obstacles])
        delta = (positions - means)[:, :, None]
        n, width = np.ones((*delta.shape[:2], 1, self.dim)), 1e3
        for _ in range(40):
            tries = n + width * rng.normal(size=(*delta.shape[:2], 100, self.dim))
            tries[:, :, :1] = n
            tries /= np.linalg.norm(tries, axis=-1, keepdims=True)
            spread = np.sqrt(np.einsum("mnki,mnij,mnkj->mnk", tries, Sigma, tries))
            best = np.argmax((tries * delta).sum(-1) - self.size * spread, axis=-1)
            n = np.take_along_axis(tries, best[:, :, None, None], axis=2)
            width = 0.5 * min(width, 1.0)
        return n[:, :, 0]

    def _sides(self, positions: FloatArray) -> FloatArray:
        if not self.obstacles:
            return np.zeros(0)
        n = self.normals(positions)
        return np.arctan2(n[..., 1], n[..., 0]).ravel() if self.dim == 2 else n.ravel()


def _arc(x: Any, u: Any, dt: float) -> Any:
    """The unicycle by quadrature: exact to rounding while it turns by less than about 3 rad."""
    nodes, weights = np.polynomial.legendre.leggauss(14)
    p1, p2, theta, v = casadi.vertsplit(x)
    a, omega = casadi.vertsplit(u)
    for node, weight in zip(0.5 * dt * (nodes + 1), 0.5 * dt * weights, strict=True):
        p1 += weight * (v + a * node) * casadi.cos(theta + omega * node)
        p2 += weight * (v + a * node) * casadi.sin(theta + omega * node)
    return casadi.vertcat(p1, p2, theta + dt * omega, v + dt * a)


def _classical(rates: Any, x: Any, dt: float, substeps: int) -> Any:
    h = dt / substeps
    for _ in range(substeps):
        k1 = rates(x)
        k2 = rates(x + h / 2 * k1)
        k3 = rates(x + h / 2 * k2)
        k4 = rates(x + h * k3)
        x = x + h / 6 * k1 + h / 3 * k2 + h / 3 * k3 + h / 6 * k4
    return x


def _bicycle(model: Any, x: Any, u: Any) -> Any:
    """Through the slip angle of the reference point, unlike the package."""
    slip = casadi.atan(model.rear / model.wheelbase * casadi.tan(x[4]))
    speed = x[3] / casadi.cos(slip)
    return casadi.vertcat(
        speed * casadi.cos(x[2] + slip),
        speed * casadi.sin(x[2] + slip),
        x[3] * casadi.tan(x[4]) / model.wheelbase,
        u[0],
        u[1],
    )


def _planar(model: Any, x: Any, u: Any) -> Any:
    thrust = u[0] * casadi.vertcat(casadi.sin(x[2]), casadi.cos(x[2]))
    return casadi.vertcat(x[3], x[4], x[5], thrust - casadi.DM([0.0, model.gravity]), u[1])


def _space(model: Any, x: Any, u: Any) -> Any:
    """By rotation matrices, and the Euler rates from the inverse of their map to body rates."""
    roll, pitch, yaw = x[6], x[7], x[8]
    c, s = casadi.cos, casadi.sin
    about_x = casadi.vertcat(
        casadi.horzcat(1, 0, 0),
        casadi.horzcat(0, c(roll), -s(roll)),
        casadi.horzcat(0, s(roll), c(roll)),
    )
    about_y = casadi.vertcat(
        casadi.horzcat(c(pitch), 0, s(pitch)),
        casadi.horzcat(0, 1, 0),
        casadi.horzcat(-s(pitch), 0, c(pitch)),
    )
    about_z = casadi.vertcat(
        casadi.horzcat(c(yaw), -s(yaw), 0),
        casadi.horzcat(s(yaw), c(yaw), 0),
        casadi.horzcat(0, 0, 1),
    )
    axis = casadi.mtimes([about_z, about_y, about_x, casadi.DM([0.0, 0.0, 1.0])])
    body = casadi.horzcat(
        casadi.DM([1.0, 0.0, 0.0]),
        casadi.mtimes(about_x.T, casadi.DM([0.0, 1.0, 0.0])),
        casadi.mtimes([about_x.T, about_y.T, casadi.DM([0.0, 0.0, 1.0])]),
    )
    euler = casadi.mtimes(casadi.inv(body), u[1:])
    return casadi.vertcat(x[3:6], u[0] * axis - casadi.DM([0.0, 0.0, model.gravity]), euler)
