"""What the solver asks of a robot: discrete-time dynamics f and their exact sensitivities.

Notation:
    x   (nx,)       state               A   (nx, nx)    df/dx
    u   (nu,)       input               B   (nx, nu)    df/du
    p   (d,)        position, p = x[position]
    z   (nx+nu,)    state and input together, n = nx + nu
    y   (nx,)       costates: weights of the entries of f
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray, IntArray, as_array, as_number, frozen
from scp_mpc.errors import BoundsError, InvalidArgumentError, JacobianError, ShapeError

_STEP = float(np.finfo(np.float64).eps ** (1 / 3))


@dataclass(frozen=True, eq=False, slots=True)
class Linearisation:
    """The state after an interval, or part of it, and how it depends on state and input.

    Args:
        after: States (..., nx).
        A: Derivatives (..., nx, nx) of `after` with respect to the state.
        B: Derivatives (..., nx, nu) with respect to the held input.
    """

    after: FloatArray
    A: FloatArray
    B: FloatArray


class Model(ABC):
    """x_{i+1} = f(x_i, u_i), with the position read off the state.

    Arguments of the batched methods broadcast over their leading axes.

    Attributes:
        dt: Sampling time [s].
        position: Indices (d,) of the position's coordinates within the state, d = 2 or 3.
        heading: Index within the state of the angle that the robot's nose points at [rad], for a
            planar robot that has one.
        velocity: Indices within the state of the velocity [m/s]: (d,) along the axes, or (1,) of a
            signed speed along the heading; None where the state holds neither.
    """

    dt: float
    position: IntArray
    heading: int | None = None
    velocity: IntArray | None = None

    @property
    @abstractmethod
    def nx(self) -> int:
        """Number of states."""

    @property
    @abstractmethod
    def nu(self) -> int:
        """Number of inputs."""

    @property
    def dim(self) -> int:
        """Dimension of the workspace, 2 or 3."""
        return len(self.position)

    @cached_property
    def equilibrium_input(self) -> FloatArray:
        """Input (nu,) from which a plan starts where nothing better is known."""
        return frozen(np.zeros(self.nu))

    @abstractmethod
    def advance(
        self, states: FloatArray, inputs: FloatArray, fraction: ArrayLike = 1.0
    ) -> FloatArray:
        """Return the states (..., nx) after a share of an interval with the input held.

        Args:
            states: At its beginning (..., nx).
            inputs: (..., nu).
            fraction: Share of the interval, between 0 and 1; broadcasts over the leading axes.
        """

    @abstractmethod
    def linearise(
        self, states: FloatArray, inputs: FloatArray, fraction: ArrayLike = 1.0
    ) -> Linearisation:
        """Return `advance` with its exact derivatives; arguments as there."""

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state f(x, u) (nx,)."""
        return self.advance(x, u)

    def curvature(
        self,
        states: FloatArray,
        inputs: FloatArray,
        costates: FloatArray,
        fraction: ArrayLike = 1.0,
    ) -> FloatArray:
        """Return sum_k y_k (Hessian of f_k in z), (..., n, n), over that share of an interval.

        Here from central differences of `linearise`, at all points in one call.

        Args:
            states: (..., nx).
            inputs: (..., nu).
            costates: y (..., nx).
            fraction: Of the interval; broadcasts over the leading axes.
        """

        def gradients(z: FloatArray) -> FloatArray:
            there = self.linearise(z[..., : self.nx], z[..., self.nx :], fraction)
            both = np.concatenate([there.A, there.B], axis=-1)
            return (costates[..., None, :] @ both)[..., 0, :]

        bent = np.moveaxis(differences(gradients, joined(states, inputs)), 0, -1)
        return 0.5 * (bent + np.swapaxes(bent, -2, -1))

    @abstractmethod
    def stopping_input(self, x: FloatArray) -> FloatArray:
        """Return the input (nu,), bounds aside, by which the position comes to rest.

        A model that cannot stop within one interval stops if it is asked again after each.
        """

    @abstractmethod
    def state(self, position: FloatArray, velocity: FloatArray) -> FloatArray:
        """Return states (..., nx) at positions (..., d) [m] with velocities (..., d) [m/s].

        For references: axis -2, where there is one, runs over samples `dt` apart. Angles do not
        jump along it, and without speed they stay what they were.
        """

    def check(self, x: ArrayLike, u: ArrayLike, tolerance: float = 1e-6) -> None:
        """Compare `linearise` with central differences of `advance` at a state and an input.

        Args:
            x: (nx,) or (..., nx).
            u: (nu,) or (..., nu).
            tolerance: Accepted difference, times the larger of 1 and the row's largest entry.

        Raises:
            ShapeError: x or u has another width.
            JacobianError: With the worst entry's row and column and both numbers.
            NotFiniteError: The model returns NaN or infinity there.
        """
        states = as_array("x", x)
        inputs = as_array("u", u)
        for name, array, size in (("x", states, self.nx), ("u", inputs, self.nu)):
            if array.shape[-1:] != (size,):
                raise ShapeError(name, f"shape {array.shape} does not fit (..., {size})")
        z = joined(states, inputs)
        given = self.linearise(states, inputs)
        found = differences(lambda z: self.advance(z[..., : self.nx], z[..., self.nx :]), z)
        both = as_array("linearise", np.concatenate([given.A, given.B], axis=-1))
        slopes = as_array("advance", np.moveaxis(found, 0, -1))
        scale = np.maximum(1.0, np.abs(slopes).max(axis=-1, keepdims=True))
        error = np.abs(both - slopes) / scale
        if error.max() > tolerance:
            at = tuple(int(i) for i in np.unravel_index(np.argmax(error), error.shape))
            row, column = at[-2:]
            matrix = "A" if column < self.nx else "B"
            raise JacobianError(
                f"{matrix}[{row}, {column - self.nx * (matrix == 'B')}]",
                f"{both[at]:.9g} is given, differences of the model say {slopes[at]:.9g}",
            )


