"""The condensed problem of a nonlinear robot: linearised and condensed anew about each plan.

A plan is always rolled out: its states are where its inputs lead, so that there are no defects.
Rolling out is Newton's method on all stages at once, x <- x + D^-1 (f(x, u) - x_next), for one
linearisation of all stages takes less time than walking through them one by one.

About the plan (u, e), with Hessian H = 2 (R + G'QG) = L L' and gradient g = 2 (R u + G'Q e), the
inputs in coordinates of the chart are u_free + L^-T v, and the plan itself is at v = L^-1 g.

Notation as in `chart.py` and `motion.py`.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg.lapack import dpotrf, dtrtri

from scp_mpc.arrays import FloatArray
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.problem import Problem
from scp_mpc.solver.chart import Chart, Condensation, Rolled
from scp_mpc.solver.layout import Layout
from scp_mpc.solver.motion import Bands, VaryingMotion
from scp_mpc.solver.sampling import NonlinearSampling
from scp_mpc.solver.step_data import StepData

_CLOSED = 1e-12  # defect that is none, relative to the largest state
_RIDGES = (1e-14, 1e-12, 1e-10)  # of the Hessian, relative to its largest diagonal entry
_ROUNDS = 4  # of Newton's method, before stages are walked through one by one


@dataclass(frozen=True, eq=False)
class VaryingChart(Chart):
    """A chart about one plan.

    Attributes:
        here: (nv,) where that plan is.
        deviations: (N, nx) its e.
        G: (N, nx, N nu) responses of e to the inputs.
        back: (N nu, N nu) L^-T, responses of the inputs to v.
    """

    here: FloatArray
    deviations: FloatArray
    G: FloatArray
    back: FloatArray

    def guess(self, v: FloatArray) -> FloatArray:
        """See the base class."""
        moved = self.back @ (v - self.here)[: len(self.back)]
        e: FloatArray = self.deviations + self.G @ moved
        return e

    def curvature(
        self, hessians: FloatArray, sway: FloatArray | None, heading: int | None
    ) -> FloatArray:
        """Second derivatives (nv, nv) of what hessians (N, nx+nu, nx+nu) of all stages add up to.

        State 0 is given; the others respond to the inputs by G. `sway` (N,) are second derivatives
        in one of the entries of states 1 .. N, the heading.
        """
        N, nx, n = self.G.shape
        x, u, later, G = slice(nx), slice(nx, None), hessians[1:], self.G[:-1]
        W = np.zeros((n, n))
        W[n // N :] = (later[:, u, x] @ G).reshape(-1, n)
        W += W.T
        W += (later[:, x, x] @ G).reshape(-1, n).T @ G.reshape(-1, n)
        if sway is not None:
            turns = self.G[:, heading]
            W += (turns * sway[:, None]).T @ turns
        stages = W.reshape(N, n // N, N, n // N)
        i = np.arange(N)
        stages[i, :, i] += hessians[:, u, u]
        bent = np.zeros((len(self.here), len(self.here)))
        bent[:n, :n] = self.back.T @ W @ self.back
        return bent


class Varying(Condensation):
    """Rolls the inputs of a nonlinear robot out, and charts the problem about plans.

    Args:
        problem: The problem.
        sampling: The points of the positions.

    Raises:
        InvalidArgumentError: R is singular.
    """

    def __init__(self, problem: Problem, sampling: NonlinearSampling) -> None:
        """Lay everything out."""
        self._problem, self._model = problem, problem.model
        if np.linalg.eigvalsh(problem.R)[0] <= 0:
            raise InvalidArgumentError("R", "is singular, which a nonlinear model does not allow")
        self.sampling = self._points = sampling
        self.layout = Layout(problem, sampling)
        self._bands = Bands(problem.horizon, problem.model.nx)
        N, nu = self.layout.shape
        self._effort = np.kron(np.eye(N), 2 * problem.R)
        self._unit = np.eye(N * nu)
        self._charted: tuple[Rolled, FloatArray, VaryingChart] | None = None

    def begin(self, step: StepData) -> None:
        """See the base class."""
        self._step, self._charted = step, None

    def rolled(self, inputs: FloatArray, guess: FloatArray | None = None) -> Rolled:
        """See the base class."""
        x_ref = self._step.x_ref
        states = x_ref.copy()
        states[0] = self._step.x0
        if guess is not None:
            states[1:] += guess
        motion = self._closed(states, inputs) if guess is not None else None
        if motion is None:
            for i, u in enumerate(inputs):
                states[i + 1] = self._model.step(states[i], u)
            motion = self._about(states, inputs)[0]
        positions, between, at = self._points.derivatives(states, inputs)
        motion = VaryingMotion(motion.A, motion.B, between, at, self._bands)
        return Rolled(inputs, states[1:] - x_ref[1:], positions - self._step.track[1:], motion)

    def chart(self, rolled: Rolled, s: FloatArray) -> VaryingChart:
        """Chart the problem about a plan with sizes s (M,); twice about the same is once."""
        known = self._charted
        if known is not None and known[0] is rolled and np.array_equal(known[1], s):
            return known[2]
        problem, layout, motion = self._problem, self.layout, rolled.motion
        assert isinstance(motion, VaryingMotion)
        N, nu = layout.shape
        e, u, inputs = rolled.deviations, rolled.inputs, N * nu
        G = motion.respond(self._unit)
        QG = 2 * problem.Q @ G
        QG[-1] = 2 * problem.Qf @ G[-1]
        flat, weighed = G.reshape(-1, inputs), QG.reshape(-1, inputs)
        L = _factor(flat.T @ weighed + self._effort)
        inverse, _ = dtrtri(L, lower=1)
        back = np.ascontiguousarray(inverse.T)
        bounded = G[:, problem.bounded_states].reshape(-1, inputs) @ back
        S = layout.response(motion.positions(G, self._unit) @ back, back, bounded)
        effort = (u - problem.model.idle) @ problem.R
        gradient = 2 * effort.ravel() + e.ravel() @ weighed
        away = (s - problem.size.reference)[: layout.moving]
        here = np.concatenate([inverse @ gradient, layout.stiffness * away])
        y = layout.outputs(self._step, rolled.positions, s, u, e)

        def cost_free() -> float:
            states = self._step.x_ref.copy()
            states[1:] += e
            return problem.cost(states, u, s, self._step.x_ref) - float(here @ here) / 2

        chart = VaryingChart(y - S @ here, S, S[layout.boxed], cost_free, here, e, G, back)
        self._charted = rolled, s, chart
        return chart

    def _about(self, states: FloatArray, inputs: FloatArray) -> tuple[VaryingMotion, FloatArray]:
        """The motion along states (N+1, nx), without positions, and the states it leads to."""
        linear = self._model.linearise(states[:-1], inputs)
        none = np.zeros((len(inputs), 0, states.shape[1]))
        return VaryingMotion(linear.A, linear.B, None, none, self._bands), linear.after

    def _closed(self, states: FloatArray, inputs: FloatArray) -> VaryingMotion | None:
        """Close the defects of states (N+1, nx) in place; None where that does not succeed."""
        before = np.inf
        for _ in range(_ROUNDS):
            motion, after = self._about(states, inputs)
            defect = after - states[1:]
            worst = float(np.abs(defect).max())
            if worst <= _CLOSED * max(1.0, float(np.abs(states).max())):
                return motion
            if not worst < before:  # or NaN
                return None
            before = worst
            states[1:] += motion.roll(defect)
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
