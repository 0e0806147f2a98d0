"""Where everything stands that constraints act on: the outputs y of a plan.

Notation:
    y       [p_1 .. p_C | s_1 .. s_M | u_0 .. u_{N-1} | du_0 .. du_{N-1} | z_1 .. z_N]
    p       positions at all nodes, relative to the robot's position now
    du      changes u_i - u_{i-1} of the inputs; none where the problem does not limit them
    z       what is bounded of the states, E e with the rows E of `Problem.state_rows`; or none
    v       [inputs | sizes that move], in coordinates that make the Hessian the identity
"""

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.problem import Problem
from scp_mpc.scp.nodes import Nodes
from scp_mpc.scp.step import Braked, Step

_NONE = 1e30  # bounds that are none: finite, for the sake of what is computed with them


class Layout:
    """Slices of y, its bounds, and how it follows from inputs, sizes and deviations.

    Attributes:
        size: ny.
        p: Slice of the positions in y; likewise `s`, `u`, `du` and `z`.
        boxed: Slice of the entries of y that are bounded and can move.
        bounded: nf, how many these are.
        moving: Sizes that can move: M, or 0.
        variables: nv, inputs and moving sizes.
        shape: (N, nu) of the inputs.
        inputs: Of the boxed entries, the slice of the inputs.
        states: Of the boxed entries, the slice of what is bounded of the states: z.
        soft: Of the boxed entries, indices of those of z that yield where they must.
    """

    def __init__(self, problem: Problem, nodes: Nodes) -> None:
        """Count everything."""
        N, M, nu = problem.horizon, problem.max_obstacles, problem.model.nu
        self._problem, self._rows = problem, problem.state_rows
        self._rates = problem.limits_rates
        self.shape = N, nu
        # A size that cannot shrink never moves: larger ones only cost more and leave less room.
        self.moving = M if problem.size.lower < problem.size.reference else 0
        rates = N * nu if self._rates else 0
        sizes = [nodes.size * problem.model.dim, M, N * nu, rates, N * len(self._rows)]
        stops = np.cumsum(sizes).tolist()
        self.p, self.s, self.u, self.du, self.z = map(slice, [0, *stops[:-1]], stops)
        self.size = self.z.stop
        self.variables = N * nu + self.moving
        self.boxed = slice(self.s.start if self.moving else self.u.start, self.size)
        self.bounded = self.size - self.boxed.start
        self.states = slice(self.z.start - self.boxed.start, self.size - self.boxed.start)
        self.soft = self.states.start + np.flatnonzero(np.tile(problem.soft_rows, N))
        self.inputs = slice(self.u.start - self.boxed.start, self.u.stop - self.boxed.start)
        self._lower = self._bounds(-_NONE, problem.size.lower, problem.u_min, problem.du_min)
        self._upper = self._bounds(_NONE, problem.size.upper, problem.u_max, problem.du_max)

    def bounds(self, step: Step, braked: Braked = "none") -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds (ny,) of y in a control step; see `Step.row_bounds`."""
        if self.size == self.u.stop:
            return self._lower, self._upper
        lower, upper = self._lower.copy(), self._upper.copy()
        if self._rates:
            first = slice(self.du.start, self.du.start + self.shape[1])
            least, most = self._problem.reach(step.u_last)
            last = 0.0 if step.u_last is None else step.u_last
            lower[first] = np.maximum(least - last, -_NONE)
            upper[first] = np.minimum(most - last, _NONE)
        if len(self._rows):
            least, most = step.row_bounds(braked)
            reference = step.x_ref[1:] @ self._rows.T
            lower[self.z] = np.maximum(least - reference, -_NONE).ravel()
            upper[self.z] = np.minimum(most - reference, _NONE).ravel()
        return lower, upper

    def outputs(
        self, step: Step, p: FloatArray, s: FloatArray, u: FloatArray, e: FloatArray
    ) -> FloatArray:
        """Return y of positions p (C, d), sizes s (M,), inputs u (N, nu), deviations e (N, nx)."""
        parts = [p.ravel(), s, u.ravel()]
        if self._rates:
            last = np.zeros(self.shape[1]) if step.u_last is None else step.u_last
            parts.append((u - np.concatenate([last[None], u[:-1]])).ravel())
        if len(self._rows):
            parts.append((e @ self._rows.T).ravel())
        return np.concatenate(parts)

    def response(
        self, positions: FloatArray, inputs: FloatArray, bounded: FloatArray
    ) -> FloatArray:
        """Stack the responses (ny, nv) of y.

        Args:
            positions: (C d, N nu) of p to the inputs' coordinates.
            inputs: (N nu, N nu) of u.
            bounded: (N nb, N nu) of z.
        """
        N, nu = self.shape
        S = np.zeros((self.size, self.variables))
        S[self.p, : N * nu], S[self.u, : N * nu] = positions, inputs
        if self.moving:
            S[self.s, N * nu :] = np.eye(self.moving) / self.stiffness
        if self._rates:
            S[self.du, : N * nu] = inputs
            S[self.du.start + nu : self.du.stop, : N * nu] -= inputs[:-nu]
        S[self.z, : N * nu] = bounded
        return S

    @property
    def limits_states(self) -> bool:
        """Whether some states are bounded."""
        return len(self._rows) > 0

    @property
    def stiffness(self) -> float:
        """Root of a size's second derivative of the cost."""
        return float(np.sqrt(2 * self._problem.size.weight))

    def parted(self, forces: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Forces (nf,) on the boxed entries by kind: s (M,), u and du (N, nu), z (N, nb).

        Zeros for sizes that do not move; no rows for changes or states that are not bounded.
        """
        N, nu = self.shape
        s = np.zeros(self.s.stop - self.s.start)
        s[: self.moving] = forces[: self.moving]
        du = forces[self.inputs.stop : self.states.start]
        z = forces[self.states]
        empty = np.zeros((0, 0))
        return (
            s,
            forces[self.inputs].reshape(N, nu),
            du.reshape(N, nu) if len(du) else empty,
            z.reshape(N, -1) if len(z) else empty,
        )

    def gathered(self, s: FloatArray, u: FloatArray, du: FloatArray, z: FloatArray) -> FloatArray:
        """The inverse of `parted`; empty arrays stand for zeros."""
        forces = np.zeros(self.bounded)
        forces[: self.moving], forces[self.inputs] = s[: self.moving], u.ravel()
        if du.size:
            forces[self.inputs.stop : self.states.start] = du.ravel()
        if z.size:
            forces[self.states] = z.ravel()
        return forces

    def pushed(self, reaction: FloatArray) -> tuple[FloatArray | None, FloatArray]:
        """What forces (nf,) on the boxed entries do: (N, nx) on e, or None, and (N, nu) on u."""
        N, nu = self.shape
        on_u = reaction[self.inputs].reshape(N, nu)
        if self._rates:
            pull = reaction[self.inputs.stop : self.states.start].reshape(N, nu)
            on_u = on_u + pull
            on_u[:-1] -= pull[1:]
        if not len(self._rows):
            return None, on_u
        return reaction[self.states].reshape(N, -1) @ self._rows, on_u

    def _bounds(self, none: float, size: float, u: FloatArray, du: FloatArray) -> FloatArray:
        bounds = np.full(self.size, none)
        bounds[self.s], bounds[self.u] = size, np.tile(u, self.shape[0])
        if self._rates:
            bounds[self.du] = np.tile(np.clip(du, -_NONE, _NONE), self.shape[0])
        return bounds
