"""Rest and motion of any model by least squares, where nobody says how it stops or moves.

Notation:
    d(x, u)     p(f(x, u)) - p(x), the way in one interval
"""

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.models.model import Model, courses

_ROUNDS = 5
_CUT = 1e-9
_SETTLED = 1e-9  # relative change of an input that is none


def coasting_stop(model: Model, x: FloatArray) -> FloatArray:
    """Return the input (nu,) after which the coasting model's next way is as short as can be.

    Minimises |d(f(x, u), u_eq)| over u by Gauss-Newton steps of least norm, u_eq the equilibrium
    input. A robot whose input does not reach its speed within one interval needs a function of
    its own.
    """
    u = model.equilibrium_input.copy()
    for _ in range(_ROUNDS):
        first = model.linearise(x, u)
        then = model.linearise(first.after, model.equilibrium_input)
        way = (then.after - first.after)[model.position]
        by_u = (then.A - np.eye(model.nx))[model.position] @ first.B
        if not (np.isfinite(way).all() and np.isfinite(by_u).all()):
            return model.equilibrium_input.copy()  # LAPACK would print
        change = np.linalg.lstsq(by_u, way, rcond=_CUT)[0]
        u -= change
        if np.abs(change).max() <= _SETTLED * max(1.0, np.abs(u).max()):
            break
    return u


def coasting_state(model: Model, position: FloatArray, velocity: FloatArray) -> FloatArray:
    """Return states (..., nx) there from which the coasting model's way is dt times the velocity.

    Entries but the position, and the heading, which looks along the velocity, are the smallest
    that will do, by Gauss-Newton steps of least norm.
    """
    x = np.zeros((*np.shape(position)[:-1], model.nx))
    x[..., model.position] = position
    fixed = set(model.position.tolist())
    if model.heading is not None:
        x[..., model.heading] = courses(velocity)
        fixed.add(model.heading)
    free = [i for i in range(model.nx) if i not in fixed]
    for _ in range(_ROUNDS):
        there = model.linearise(x, model.equilibrium_input)
        missing = model.dt * np.asarray(velocity) - (there.after - x)[..., model.position]
        by_x = (there.A - np.eye(model.nx))[..., model.position, :][..., free]
        x[..., free] += (np.linalg.pinv(by_x, rcond=_CUT) @ missing[..., None])[..., 0]
    return x
