"""The referee: how far a plan is from meeting the original constraints, whoever made it."""

from collections.abc import Sequence

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.geometry.no_go import NoGoSets
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem


def largest_violation(
    problem: Problem,
    x0: FloatArray,
    obstacles: Sequence[ObstaclePrediction],
    states: FloatArray,
    inputs: FloatArray,
    s: FloatArray,
) -> float:
    """Return the largest violation of any constraint; 0 for none, infinity for NaN.

    It is the largest, each in its own unit, of |x_0 - x0|, the defects |x_{i+1} - f(x_i, u_i)|,
    what states, inputs, rates between intervals and sizes exceed their bounds by, and the depth [m]
    inside a no-go set at the plan's own s: -g of `scp_mpc.geometry.inflation`.

    Args:
        problem: Whose constraints.
        x0: (nx,) state now.
        obstacles: M predictions.
        states: (N+1, nx).
        inputs: (N, nu).
        s: (M,) sizes of the obstacles' ellipsoids.
    """
    model, margin = problem.model, problem.size
    reached = np.array([model.step(x, u) for x, u in zip(states[:-1], inputs, strict=True)])
    change = np.diff(inputs, axis=0)
    amounts = [
        np.abs(states[0] - x0),
        np.abs(states[1:] - reached),
        problem.u_min - inputs,
        inputs - problem.u_max,
        problem.excess(states),
        np.maximum(0.0, change - problem.du_max),
        np.maximum(0.0, problem.du_min - change),
        margin.lower - s,
        s - margin.upper,
    ]
    if obstacles:
        amounts.append(-clearances(problem, obstacles, states[:, model.position], s))
    worst = max(float(amount.max(initial=0.0)) for amount in amounts)
    finite = all(np.isfinite(amount).all() for amount in amounts)
    return worst if finite else np.inf


def clearances(
    problem: Problem,
    obstacles: Sequence[ObstaclePrediction],
    positions: FloatArray,
    s: FloatArray,
) -> FloatArray:
    """Return the constraint function g (M, N) [m] at positions (N+1, d), row 0 now."""
    sets = NoGoSets.from_predictions(
        obstacles, problem.robot_radius, len(obstacles), problem.horizon, problem.model.dim
    )
    start = positions[0] - np.stack([o.means[0] for o in obstacles])
    return problem.no_go.linearise(sets, positions[1:], s, start).value
