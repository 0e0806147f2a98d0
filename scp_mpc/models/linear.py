"""Robots with linear, time-invariant dynamics.

Notation:
    x   (nx,)       state               A   (nx, nx)
    u   (nu,)       input               B   (nx, nu)
    p   (d,)        position, p = x[position]
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import fractional_matrix_power

from scp_mpc.arrays import FloatArray, IntArray, as_array, frozen
from scp_mpc.errors import InvalidArgumentError, ShapeError
from scp_mpc.models.model import Linearisation, Model, as_period, as_places, as_velocity

_MOST_POWERS = 64


@dataclass(frozen=True, eq=False)
class LinearModel(Model):
    """x_{i+1} = A x_i + B u_i, with the position read off the state.

    Args:
        A: (nx, nx) state matrix.
        B: (nx, nu) input matrix.
        dt: Sampling time [s].
        position: Indices (d,) of the position's coordinates within the state, d = 2 or 3.
        velocity: Indices of the velocity within the state; see `Model`.

    Raises:
        ShapeError: A is not square, or B has another number of rows.
        InvalidArgumentError: `position` is not 2 or 3 distinct indices of the state.
        BoundsError: dt is not positive.
    """

    A: FloatArray
    B: FloatArray
    dt: float
    position: IntArray
    velocity: IntArray | None = None

    def __post_init__(self) -> None:
        """Copy, check and freeze the matrices."""
        A = as_array("A", self.A, (-1, -1))
        if A.shape[0] != A.shape[1]:
            raise ShapeError("A", f"shape {A.shape} is not square")
        B = as_array("B", self.B, (len(A), -1))
        if B.shape[1] == 0:
            raise ShapeError("B", f"shape {B.shape} has no input")
        dt = as_period(self.dt)
        position = as_places(self.position, len(A))
        object.__setattr__(self, "A", frozen(A))
        object.__setattr__(self, "B", frozen(B))
        object.__setattr__(self, "dt", dt)
        object.__setattr__(self, "position", position)
        velocity = as_velocity(self.velocity, len(A), len(position))
        object.__setattr__(self, "velocity", velocity)

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(self.A)

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return int(self.B.shape[1])

    def _next(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state A x + B u."""
        return self.A @ x + self.B @ u

    def advance(
        self, states: FloatArray, inputs: FloatArray, fraction: ArrayLike = 1.0
    ) -> FloatArray:
        """Return the states (..., nx) after a share of an interval with the input held."""
        states, inputs = np.asarray(states, np.float64), np.asarray(inputs, np.float64)
        A, B = self._powers(fraction)
        if A.ndim == 2:
            return states @ A.T + inputs @ B.T
        after: FloatArray = (A @ states[..., None] + B @ inputs[..., None])[..., 0]
        return after

    def linearise(
        self, states: FloatArray, inputs: FloatArray, fraction: ArrayLike = 1.0
    ) -> Linearisation:
        """Return `advance` with A and B, or what stands for them after a share of an interval."""
        after = self.advance(states, inputs, fraction)
        A, B = self._powers(fraction)
        lead = after.shape[:-1]
        return Linearisation(
            after,
            np.broadcast_to(A, (*lead, *A.shape[-2:])),
            np.broadcast_to(B, (*lead, *B.shape[-2:])),
        )

    def curvature(
        self,
        states: FloatArray,
        inputs: FloatArray,
        costates: FloatArray,
        fraction: ArrayLike = 1.0,  # noqa: ARG002
    ) -> FloatArray:
        """Return zeros (..., nx+nu, nx+nu)."""
        lead = np.broadcast_shapes(*(np.shape(z)[:-1] for z in (states, inputs, costates)))
        n = self.nx + self.nu
        return np.zeros((*lead, n, n))

    def between(self, fraction: float) -> tuple[FloatArray, FloatArray]:
        """Return C (d, nx) and D (d, nu): the position C x + D u within an interval.

        For an input held over the interval, [[A, B], [0, I]] ^ fraction advances state and input
        by that part of it. Where that power is not real, as for a purely discrete model, the
        position is interpolated between both ends.

        Args:
            fraction: Of the interval, between 0 and 1.
        """
        rows = np.ascontiguousarray(self._power(fraction)[self.position])
        return rows[:, : self.nx], rows[:, self.nx :]

    def within(self, instants: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return how K instants of an interval, the last of which is its end, depend on x and u.

        Args:
            instants: K.

        Returns:
            C ((K-1) d, nx) and D ((K-1) d, nu) of the positions before the end; and (K d, nx) and
            (K d, nu) of how far a held input bends the way off the chord, in the middle between
            two instants.
        """
        K = instants
        maps = [self.between(k / (2 * K)) for k in range(2 * K + 1)]
        by_x, by_u = (np.array([m[part] for m in maps]) for part in (0, 1))
        C, D = (part[2:-1:2].reshape(-1, part.shape[2]) for part in (by_x, by_u))
        bend_x, bend_u = (
            (part[1::2] - (part[:-1:2] + part[2::2]) / 2).reshape(-1, part.shape[2])
            for part in (by_x, by_u)
        )
        return C, D, bend_x, bend_u

    def state(self, position: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return states (..., nx) there whose position moves by dt times the velocity if u = 0.

        Entries that this leaves open are the smallest that will do.
        """
        drift = (self.A - np.eye(self.nx))[self.position]
        others = np.setdiff1d(np.arange(self.nx), self.position)
        here = np.asarray(position, dtype=np.float64)
        wanted = self.dt * np.asarray(velocity) - here @ drift[:, self.position].T
        states = np.zeros((*wanted.shape[:-1], self.nx))
        states[..., self.position] = here
        states[..., others] = wanted @ np.linalg.pinv(drift[:, others]).T
        return states

    def stopping_input(self, x: FloatArray) -> FloatArray:
        """Return the input (nu,), bounds aside, after which the position comes to rest.

        Without further input the next position but one would differ from the next by
        P (A - I) (A x + B u); least squares make that vanish.
        """
        halt: FloatArray = -self._braking @ x
        return halt

    @cached_property
    def _braking(self) -> FloatArray:
        drift = (self.A - np.eye(self.nx))[self.position]
        gain: FloatArray = np.linalg.pinv(drift @ self.B) @ drift @ self.A
        return gain

    def _powers(self, fraction: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """A (..., nx, nx) and B (..., nx, nu) after shares (...) of an interval."""
        if isinstance(fraction, float) and fraction == 1.0:
            return self.A, self.B
        values, place = np.unique(np.asarray(fraction, dtype=np.float64), return_inverse=True)
        powers = np.stack([self._power(float(value)) for value in values])
        rows = powers[place.reshape(np.shape(fraction)), : self.nx]
        return rows[..., : self.nx], rows[..., self.nx :]

    @cached_property
    def _known(self) -> dict[float, FloatArray]:
        return {}

    def _power(self, fraction: float) -> FloatArray:
        """[[A, B], [0, I]] ^ fraction; a solver asks for few, and they take milliseconds."""
        power = self._known.get(fraction)
        if power is None:
            if len(self._known) >= _MOST_POWERS:
                self._known.clear()
            power = self._known[fraction] = self._new_power(fraction)
        return power

    def _new_power(self, fraction: float) -> FloatArray:
        nx, size = self.nx, self.nx + self.nu
        whole = np.eye(size)
        whole[:nx, :nx], whole[:nx, nx:] = self.A, self.B
        part: Any = np.asarray(fractional_matrix_power(whole, fraction))
        rest = np.asarray(fractional_matrix_power(whole, 1 - fraction))
        away = np.abs(rest @ part - whole).max()
        if np.iscomplexobj(part) or not away <= 1e-9 * np.abs(whole).max():
            part = (1 - fraction) * np.eye(size) + fraction * whole
        power: FloatArray = part.real
        return power


def as_linear(argument: str, model: Model) -> LinearModel:
    """Return a model that has to be linear.

    Raises:
        InvalidArgumentError: It is not.
    """
    if not isinstance(model, LinearModel):
        raise InvalidArgumentError(argument, f"{type(model).__name__} is not linear")
    return model