def as_period(dt: object) -> float:
    """Return the sampling time [s].

    Raises:
        BoundsError: It is not positive.
    """
    period = as_number("dt", dt)
    if period <= 0:
        raise BoundsError("dt", f"{period} s is not positive")
    return period


def as_places(position: object, nx: int) -> IntArray:
    """Return the indices of the position within the state.

    Raises:
        InvalidArgumentError: They are not 2 or 3 distinct indices below nx.
    """
    array = np.array(position)
    whole = array.dtype.kind in "iu" and array.shape in ((2,), (3,))
    if not whole or len(set(array.tolist()) & set(range(nx))) < len(array):
        raise InvalidArgumentError(
            "position", f"{position!r} is not 2 or 3 distinct indices below {nx}"
        )
    return indices(*array.tolist())


def as_velocity(velocity: object, nx: int, dim: int) -> IntArray | None:
    """Return the indices of the velocity within the state, or None.

    Raises:
        InvalidArgumentError: They are not one index, or one per axis, below nx.
    """
    if velocity is None:
        return None
    array = np.array(velocity)
    whole = array.dtype.kind in "iu" and array.shape in ((1,), (dim,))
    if not whole or len(set(array.tolist()) & set(range(nx))) < len(array):
        raise InvalidArgumentError(
            "velocity", f"{velocity!r} is not one or {dim} distinct indices below {nx}"
        )
    return indices(*array.tolist())


def indices(*places: int) -> IntArray:
    """Return places within the state, read-only."""
    array = np.array(places, dtype=np.intp)
    array.setflags(write=False)
    return array


def courses(velocity: FloatArray) -> FloatArray:
    """Return directions of travel (...) [rad] of planar velocities (..., 2), unwrapped.

    Axis -2, where there is one, runs in time: without speed the last direction holds,
    before the first motion that one's, and 0 where there is none at all.
    """
    if velocity.ndim == 1:
        return courses(velocity[None])[0]
    moving = np.hypot(velocity[..., 0], velocity[..., 1]) > 1e-9
    at = np.where(moving, np.arange(moving.shape[-1]), -1)
    last = np.maximum.accumulate(at, axis=-1)
    last = np.where(last < 0, np.argmax(moving, axis=-1)[..., None], last)
    angles = np.where(moving, np.arctan2(velocity[..., 1], velocity[..., 0]), 0.0)
    unwrapped: FloatArray = np.unwrap(np.take_along_axis(angles, last, axis=-1), axis=-1)
    return unwrapped


def joined(states: FloatArray, inputs: FloatArray) -> FloatArray:
    """Return z (..., nx+nu) of states (..., nx) and inputs (..., nu)."""
    shape = np.broadcast_shapes(states.shape[:-1], inputs.shape[:-1])
    parts = [np.broadcast_to(part, (*shape, part.shape[-1])) for part in (states, inputs)]
    return np.concatenate(parts, axis=-1)


def differences(function: Any, z: FloatArray) -> FloatArray:
    """Central differences (n, ..., m) of a batched function of z (..., n)."""
    n = z.shape[-1]
    h = _STEP * np.maximum(1.0, np.abs(z))
    aside = np.moveaxis(h[..., None] * np.eye(n), -2, 0)
    forward, backward = z + aside, z - aside
    values = function(np.stack([forward, backward]))
    width = np.moveaxis(h, -1, 0)[..., None]
    return (values[0] - values[1]) / (2 * width)
