"""The referee's program with bounds of states and slack, at their prices, and bounds of rates."""

import casadi
import numpy as np
from instances import obstacle
from referee import Referee

INF = np.inf
OPTIONS = {
    "print_level": 0,
    "sb": "yes",
    "tol": 1e-10,
    "mu_init": 1e-7,
    "bound_push": 1e-8,
    "bound_relax_factor": 0.0,
    "max_iter": 3000,
}


class Bounded(Referee):
    """Over [X | U | s | theta | E | slack], E by how much each state is outside its bounds."""

    def __init__(self, problem, x0, x_ref, one, u_last) -> None:
        N, model = problem.horizon, problem.model
        super().__init__(problem, x0, x_ref, obstacle(N, (99.0, 99.0)) if one is None else one)
        X = casadi.reshape(self.z[: self.size_x], model.nx, N)
        U = casadi.reshape(self.z[self.size_x : self.size_x + self.size_u], model.nu, N)
        E, slack = casadi.SX.sym("E", model.nx, N), casadi.SX.sym("slack", N)
        change = U - casadi.horzcat(casadi.DM(u_last), U[:, :-1])
        rows = [
            (self.defects, 0.0, 0.0),
            (self.outside + slack, 0.0, INF),
            (X - E, -INF, problem.x_max),
            (X + E, problem.x_min, INF),
            (change, problem.du_min, problem.du_max),
        ]
        program = {
            "x": casadi.vertcat(self.z, self.theta, casadi.vec(E), slack),
            "p": self.parameters,
            "f": self.cost
            + problem.state_slack_weight * casadi.sum1(casadi.vec(E))
            + problem.slack_weight * casadi.sum1(slack),
            "g": casadi.vertcat(*(casadi.vec(row) for row, *_ in rows)),
        }
        self.rows = {
            name: np.concatenate(
                [np.broadcast_to(row[at], row[0].shape[::-1]).ravel() for row in rows]
            )
            for name, at in (("lbg", 1), ("ubg", 2))
        }
        quiet = {"print_time": False, "ipopt": OPTIONS}
        self.solver = casadi.nlpsol("bounded", "ipopt", program, quiet)

    def best(self, plan):
        """The optimum near a plan: states, and the cost with all that is paid for."""
        problem, N = self.problem, self.problem.horizon
        margin, there = problem.margin, len(plan.s) > 0
        s = plan.s[0] if there else margin.reference
        theta = self.angles(plan.X[1:, [0, 2]], s)
        slack = plan.slack[0] if there else np.zeros(N)
        start = plan.X[1:].ravel(), plan.U.ravel(), [s], theta, plan.x_slack.ravel(), slack
        lower, upper = [-INF] * self.size_x, [INF] * self.size_x
        paid = np.zeros(plan.x_slack.size + N)
        found = self.solver(
            p=self.p,
            x0=np.concatenate(start),
            lbx=np.concatenate([lower, np.tile(problem.u_min, N), [margin.lower], theta - 7, paid]),
            ubx=np.concatenate(
                [upper, np.tile(problem.u_max, N), [margin.upper], theta + 7, paid + INF]
            ),
            **self.rows,
        )
        assert self.solver.stats()["success"], self.solver.stats()["return_status"]
        return np.array(found["x"]).ravel()[: self.size_x].reshape(N, -1), float(found["f"])
