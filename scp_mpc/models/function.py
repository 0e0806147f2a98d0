"""A robot given by functions: anybody's own dynamics.

Differences of a next state x_{i+1} = g(x, u) far from the origin of its coordinates would be
differences of large, rounded numbers. Where g(x, u) - x is the same with the position at zero and
a little to all sides, as that of nearly every robot is, they are taken there; this is looked at
for each point anew.

Notation:
    g(x, u)     the function: x' [1/s] where continuous, else the next state
    J (nx, n)   its derivatives [dg/dx, dg/du], n = nx + nu
    z (n,)      (x, u)
"""

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray, IntArray, as_array, as_count, frozen
from scp_mpc.errors import InvalidArgumentError, ShapeError
from scp_mpc.models.batched import Batched, Layout
from scp_mpc.models.coasting import coasting_state, coasting_stop
from scp_mpc.models.differences import differences, second_differences, steps
from scp_mpc.models.model import (
    Linearisation,
    as_period,
    as_places,
    as_velocity,
    joined,
    require_agreement,
)
from scp_mpc.models.runge_kutta import ContinuousModel

Function = Callable[[FloatArray, FloatArray], Any]
_COMPLEX_STEP = 1e-30
_SAME = 8.0  # roundings by which g(x, u) - x may differ where the position makes no difference


