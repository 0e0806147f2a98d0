"""Worlds for any robot, and a judge of plans in them that knows only the model's flow.

Bounds, rates and states are compared as numbers; distances to balls, ellipsoids and boxes come by
brute force, at the samples and at 24 instants in each interval.
"""

from dataclasses import dataclass

import numpy as np
from judge import exact_distances

from scp_mpc import DoubleIntegrator, JointRisk, Margin, ObstaclePrediction, Problem
from scp_mpc.models import FunctionModel, KinematicBicycle, PlanarQuadrotor, Quadrotor, Unicycle
from scp_mpc.obstacles import Polytope

DT = 0.2
_FINE = 24
_TOLERANCE = 2e-6  # [m], twice the settings' default


def _rates(x, u):
    theta, v = x[..., 2], x[..., 3]
    parts = (v * np.cos(theta), v * np.sin(theta), u[..., 1], u[..., 0])
    return np.stack(parts, axis=-1)


def _robot(model):
    """Model, half the range of its inputs, index of a state to bound."""
    return {
        "double": (DoubleIntegrator(DT), [3.0, 3.0], 1),
        "unicycle": (Unicycle(DT), [3.0, 2.0], 3),
        "bicycle": (KinematicBicycle(DT, 1.0), [3.0, 1.0], 3),
        "planar": (PlanarQuadrotor(DT, substeps=2), [4.0, 3.0], 2),
        "quadrotor": (Quadrotor(DT, substeps=2), [4.0, 2.0, 2.0, 2.0], 1),
        "function": (
            FunctionModel(
                _rates, "complex", nx=4, nu=2, dt=DT, position=[0, 1], heading=2, vectorised=True
            ),
            [3.0, 2.0],
            3,
        ),
    }[model]


ROBOTS = ("double", "unicycle", "bicycle", "planar", "quadrotor", "function")


@dataclass(frozen=True)
class Box:
    """An upright box as the judge knows it."""

    half: np.ndarray


def world(robot, seed, horizon=8, most=4):
    """A problem and a state; `scene` then draws what is in the way."""
    rng = np.random.default_rng([ROBOTS.index(robot), seed])
    model, half, bounded = _robot(robot)
    half = np.array(half)
    changes = {}
    if rng.random() < 0.5:
        changes["x_max"] = np.full(model.nx, np.inf)
        changes["x_max"][bounded] = rng.uniform(0.2, 1.5)
        changes["x_min"] = -changes["x_max"]
    if rng.random() < 0.5:
        changes["du_max"], changes["du_min"] = half * rng.uniform(0.2, 1), -half * rng.uniform(0, 1)
    if model.heading is not None and rng.random() < 0.4:
        changes["discs"] = [-0.25, 0.0, 0.25]
    if rng.random() < 0.25:
        changes["margin"] = JointRisk(0.05, allocation=str(rng.choice(["uniform", "iterative"])))
    elif rng.random() < 0.3:
        changes["margin"] = Margin(2.0, 0.5, 3.0)
    Q = np.full(model.nx, 0.05)
    Q[model.position] = 0.5
    problem = Problem(
        model,
        horizon=int(rng.choice([1, 2, horizon])),
        Q=Q,
        R=np.full(model.nu, 0.01),
        u_min=model.equilibrium_input - half,
        u_max=model.equilibrium_input + half,
        robot_radius=0.15,
        max_obstacles=most,
        nodes_per_interval=int(rng.choice([1, 4])),
        **changes,
    )
    return problem, rng


def start(problem, rng):
    """A state in motion at the origin."""
    x = 0.3 * rng.normal(size=problem.model.nx)
    way = np.zeros(problem.model.dim)
    way[0] = rng.uniform(0, 3)
    x += problem.model.state(np.zeros(problem.model.dim), way)
    return x


def scene(problem, rng, x):
    """Obstacles about a state: (prediction, box or None); and a goal."""
    N, dim = problem.horizon, problem.model.dim
    at, made = x[problem.model.position], []
    for _ in range(rng.integers(0, problem.max_obstacles + 1)):
        velocity = rng.normal(size=dim) * rng.choice([0.0, 1.0, 4.0])
        means = at + rng.choice([0.0, 0.6, 1.5, 1.5, 30.0]) * rng.normal(size=dim)
        means = means + DT * np.outer(np.arange(N + 1), velocity)
        root = rng.normal(size=(dim, dim)) * rng.choice([0.0, 0.02, 0.1])
        box = None
        if rng.random() < 0.4:
            box = Box(rng.choice([0.01, 0.3, 1.0, 20.0]) * rng.uniform(0.2, 1, dim))
            root = np.zeros((dim, dim)) if rng.random() < 0.7 else root
        shape = None if box is None else Polytope.box(2 * box.half)
        radius = float(rng.choice([0.0, 0.2, 0.5]))
        made.append((ObstaclePrediction(means, root @ root.T, radius, shape=shape), box))
    ahead = np.zeros(dim)
    ahead[0] = rng.uniform(0, 4)
    return made, problem.model.state(at + ahead, np.zeros(dim))


