"""Where a nonlinear robot's search begins: the best of simple manoeuvres.

A local search ends in the next stationary point, and standing often is one: to first order it
brings nothing to turn towards a goal behind. So some plans are tried that hold one corner of the
inputs' bounds for a part of the horizon and another one after it: to turn and then to drive, to
reverse on a curve and to go forward, to climb and to hold.

Notation:
    W   manoeuvres
"""

from itertools import product

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.problem import Problem
from scp_mpc.scp.braking import resting_input
from scp_mpc.scp.step import Step

_SHARES = (0.25, 0.5, 0.75)  # of the horizon, before the second input
_MOST_COMBINED = 2  # inputs, above which only one at a time is off its rest


def manoeuvres(step: Step, most: int) -> FloatArray:
    """Return the inputs (most, N, nu) of those that cost least, no two of which begin alike.

    Where a manoeuvre would leave the bounds of states or speed, or go farther beyond them, inputs
    rest that lead there.
    """
    problem = step.problem
    N, corners = problem.horizon, _corners(problem)
    later = np.arange(N) >= np.round(np.array(_SHARES) * N)[:, None]  # (shares, N)
    pair = np.moveaxis(np.array(np.meshgrid(*[np.arange(len(corners))] * 2)), 0, -1)
    which = np.where(later[:, None, None], pair[..., None, 1], pair[..., None, 0]).reshape(-1, N)
    inputs = corners[which]
    states = _driven(problem, step.x0, inputs)
    error = states - step.x_ref[1:]
    cost = np.einsum("wkx,xy,wky->w", error[:, :-1], problem.Q, error[:, :-1])
    cost += np.einsum("wx,xy,wy->w", error[:, -1], problem.Qf, error[:, -1])
    push = inputs - problem.model.equilibrium_input
    cost += np.einsum("wku,uv,wkv->w", push, problem.R, push)
    order = np.argsort(np.where(np.isfinite(cost), cost, np.inf), kind="stable")
    _, first = np.unique(inputs[order, 0], axis=0, return_index=True)
    best: FloatArray = inputs[order[np.sort(first)[:most]]]
    return best


def _corners(problem: Problem) -> FloatArray:
    """Inputs (n, nu) at their bounds and at rest, in every combination if there are few."""
    rest = resting_input(problem)
    levels = np.stack([rest, problem.u_min, problem.u_max])
    nu = len(rest)
    if nu <= _MOST_COMBINED:
        return levels[np.array(list(product(range(3), repeat=nu))), np.arange(nu)]
    alone = np.where(np.eye(nu, dtype=np.bool_), levels[1:, None], rest).reshape(-1, nu)
    return np.concatenate([rest[None], alone])


def _driven(problem: Problem, x0: FloatArray, inputs: FloatArray) -> FloatArray:
    """States (W, N, nx) that inputs (W, N, nu) lead to; those that leave the bounds are changed."""
    model, rest = problem.model, resting_input(problem)
    E, (lower, upper) = problem.state_rows, problem.row_bounds

    def outside(x: FloatArray) -> FloatArray:
        rows = x @ E.T
        return np.maximum(0.0, np.maximum(lower - rows, rows - upper)).sum(axis=-1)

    states = np.empty((*inputs.shape[:2], model.nx))
    x = np.tile(x0, (len(inputs), 1))
    for k in range(problem.horizon):
        u = inputs[:, k]
        after = model.advance(x, u)
        if len(E) and (excess := outside(after)).any():
            wide = np.flatnonzero(excess)
            for i in range(model.nu):
                resting = u[wide]
                resting[:, i] = rest[i]
                tried = model.advance(x[wide], resting)
                less = outside(tried) < excess[wide]
                u[wide[less]], after[wide[less]] = resting[less], tried[less]
                excess[wide[less]] = outside(tried[less])
        states[:, k] = x = after
    return states
