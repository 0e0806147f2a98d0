"""Braking: to rest, as hard as the bounds of the inputs allow, in the direction of motion.

Notation:
    k   control steps that it takes
"""

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.problem import Problem

AT_REST = 0.05  # [m/s] at which a robot counts as standing
_NO_INPUT = 1e-9  # of an input, in its own unit


def braking(
    problem: Problem, x: FloatArray, u_last: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return inputs (k, nu) that bring the robot to rest from x, k <= N, and states (k+1, nx).

    Args:
        problem: Whose bounds of inputs and rates hold.
        x: (nx,) state now.
        u_last: (nu,) input last applied, from which the first rate counts.
    """
    rest = resting_input(problem)
    inputs, states = list[FloatArray](), [x]
    for _ in range(problem.horizon):
        stop = _stop(problem, states[-1], rest)
        u_last = problem.limited((rest if stop is None else stop)[None], u_last)[0]
        if stop is None and np.array_equal(u_last, rest):
            break
        inputs.append(u_last)
        states.append(problem.model.step(states[-1], u_last))
    return np.array(inputs).reshape(-1, problem.model.nu), np.array(states)


def resting_input(problem: Problem) -> FloatArray:
    """Input (nu,) of a robot at rest."""
    return np.clip(problem.model.equilibrium_input, problem.u_min, problem.u_max)


def stands(problem: Problem, states: FloatArray, x_ref: FloatArray) -> bool:
    """Whether a plan (N+1, nx) hardly moves, and not because it is where its reference is."""
    at = problem.model.position
    away, wanted = (float(np.abs(x[1:, at] - states[0, at]).max()) for x in (states, x_ref))
    return away < AT_REST * problem.model.dt * problem.horizon < wanted


def _stop(problem: Problem, x: FloatArray, rest: FloatArray) -> FloatArray | None:
    """The input (nu,) that stops the robot, as far as the bounds allow; None at rest."""
    wanted = problem.model.stopping_input(x) - rest
    if not float(np.abs(wanted).max()) > _NO_INPUT:  # or NaN
        return None
    # In the direction of what is wanted; inputs without any room stay where they are.
    room = np.where(wanted > 0, problem.u_max - rest, problem.u_min - rest)
    none = np.abs(room) <= _NO_INPUT
    wanted, room = np.where(none, 0.0, wanted), np.where(none, 1.0, room)
    stop: FloatArray = rest + wanted / max(1.0, float((wanted / room).max()))
    return stop