def complaints(problem, x0, made, plan, u_last):
    """What is not so, as sentences."""
    X, U, model = plan.X, plan.U, problem.model
    numbers = (X, U, plan.s, plan.slack, plan.x_slack, plan.cost)
    if not all(np.isfinite(v).all() for v in numbers):
        return ["not finite"]
    said = []
    if (problem.u_max + 1e-9 < U).any() or (problem.u_min - 1e-9 > U).any():
        said.append("an input is beyond its bounds")
    before = U[:1] if u_last is None else u_last[None]
    change = np.diff(np.concatenate([before, U]), axis=0)
    if (change > problem.du_max + 3e-9).any() or (change < problem.du_min - 3e-9).any():
        said.append(f"a rate is beyond its bounds: {change}")
    states = [x0]
    for u in U:
        states.append(model.step(states[-1], u))
    scale = max(1.0, float(np.abs(states).max()))
    if np.abs(X - states).max() > 1e-6 * scale:
        said.append(f"the dynamics are violated by {np.abs(X - states).max():.3g}")
    excess = np.maximum(0, np.maximum(X[1:] - problem.x_max, problem.x_min - X[1:]))
    if np.abs(excess - plan.x_slack).max() > 1e-9:
        said.append("x_slack is not the excess")
    if plan.ok and excess.max() > _TOLERANCE:
        said.append(f"{plan.status.name}, but a state is {excess.max():.3g} beyond its bounds")
    if plan.ok:
        worst = min((_nearest(problem, X, U, plan.s, *pair, j) for j, pair in enumerate(made)),
                    default=0.0)  # fmt: skip
        if worst < -_TOLERANCE:
            said.append(f"{plan.status.name}, but an obstacle is entered by {-worst:.3g} m")
    return said


def _nearest(problem, X, U, s, obstacle, box, j):
    """Smallest distance to a no-go set, at the samples or between them, too."""
    model, N = problem.model, problem.horizon
    share = (
        np.arange(_FINE + 1)[:, None] / _FINE if problem.nodes_per_interval > 1 else np.ones((1, 1))
    )
    states = model.advance(X[None, :-1], U[None], share)  # (F, N, nx)
    centres = states[..., None, model.position]
    if problem.model.heading is not None:
        theta = states[..., model.heading, None]
        nose = np.stack([np.cos(theta), np.sin(theta)], axis=-1)
        centres = centres + problem.discs[:, None] * nose
    means, f = obstacle.means, share[..., None]
    mu = np.broadcast_to(((1 - f) * means[:-1] + f * means[1:])[:, :, None], centres.shape)
    reach, size = problem.robot_radius + obstacle.radius, s[j]
    if size.ndim == 0:
        size = np.full(N, size)
    size = np.broadcast_to(size[None, :, None], centres.shape[:-1]).ravel()
    p, mu = centres.reshape(-1, model.dim), mu.reshape(-1, model.dim)
    Sigma = np.broadcast_to(obstacle.covariances[0], (len(p), model.dim, model.dim))
    if box is None:
        distance = _round(p, mu, Sigma, size, reach)
    else:
        spread = np.sqrt(max(0.0, float(np.linalg.eigvalsh(Sigma[0])[-1])))
        outside = np.abs(p - mu) - box.half
        depth = np.minimum(outside.max(axis=1), 0.0)
        distance = np.linalg.norm(np.maximum(outside, 0.0), axis=1) + depth
        distance -= reach + size * spread
    distance = distance.reshape(len(share), N, -1)
    # Stage 0 is given, not planned: after a start that is too near, the first gap is not kept.
    if len(share) > 1:
        relative = centres[:, 0] - mu.reshape(centres.shape)[:, 0]
        way = np.linalg.norm(np.diff(relative, axis=0), axis=-1).sum(axis=0).max()
        if distance[0, 0].min() < way:
            distance[:-1, 0] = np.inf
    return float(distance.min())


def _round(p, mu, Sigma, size, reach):
    """Exact only where it might be near: the search is slow."""
    apart = np.linalg.norm(p - mu, axis=1) - reach
    near = apart < size * np.sqrt(max(0.0, float(np.linalg.eigvalsh(Sigma[0])[-1])))
    if near.any() and Sigma.any():
        apart[near] = exact_distances(p[near], mu[near], Sigma[near], size[near], reach)
    return apart