class FunctionModel(ContinuousModel):
    """x' = g(x, u) by Runge-Kutta steps, or x_{i+1} = g(x_i, u_i) where `discrete`.

    Within an interval a discrete model moves in a straight line between both ends. Second
    derivatives are differences of g, right to about seven digits.

    Args:
        function: g, from (nx,) and (nu,) to (nx,).
        jacobians: Returns the pair dg/dx (nx, nx), dg/du (nx, nu). Or "central": differences of g,
            right to about ten digits. Or "complex": derivatives to rounding errors from a complex
            step, for a g that is analytic in numpy (no abs, no arctan2, no comparisons); this one
            is always checked.
        nx: Number of states.
        nu: Number of inputs.
        dt: Sampling time [s].
        position: Indices of the position within the state, 2 or 3.
        discrete: g is the next state.
        heading: Index of the heading within the state, for a planar robot that has one.
        velocity: Indices of the velocity within the state, see `Model`; None where it holds none.
        equilibrium_input: Input (nu,) to start plans from; zeros if None.
        vectorised: True: both functions take (..., nx) and (..., nu). False: they are called for
            one point at a time. None: each is tried with many random points at once, as rows
            (K, nx) or as columns (nx, K), and called so if that gives what single points give.
        substeps: Runge-Kutta steps per interval.
        stopping_input: x (nx,) to the input (nu,) that stops it; if None, least squares over an
            interval.
        state: Positions and velocities (..., d) to states (..., nx); if None, least squares.
        check: Compare the Jacobians with differences of g: True at 30 random states and inputs
            about zero and `equilibrium_input`, see `Model.check`; or about a given state (nx,) and
            input (nu,), say at the origin of a map; or at given points (..., nx), (..., nu) and no
            others. The shapes are always checked.

    Raises:
        ShapeError: A function returns another shape than announced.
        NotFiniteError: A function returns NaN or infinity at zero, or at the points given.
        JacobianError: Jacobians that are not g's, where `check` asks for it.
        InvalidArgumentError: Another argument cannot be meant; a function raises at zero; or no
            input changes anything, as where x and u are in the wrong order.
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
        vectorised: bool | None = None,
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
        if type(function).__module__.split(".")[0] == "casadi":
            raise InvalidArgumentError("function", "is one of CasADi: CasadiModel takes it")
        self.heading, self.discrete = heading, bool(discrete)
        self.velocity = as_velocity(velocity, self._nx, len(self.position))
        self.equilibrium_input = frozen(
            as_array(
                "equilibrium_input",
                np.zeros(nu) if equilibrium_input is None else equilibrium_input,
                (nu,),
            )
        )
        self._stop, self._state = stopping_input, state
        points = check if isinstance(check, tuple) else (np.zeros(self._nx), self.equilibrium_input)
        x, u = as_array("check", points[0]), as_array("check", points[1])
        if x.shape[-1:] != (self._nx,) or u.shape[-1:] != (self._nu,):
            raise ShapeError("check", f"shapes {x.shape}, {u.shape} are not (..., nx), (..., nu)")
        x0, u0 = (part.reshape(-1, part.shape[-1])[0] for part in (x, u))
        trial = self._random_points(x0, u0, _trials(nx, nu))
        layout: Layout | None = None if vectorised is None else "any" if vectorised else "single"
        self._function = Batched("function", function, (nx,), layout, (x0, u0), trial)
        as_array("function", self.derivative(x, u))
        self._require_inputs(*trial)
        self._movable = self.discrete and self._stands_at_zero(joined(x0, u0))
        self._jacobians: Batched | Literal["central", "complex"] = "central"
        if callable(jacobians):
            shape = (nx, nx + nu)
            self._jacobians = Batched("jacobians", jacobians, shape, layout, (x0, u0), trial)
        else:
            self._jacobians = jacobians
        as_array("jacobians", self.jacobians(x, u))
        if check is not False or jacobians == "complex":
            self.check(*(points if isinstance(check, tuple) else ()))

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
        return self._function(states, inputs)

    def jacobians(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Return dg/dz (..., nx, nx+nu) at states (..., nx) and inputs (..., nu)."""
        if isinstance(self._jacobians, Batched):
            return self._jacobians(states, inputs)
        z = joined(states, inputs)
        if self._jacobians == "complex":
            n = z.shape[-1]
            aside = 1j * _COMPLEX_STEP * np.eye(n).reshape(n, *(1,) * (z.ndim - 1), n)
            slopes: FloatArray = np.moveaxis(np.imag(self._at(z + aside)) / _COMPLEX_STEP, 0, -1)
            return slopes
        if not self.discrete:
            return differences(self._at, z)
        return np.eye(self.nx, z.shape[-1]) + differences(self._increment, *self._nearby(z))

    def hessian(self, states: FloatArray, inputs: FloatArray, weights: FloatArray) -> FloatArray:
        """Return sum_k m_k (Hessian of g_k in z), (..., n, n), for weights m (..., nx)."""
        z, function = joined(states, inputs), self._at
        about: tuple[FloatArray, Any] = z, 1.0
        if self.discrete:
            function, about = self._increment, self._nearby(z)
        return second_differences(lambda z: (function(z) * weights).sum(axis=-1), *about)

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

    def _curvature(
        self, x: FloatArray, u: FloatArray, h: FloatArray, costates: FloatArray
    ) -> FloatArray:
        if not self.discrete:
            return super()._curvature(x, u, h, costates)
        return self.hessian(x, u, h * (self.substeps / self.dt) * costates)

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

    def _compare(self, z: FloatArray, tolerance: float) -> None:
        """See the base class: g and J, not what Runge-Kutta steps make of them."""
        given = self.jacobians(z[..., : self.nx], z[..., self.nx :])
        require_agreement("AB", self._at, z, given, self.nx, tolerance)

    def _at(self, z: FloatArray) -> FloatArray:
        return self._function(z[..., : self.nx], z[..., self.nx :])

    def _increment(self, z: FloatArray) -> FloatArray:
        """Return g(x, u) - x."""
        return self._at(z) - z[..., : self.nx]

    def _nearby(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Points (..., n) with the increments of others, their positions zero where that may be.

        Returns:
            They, and how large the numbers (..., 1) are that increments are differences of.
        """
        if not self._movable:
            return z, np.abs(self._at(z)).max(axis=-1, keepdims=True)
        aside = steps(z, 1)[..., self.position, None] * np.eye(z.shape[-1])[self.position]
        aside = np.moveaxis(aside, -2, 0)
        places = np.concatenate([[z, z], z + aside, z - aside])
        places[1, ..., self.position] = 0.0
        values = self._at(places)
        sizes = np.abs(values) + np.abs(places[..., : self.nx])
        increments = values - places[..., : self.nx]
        rounding = _SAME * np.finfo(np.float64).eps * sizes.max(axis=0)
        alike = (np.abs(increments - increments[0]) <= rounding).all(axis=(0, -1))[..., None]
        most = sizes[:2].max(axis=-1, keepdims=True)
        return np.where(alike, places[1], z), np.where(alike, most[1], most[0])

    def _stands_at_zero(self, z: FloatArray) -> bool:
        """Whether the function takes a position at zero, without an error of its own."""
        near = z.copy()
        near[self.position] = 0.0
        try:
            with np.errstate(all="ignore"):
                return bool(np.isfinite(self._at(near)).all())
        except Exception:
            return False

    def _require_inputs(self, x: FloatArray, u: FloatArray) -> None:
        """Refuse a function on which no input has an effect: its arguments may be swapped."""
        try:
            with np.errstate(all="ignore"):
                values, others = (self.derivative(x, v) for v in (u, np.roll(u, 1, axis=0)))
        except Exception:  # no function of all the plane
            return
        if np.array_equal(values, others, equal_nan=True):
            raise InvalidArgumentError(
                "function",
                f"no input changes anything at {len(x)} random points; it is called with (x, u)",
            )


def _trials(nx: int, nu: int) -> int:
    """A number of points that is no size of the model's."""
    return next(count for count in (7, 11, 13) if count not in (nx, nu))
