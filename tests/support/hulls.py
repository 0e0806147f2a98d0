"""Slow, obvious distances to polytopes and the way a robot really goes, for tests of plans."""

import casadi
import numpy as np


def distance(vertices, y) -> float:
    """Signed distance of one point to the hull of some corners, by search over directions.

    n'y - max_v n'v over a fine grid, refined: a poor search makes it smaller, never larger.
    """
    y, dim = np.asarray(y), vertices.shape[1]
    if dim == 2:
        angle = np.linspace(0, 2 * np.pi, 721)
        n = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:
        k = np.arange(4000) + 0.5
        z, angle = 1 - k / 2000, np.pi * (1 + 5**0.5) * k
        n = np.stack([np.cos(angle), np.sin(angle)], axis=1) * np.sqrt(1 - z * z)[:, None]
        n = np.concatenate([n, z[:, None]], axis=1)
    width = 0.02 if dim == 2 else 0.1
    rng = np.random.default_rng(0)
    best, value = n[0], -np.inf
    for _ in range(14):
        values = n @ y - (n @ vertices.T).max(axis=1)
        if values.max() > value:
            best, value = n[values.argmax()], values.max()
        n = best + width * rng.normal(size=(400, dim))
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        width /= 3
    return float(value)


def way(problem, plan, pieces=8) -> np.ndarray:
    """Positions (N pieces + 1, d) along the plan, its inputs held: times i / pieces."""
    model = problem.model
    path = [plan.X[0, model.position]]
    for x, u in zip(plan.X[:-1], plan.U, strict=True):
        for k in range(1, pieces + 1):
            t, p, v = model.dt * k / pieces, x[model.position], x[model.position + 1]
            path.append(p + t * v + t * t / 2 * u)
    return np.array(path)


def clearance(problem, plan, obstacles, pieces=8) -> float:
    """Smallest distance between robot and still polytopes along the plan, also between samples."""
    path = way(problem, plan, pieces)
    return min(
        distance(o.shape.vertices, p - o.means[0]) - o.radius - problem.robot_radius
        for o in obstacles
        for p in path
    )


def polished(problem, x0, x_ref, obstacles, plan) -> float:
    """The cost that IPOPT makes of a plan among polytopes, which may be uncertain and move.

    Outside means that some plane separates: in the dual form of Zhang, Liniger and Borrelli (2018)

        (A (p - mu) - b)' lam >= s sigma + r,    |A' lam| <= 1,    lam >= 0

    so lam joins the variables; A, b from scipy's own hull.
    """
    from scipy.spatial import ConvexHull

    N, model = problem.horizon, problem.model
    X, U = casadi.SX.sym("X", model.nx, N), casadi.SX.sym("U", model.nu, N)
    cost, equal, above, lams, start = 0, [], [], [], []
    previous = casadi.DM(x0)
    for i in range(N):
        error = X[:, i] - casadi.DM(x_ref[i + 1])
        Q = problem.Q if i + 1 < N else problem.Qf
        cost += error.T @ casadi.DM(Q) @ error + U[:, i].T @ casadi.DM(problem.R) @ U[:, i]
        equal.append(X[:, i] - model.A @ previous - model.B @ U[:, i])
        previous = X[:, i]
        for j, o in enumerate(obstacles):
            planes = ConvexHull(o.shape.vertices).equations
            lam = casadi.SX.sym(f"lam{i}{j}", len(planes))
            y = X[model.position.tolist(), i] - casadi.DM(o.means[i + 1])
            A, b = casadi.DM(planes[:, :-1]), casadi.DM(-planes[:, -1])
            sigma = np.sqrt(np.linalg.eigvalsh(o.covariances[i + 1])[-1])
            reach = plan.s[j] * sigma + o.radius + problem.robot_radius
            above += [(A @ y - b).T @ lam - reach, 1 - casadi.sumsqr(A.T @ lam)]
            lams.append(lam)
            start.append(_multipliers(planes, plan.X[i + 1, model.position] - o.means[i + 1]))
    lam, first = casadi.vertcat(*lams), np.concatenate(start)
    options = {
        "print_time": False,
        "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-9, "max_iter": 500, "mu_init": 1e-6},
    }
    g = casadi.vertcat(*equal, *above)
    nlp = {"x": casadi.vertcat(casadi.vec(X), casadi.vec(U), lam), "f": cost, "g": g}
    solver = casadi.nlpsol("ipopt", "ipopt", nlp, options)
    free, count = np.full(N * model.nx, np.inf), len(above)
    result = solver(
        x0=np.concatenate([plan.X[1:].ravel(), plan.U.ravel(), first]),
        lbx=np.concatenate([-free, np.tile(problem.u_min, N), np.zeros(len(first))]),
        ubx=np.concatenate([free, np.tile(problem.u_max, N), np.full(len(first), np.inf)]),
        lbg=np.zeros(len(free) + count),
        ubg=np.concatenate([np.zeros(len(free)), np.full(count, np.inf)]),
    )
    assert solver.stats()["success"]
    return float(result["f"])


def _multipliers(planes, y) -> np.ndarray:
    """lam with A' lam = n, the direction from the nearest point: a small program of its own."""
    from scipy.optimize import minimize

    A, b = planes[:, :-1], -planes[:, -1]
    found = minimize(
        lambda lam: -(A @ y - b) @ lam,
        np.full(len(b), 0.1),
        bounds=[(0, None)] * len(b),
        constraints={"type": "ineq", "fun": lambda lam: 1 - ((A.T @ lam) ** 2).sum()},
        method="SLSQP",
    )
    return found.x
