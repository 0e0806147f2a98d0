"""Anderson acceleration of depth one for the linearisation point.

Each subproblem maps a linearisation point v to its solution g, and the plain sequence v <- g
converges linearly. Two pairs (v, g) with residuals f = g - v tell how fast, and

    v <- g - gamma (g - g_before),    gamma = f'(f - f_before) / |f - f_before|^2

is where the residual would vanish if it kept shrinking along its line (Anderson, 1965; Walker and
Ni, 2011). With the exact inflation every point gives sound half-spaces: boldness costs no safety.

Notation:
    v, g    (K,)    linearisation point and solution: positions and sizes, flattened
    f       (K,)    residual g - v
"""

from dataclasses import replace

import numpy as np

from scp_mpc.arrays import FloatArray, IntArray
from scp_mpc.solver.iterate import Iterate


class Anderson:
    """Where to linearise next, given where the last linearisations led.

    Args:
        nominal: The first linearisation point.
        position: (d,) indices of the position within the state.
    """

    def __init__(self, nominal: Iterate, position: IntArray) -> None:
        """Start at the nominal plan, with nothing learnt."""
        self._position = position
        self._about = self._flat(nominal)
        self._last: tuple[FloatArray, FloatArray] | None = None  # g and f
        self._next: FloatArray | None = None

    def learn(self, iterate: Iterate) -> None:
        """Take in the solution to which the last linearisation point led."""
        g = self._flat(iterate)
        f = g - self._about
        self._next = None
        if self._last is not None:
            g_before, f_before = self._last
            change = f - f_before
            # A residual that grows is not in its linear regime yet.
            if f @ f < f_before @ f_before:
                self._next = g - (f @ change) / (change @ change) * (g - g_before)
        self._last, self._about = (g, f), g

    def propose(self, iterate: Iterate) -> Iterate | None:
        """Return the iterate moved to the next linearisation point; None for where it is."""
        if self._next is None:
            return None
        self._about = self._next
        states, sizes = iterate.states.copy(), len(iterate.s)
        positions = self._next[: len(self._next) - sizes]
        states[1:, self._position] = positions.reshape(-1, len(self._position))
        s = np.maximum(self._next[len(self._next) - sizes :], 0.0)
        return replace(iterate, states=states, s=s)

    def reject(self) -> None:
        """Return to the last solution and forget: the proposal did not help."""
        if self._last is not None:
            self._about = self._last[0]
        self._last = self._next = None

    def _flat(self, iterate: Iterate) -> FloatArray:
        return np.concatenate([iterate.states[1:, self._position].ravel(), iterate.s])
