"""Condensing: the dynamics eliminated, in coordinates in which the cost is a circle.

Constraints act on the outputs y of a plan only (`layout.py`). Every plan that obeys the dynamics,
linearised about the present plan where they are nonlinear, is

    y = y_free + S v,        cost = least + |v|^2 / 2

where y_free is the plan that nothing constrains, and v are its inputs (and sizes). With Hessian
H = 2 (R + G'QG) = L L' and gradient g at the present plan, u = u_free + L^-T v, and the present
plan is at v = L^-1 g. A linear robot is the case where G, L and S stay: they are computed once.

Plans are always rolled out, so that there are no defects. Rolling out is Newton's method on all
stages at once, x <- x + D^-1 (f(x, u) - x_next), which for a linear robot takes one step.

Notation:
    e       (N, nx)     deviations x_i - xref_i, i = 1 .. N
    nu      (N, nx)     multipliers of the dynamics
    A, B    derivatives of x_{i+1} with respect to x_i and u_i
    D       block bidiagonal, unit diagonal, -A below:  D e = B u + drift
    G       (N, nx, N nu)   responses of e to the inputs
    C_k, D_k    derivatives of a position between two samples with respect to x_i and u_i
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg.lapack import dpotrf, dpotrs, dtbtrs, dtrtri

from scp_mpc.arrays import FloatArray
from scp_mpc.models.linear import LinearModel
from scp_mpc.problem import Problem
from scp_mpc.scp.layout import Layout
from scp_mpc.scp.nodes import Nodes
from scp_mpc.scp.step import Step

_CLOSED = 1e-12  # defect that is none
_ROUNDINGS = 4 * 2.0**-52  # likewise, of the largest state
_RIDGES = (1e-14, 1e-12, 1e-10)  # of the Hessian, relative to its largest diagonal entry
_ROUNDS = 4  # of Newton's method, before stages are walked through one by one


@dataclass(frozen=True, eq=False)
class Derivatives:
    """The dynamics about a plan: what its inputs do, and what forces on it mean for them.

    Attributes:
        A: (N, nx, nx) at stages 0 .. N-1; the first is never asked for.
        B: (N, nx, nu).
        between: C (N, m, nx) and D (N, m, nu) of all coordinates between the samples; None for
            none.
        at: (N, n d, nx) derivatives of the coordinates at the samples.
    """

    A: FloatArray
    B: FloatArray
    between: tuple[FloatArray, FloatArray] | None
    at: FloatArray

    @cached_property
    def _band(self) -> FloatArray:
        """D in LAPACK's storage of a banded lower triangle (2 nx, N nx), in Fortran's order."""
        N, nx, _ = self.A.shape
        band = np.zeros((2 * nx, N * nx), order="F")
        band[0] = 1.0
        i = np.arange(N - 1)[:, None, None]
        below = nx + np.arange(nx)[:, None] - np.arange(nx)
        places = below + (i * nx + np.arange(nx)) * 2 * nx
        band.reshape(-1, order="F")[places.ravel()] = -self.A[1:].ravel()
        return band

    def roll(self, pushed: FloatArray) -> FloatArray:
        """Solve D e = pushed (N, nx) for e (N, nx): forwards in time."""
        e: FloatArray = dtbtrs(self._band, pushed.reshape(-1, 1), uplo="L", diag="U")[0]
        return e.reshape(pushed.shape)

    def costates(self, forces: FloatArray) -> FloatArray:
        """Solve D' nu = forces (N, nx) for nu (N, nx): backwards in time."""
        nu: FloatArray = dtbtrs(self._band, forces.reshape(-1, 1), uplo="L", trans="T", diag="U")[0]
        return nu.reshape(forces.shape)

    def thrust(self, nu: FloatArray) -> FloatArray:
        """B' nu (N, nu): what multipliers mean for the inputs."""
        thrust: FloatArray = (nu[:, None] @ self.B)[:, 0]
        return thrust

    def pull(self, phi: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """What forces phi (C d,) on the positions do: (N, nx) on e, (N, nu) on u, or None."""
        forces = phi.reshape(len(self.A), 1, -1)
        inner = forces.shape[2] - self.at.shape[1]
        on_e = (forces[:, :, inner:] @ self.at)[:, 0]
        if self.between is None:
            return on_e, None
        C, D = self.between
        on_e[:-1] += (forces[1:, :, :inner] @ C[1:])[:, 0]
        return on_e, (forces[:, :, :inner] @ D)[:, 0]

    def moved(self, e: FloatArray, inputs: FloatArray) -> FloatArray:
        """Coordinates (C d, k) that go with e (N, nx, k) and inputs (N, nu, k), to first order."""
        samples: FloatArray = self.at @ e
        if self.between is not None:
            C, D = self.between
            inner = D @ inputs
            inner[1:] += C[1:] @ e[:-1]
            samples = np.concatenate([inner, samples], axis=1)
        return samples.reshape(-1, samples.shape[2])

    @cached_property
    def response(self) -> FloatArray:
        """G (N, nx, N nu). Stage by stage: each needs the one before."""
        N, nx, nu = self.B.shape
        G = np.zeros((N, nx, N, nu))
        G[np.arange(N), :, np.arange(N)] = self.B
        flat = G.reshape(N, nx, N * nu)
        for i in range(1, N):
            flat[i, :, : i * nu] = self.A[i].dot(flat[i - 1, :, : i * nu])
        return flat


@dataclass(frozen=True, eq=False)
class Rollout:
    """A plan that obeys the dynamics.

    Attributes:
        inputs: (N, nu) u.
        deviations: (N, nx) e.
        positions: (C, d) p, relative to where the robot is now.
        along: Derivatives about it.
    """

    inputs: FloatArray
    deviations: FloatArray
    positions: FloatArray
    along: Derivatives


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """How the outputs answer to v, along some derivatives.

    Attributes:
        G: (N, nx, N nu) responses of e to the inputs.
        weighed: (N nx, N nu) 2 Q G.
        inverse: (N nu, N nu) L^-1.
        S: (ny, nv) responses of the outputs.
        bounded: (nf, nv) those of the bounded entries, in C's order.
        unbox: (nv, nv) v in terms of sizes and inputs.
    """

    G: FloatArray
    weighed: FloatArray
    inverse: FloatArray
    S: FloatArray
    bounded: FloatArray
    unbox: FloatArray


@dataclass(frozen=True, eq=False)
class Condensed:
    """The condensed problem of one control step, about one plan.

    Attributes:
        about: The plan.
        y_free: (ny,) outputs of the plan that nothing constrains.
        here: (nv,) where the plan itself is.
        least: Cost of the plan that nothing constrains: any other costs |v|^2 / 2 more.
        by: How the outputs answer to v.
    """

    about: Rollout
    y_free: FloatArray
    here: FloatArray
    least: float
    by: Sensitivity

    def y(self, v: FloatArray) -> FloatArray:
        """Outputs (ny,) of v (nv,)."""
        return self.y_free + self.by.S @ v

    def deviations(self, v: FloatArray) -> FloatArray:
        """Deviations e (N, nx) of v (nv,), to first order."""
        inputs = self.by.inverse.T @ (v - self.here)[: len(self.by.inverse)]
        e: FloatArray = self.about.deviations + self.by.G @ inputs
        return e


class Condenser:
    """Rolls plans of a problem out, and condenses the problem about them.

    Args:
        problem: The problem.
        nodes: Where its plans are constrained.
        layout: What y holds.
    """

    def __init__(self, problem: Problem, nodes: Nodes, layout: Layout) -> None:
        """Condense the problem of a linear robot once and for all."""
        self._problem, self._model, self._nodes, self._layout = (
            problem,
            problem.model,
            nodes,
            layout,
        )
        N = layout.shape[0]
        self._effort = np.kron(np.eye(N), 2 * problem.R)
        self.linear = isinstance(problem.model, LinearModel)
        if isinstance(problem.model, LinearModel):
            A, B = (np.repeat(M[None], N, axis=0) for M in (problem.model.A, problem.model.B))
            rest = np.zeros((N + 1, problem.model.nx)), np.zeros((N, problem.model.nu))
            self._always = Derivatives(A, B, *nodes.derivatives(*rest)[1:])
            self._sensitivity = self._sensitivity_along(self._always)

    def begin(self, step: Step) -> None:
        """Read a control step."""
        self._step = step
        if self.linear:
            A = self._always.A[0]
            self._drift = step.x_ref[:-1] @ A.T - step.x_ref[1:]
            self._drift[0] = A @ step.x0 - step.x_ref[1]

    def rolled(self, inputs: FloatArray, guess: FloatArray | None = None) -> Rollout:
        """Roll inputs (N, nu) out from the state now; `guess` (N, nx) of the deviations."""
        step, states = self._step, self._step.x_ref.copy()
        states[0] = step.x0
        if self.linear:
            e = self._always.roll(inputs @ self._always.B[0].T + self._drift)
            states[1:] += e
            positions = self._nodes.positions(states, inputs)
            return Rollout(inputs, e, positions - step.here, self._always)
        along = None
        if guess is not None:
            states[1:] += guess
            along = self._closed(states, inputs)
        if along is None:
            for i, u in enumerate(inputs):
                states[i + 1] = self._model.step(states[i], u)
            along = self._linearised(states, inputs)[:2]
        positions, between, at = self._nodes.derivatives(states, inputs)
        derivatives = Derivatives(*along, between, at)
        return Rollout(inputs, states[1:] - step.x_ref[1:], positions - step.here, derivatives)

    def tracking(self, states: FloatArray, inputs: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Inputs (N, nu) that lead from the state now back to a plan, and deviations (N, nx).

        The plan is the reference of a problem without obstacles and bounds, linearised about it:
        what a controller with feedback would do. Open loop, a small error now grows over the
        horizon.

        Args:
            states: (N+1, nx) of the plan, whose first need not be the state now.
            inputs: (N, nu) of the plan.
        """
        problem, none = self._problem, np.zeros((len(inputs), 0, states.shape[1]))
        A, B, after = self._linearised(states, inputs)
        along, drift = Derivatives(A, B, None, none), after - states[1:]
        drift[0] += A[0] @ (self._step.x0 - states[0])
        e, G = along.roll(drift), along.response
        weighed = 2 * problem.Q @ G
        weighed[-1] = 2 * problem.Qf @ G[-1]
        flat, weighed = (part.reshape(-1, inputs.size) for part in (G, weighed))
        L = _factor(flat.T @ weighed + self._effort)
        change, _ = dpotrs(L, -(e.ravel() @ weighed), lower=1)
        states = states[1:] + e + (flat @ change).reshape(e.shape)
        return inputs + change.reshape(inputs.shape), states - self._step.x_ref[1:]

    def condensed(self, rollout: Rollout, s: FloatArray) -> Condensed:
        """Condense about a plan with sizes s (M,).

        Raises:
            numpy.linalg.LinAlgError: The derivatives there are no numbers.
        """
        problem, layout = self._problem, self._layout
        e, u = rollout.deviations, rollout.inputs
        by = self._sensitivity if self.linear else self._sensitivity_along(rollout.along)
        push = u - problem.model.equilibrium_input
        effort, away = push @ problem.R, s - problem.size.reference
        gradient = 2 * effort.ravel() + e.ravel() @ by.weighed
        here = by.inverse @ gradient
        if layout.moving:
            here = np.concatenate([here, layout.stiffness * away])
        track = np.vdot(e[:-1] @ problem.Q, e[:-1]) + e[-1] @ problem.Qf @ e[-1]
        cost = track + np.vdot(effort, push) + problem.size.weight * (away @ away)
        y = layout.outputs(self._step, rollout.positions, s, u, e)
        least = float(cost) - float(here @ here) / 2
        return Condensed(rollout, y - by.S @ here, here, least, by)

    def _sensitivity_along(self, along: Derivatives) -> Sensitivity:
        problem, layout = self._problem, self._layout
        (N, nu), G = layout.shape, along.response
        inputs, moving = N * nu, layout.moving
        weighed = 2 * problem.Q @ G
        weighed[-1] = 2 * problem.Qf @ G[-1]
        flat, weighed = G.reshape(-1, inputs), weighed.reshape(-1, inputs)
        L = _factor(flat.T @ weighed + self._effort)
        inverse, _ = dtrtri(L, lower=1)
        back = np.ascontiguousarray(inverse.T)
        bounded = (problem.state_rows @ G).reshape(-1, inputs) @ back
        moved = along.moved(G, np.eye(inputs).reshape(N, nu, inputs))
        S = layout.response(moved @ back, back, bounded)
        unbox = np.zeros((layout.variables, layout.variables))  # columns: sizes first, as in y
        unbox[:inputs, moving:] = L.T
        unbox[inputs:, :moving] = layout.stiffness * np.eye(moving)
        return Sensitivity(
            G, weighed, np.ascontiguousarray(inverse), S, S[layout.boxed].copy(), unbox
        )

    def _linearised(
        self, states: FloatArray, inputs: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """A, B along states (N+1, nx), and the states they lead to."""
        linear = self._model.linearise(states[:-1], inputs)
        return linear.A, linear.B, linear.after

    def _closed(
        self, states: FloatArray, inputs: FloatArray
    ) -> tuple[FloatArray, FloatArray] | None:
        """Close the defects of states (N+1, nx) in place; None where that does not succeed."""
        before = np.inf
        none = np.zeros((len(inputs), 0, states.shape[1]))
        for _ in range(_ROUNDS):
            A, B, after = self._linearised(states, inputs)
            defect = after - states[1:]
            worst = float(np.abs(defect).max())
            if worst <= _CLOSED + _ROUNDINGS * float(np.abs(states).max()):
                return A, B
            if not worst < before:  # or NaN
                return None
            before = worst
            states[1:] += Derivatives(A, B, None, none).roll(defect)
        return None


def _factor(H: FloatArray) -> FloatArray:
    """Lower Cholesky factor of a Hessian; with a ridge where rounding ate what is definite."""
    scale = float(H.diagonal().max())
    for ridge in (0.0, *_RIDGES):
        if ridge:
            H.flat[:: len(H) + 1] += ridge * scale
        L, info = dpotrf(H, lower=1, clean=1)
        if info == 0:
            return L
    raise np.linalg.LinAlgError("the Hessian is not positive definite")
