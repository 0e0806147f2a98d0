"""A robot given by functions: anybody's own dynamics.

Notation:
    g(x, u)     the function: x' [1/s] where continuous, else the next state
    J (nx, n)   its derivatives [dg/dx, dg/du], n = nx + nu
"""

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray, IntArray, as_array, as_count, frozen
from scp_mpc.errors import InvalidArgumentError, ShapeError
from scp_mpc.models.coasting import coasting_state, coasting_stop
from scp_mpc.models.model import (
    Linearisation,
    Model,
    as_period,
    as_places,
    as_velocity,
    differences,
    joined,
)
from scp_mpc.models.runge_kutta import ContinuousModel

Function = Callable[[FloatArray, FloatArray], Any]
_COMPLEX_STEP = 1e-30


class FunctionModel(ContinuousModel):
    """x' = g(x, u) by Runge-Kutta steps, or x_{i+1} = g(x_i, u_i) where `discrete`.

    Within an interval a discrete model moves in a straight line between both ends.

    Args:
        function: g, from (nx,) and (nu,) to (nx,), or batched if `vectorised`.
        jacobians: Returns the pair dg/dx (nx, nx), dg/du (nx, nu). Or "central": differences of g,
            right to about ten digits. Or "complex": derivatives to rounding errors from a complex
            step, for a g that is analytic in numpy (no abs, no arctan2, no comparisons); this one
            is always checked. The curvature from "central" is right to about five digits.
        nx: Number of states.
        nu: Number of inputs.
        dt: Sampling time [s].
        position: Indices of the position within the state, 2 or 3.
        discrete: g is the next state.
        heading: Index of the heading within the state, for a planar robot that has one.
        velocity: Indices of the velocity within the state, see `Model`; None where it holds none.
        equilibrium_input: Input (nu,) to start plans from; zeros if None.
        vectorised: Both functions take (..., nx) and (..., nu); otherwise they are looped over.
        substeps: Runge-Kutta steps per interval.
        stopping_input: x (nx,) to the input (nu,) that stops it; if None, least squares over an
            interval.
        state: Positions and velocities (..., d) to states (..., nx); if None, least squares.
        check: Compare the Jacobians with differences of g: True at zero and `equilibrium_input`, or
            at given points (states (..., nx), inputs (..., nu)). The shapes are always checked.

    Raises:
        ShapeError: A function returns another shape than announced.
        NotFiniteError: A function returns NaN or infinity at the checked points.
        JacobianError: Jacobians that are not g's, where `check` asks for it.
        InvalidArgumentError: Another argument cannot be meant.
    """

    def __init__(
        self,
        function: Function,
        jacobians: Function | Literal["central", "complex"] = "central",
        *,
        nx: int,
        nu: int,
        dt: float,
        position: ArrayLike,
        discrete: bool = False,
        heading: int | None = None,
        velocity: ArrayLike | None = None,
        equilibrium_input: ArrayLike | None = None,
        vectorised: bool = False,
        substeps: int = 1,
        stopping_input: Callable[[FloatArray], FloatArray] | None = None,
        state: Function | None = None,
        check: bool | tuple[ArrayLike, ArrayLike] = False,
    ) -> None:
        """Check everything that can be checked."""
        self._nx, self._nu = as_count("nx", nx), as_count("nu", nu)
        self.dt, self.substeps = as_period(dt), as_count("substeps", substeps)
        self.position: IntArray = as_places(position, self._nx)
        if heading is not None and as_count("heading", heading, least=0) >= self._nx:
            raise InvalidArgumentError("heading", f"{heading} is no index below {nx}")
        if not (callable(jacobians) or jacobians in ("central", "complex")):
            raise InvalidArgumentError("jacobians", f"{jacobians!r} is no function and no method")
        for name, given in (
            ("function", function),
            ("stopping_input", stopping_input),
            ("state", state),
        ):
            if not callable(given) and (given is not None or name == "function"):
                raise InvalidArgumentError(name, f"{given!r} is not a function")
        self.heading, self.discrete = heading, bool(discrete)
        self.velocity = as_velocity(velocity, self._nx, len(self.position))
        self.equilibrium_input = frozen(
            as_array(
                "equilibrium_input",
                np.zeros(nu) if equilibrium_input is None else equilibrium_input,
                (nu,),
            )
        )
        self._function, self._jacobians, self._vectorised = function, jacobians, vectorised
        self._stop, self._state = stopping_input, state
        points = check if isinstance(check, tuple) else (np.zeros(self._nx), self.equilibrium_input)
        x, u = as_array("check", points[0]), as_array("check", points[1])
        if x.shape[-1:] != (self._nx,) or u.shape[-1:] != (self._nu,):
            raise ShapeError("check", f"shapes {x.shape}, {u.shape} are not (..., nx), (..., nu)")
        as_array("function", self.derivative(x, u))
        as_array("jacobians", self.jacobians(x, u))
        if check is not False or jacobians == "complex":
            self.check(x, u)

    @property
    def nx(self) -> int:
        """Number of states."""
        return self._nx

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return self._nu

    def derivative(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Return g (..., nx) at states (..., nx) and inputs (..., nu)."""
        return self._called("function", self._function, states, inputs)

    def jacobians(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Return dg/dz (..., nx, nx+nu) at states (..., nx) and inputs (..., nu)."""
        if callable(self._jacobians):
            given = self._jacobians
            return self._called("jacobians", lambda x, u: _paired(given(x, u)), states, inputs, 1)
        z = joined(states, inputs)
        if self._jacobians == "central":
            found = differences(lambda z: self.derivative(z[..., : self.nx], z[..., self.nx :]), z)
        else:
            n = z.shape[-1]
            aside = 1j * _COMPLEX_STEP * np.eye(n).reshape(n, *(1,) * (z.ndim - 1), n)
            moved = z + aside
            there = self._called(
                "function", self._function, moved[..., : self.nx], moved[..., self.nx :]
            )
            found = np.imag(there) / _COMPLEX_STEP
        return np.moveaxis(found, 0, -1)

    def advance(
        self, states: FloatArray, inputs: FloatArray, fraction: ArrayLike = 1.0
    ) -> FloatArray:
        """Return the states (..., nx) after a share of an interval with the input held."""
        if not self.discrete:
            return super().advance(states, inputs, fraction)
        x, u, h = self._broadcast(states, inputs, fraction)
        share = h * (self.substeps / self.dt)
        return x + share * (self.derivative(x, u) - x)

    def linearise(
        self, states: FloatArray, inputs: FloatArray, fraction: ArrayLike = 1.0
    ) -> Linearisation:
        """Return `advance` with its derivatives; arguments as there."""
        if not self.discrete:
            return super().linearise(states, inputs, fraction)
        x, u, h = self._broadcast(states, inputs, fraction)
        share = h * (self.substeps / self.dt)
        still = np.eye(self.nx, self.nx + self.nu)
        both = still + share[..., None] * (self.jacobians(x, u) - still)
        after = x + share * (self.derivative(x, u) - x)
        return Linearisation(after, both[..., : self.nx], both[..., self.nx :])

    def curvature(
        self,
        states: FloatArray,
        inputs: FloatArray,
        costates: FloatArray,
        fraction: ArrayLike = 1.0,
    ) -> FloatArray:
        """Return sum_k y_k (Hessian of f_k in z), (..., n, n)."""
        if self.discrete:
            return Model.curvature(self, states, inputs, costates, fraction)
        return super().curvature(states, inputs, costates, fraction)

    def stopping_input(self, x: FloatArray) -> FloatArray:
        """Return the input (nu,) by which the position comes to rest."""
        if self._stop is None:
            return coasting_stop(self, x)
        return as_array("stopping_input", self._stop(x), (self.nu,))

    def state(self, position: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return states (..., nx) at positions (..., d) with velocities (..., d)."""
        if self._state is None:
            return coasting_state(self, position, velocity)
        wanted = (*np.shape(position)[:-1], self.nx)
        return as_array("state", self._state(position, velocity), wanted)

    def _called(
        self, name: str, function: Function, states: FloatArray, inputs: FloatArray, axes: int = 0
    ) -> FloatArray:
        """Values (..., nx) or (..., nx, n) of a user's function, looped over if need be."""
        lead = np.broadcast_shapes(states.shape[:-1], inputs.shape[:-1])
        shape = (*lead, self.nx, *(self.nx + self.nu,) * axes)
        states = np.broadcast_to(states, (*lead, self.nx))
        inputs = np.broadcast_to(inputs, (*lead, self.nu))
        if self._vectorised:
            values = np.asarray(function(states, inputs))
        else:
            pairs = zip(states.reshape(-1, self.nx), inputs.reshape(-1, self.nu), strict=True)
            rows = [np.asarray(function(x, u)) for x, u in pairs]
            if wrong := [row.shape for row in rows if row.shape != shape[len(lead) :]]:
                raise ShapeError(name, f"shape {wrong[0]} returned, {shape[len(lead) :]} needed")
            values = np.stack(rows).reshape(shape)
        if values.shape != shape:
            raise ShapeError(name, f"shape {values.shape} returned, {shape} needed")
        return values


def _paired(pair: Any) -> FloatArray:
    if not isinstance(pair, tuple | list) or len(pair) != 2:
        raise InvalidArgumentError("jacobians", "the pair dg/dx, dg/du is needed")
    by_x, by_u = (np.asarray(part) for part in pair)
    if by_x.ndim < 2 or by_x.shape[:-1] != by_u.shape[:-1]:
        raise ShapeError("jacobians", f"shapes {by_x.shape} and {by_u.shape} are no pair")
    return np.concatenate([by_x, by_u], axis=-1)
