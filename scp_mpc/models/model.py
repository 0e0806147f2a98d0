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
from scp_mpc.models.differences import differences, disagreement

_POINTS = 30  # at which derivatives are checked


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

    def step(self, x: ArrayLike, u: ArrayLike) -> FloatArray:
        """Return the next state f(x, u) (nx,).

        Raises:
            ShapeError: x is not (nx,), or u not (nu,).
        """
        now, held = np.asarray(x, dtype=np.float64), np.asarray(u, dtype=np.float64)
        for name, array, size in (("x", now, self.nx), ("u", held, self.nu)):
            if array.shape != (size,):
                raise ShapeError(name, f"shape {array.shape} is not ({size},)")
        return self._next(now, held)

    def _next(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """`step`, of arrays that fit; models override it where one state is the quicker."""
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

        bent = differences(gradients, joined(states, inputs))
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

    def check(
        self, x: ArrayLike | None = None, u: ArrayLike | None = None, tolerance: float = 1e-6
    ) -> None:
        """Compare the derivatives, second ones included, with differences.

        One state and input, or None, stand for 30 random ones about them, too, in one call and the
        same ones each time: off by up to 0.001, ... 1 or 10 in each entry, headings at any angle.
        There a model need not be finite. An entry is wrong if it is off by more than a share of
        itself, by more than rounding, and by more than the spread of three differences explain.

        Args:
            x: (nx,) or (..., nx); None for random ones about zero.
            u: (nu,) or (..., nu); None for random ones about `equilibrium_input`.
            tolerance: Accepted difference, relative to each entry.

        Raises:
            ShapeError: x or u has another width.
            JacobianError: With the worst entry's row and column and both numbers.
            NotFiniteError: The model returns NaN or infinity at a given point.
        """
        states = as_array("x", np.zeros(self.nx) if x is None else x)
        inputs = as_array("u", self.equilibrium_input if u is None else u)
        for name, array, size in (("x", states, self.nx), ("u", inputs, self.nu)):
            if array.shape[-1:] != (size,):
                raise ShapeError(name, f"shape {array.shape} does not fit (..., {size})")
        as_array("advance", self.advance(states, inputs))
        if x is not None or u is not None:
            self._compare(joined(states, inputs), tolerance)
        if states.ndim == inputs.ndim == 1:
            z = joined(*self._random_points(states, inputs, _POINTS))
            with np.errstate(all="ignore"):
                z = z[np.isfinite(self._values(z)).all(axis=-1)]
                if len(z):
                    self._compare(z, tolerance)

    def _compare(self, z: FloatArray, tolerance: float) -> None:
        """Raise where derivatives at points (..., n) are not those of differences."""
        nx, slopes = self.nx, self._slopes
        require_agreement("AB", self._values, z, slopes(z), nx, tolerance)
        y = np.random.default_rng(1).normal(size=nx)
        bent = self.curvature(z[..., :nx], z[..., nx:], np.broadcast_to(y, z[..., :nx].shape))
        require_agreement("curvature", lambda z: y @ slopes(z), z, bent, nx, tolerance)

    def _values(self, z: FloatArray) -> FloatArray:
        return self.advance(z[..., : self.nx], z[..., self.nx :])

    def _slopes(self, z: FloatArray) -> FloatArray:
        there = self.linearise(z[..., : self.nx], z[..., self.nx :])
        return np.concatenate([there.A, there.B], axis=-1)

    def _random_points(
        self, x: FloatArray, u: FloatArray, count: int
    ) -> tuple[FloatArray, FloatArray]:
        """States (count, nx) and inputs (count, nu) about one of each; the same ones each time."""
        rng = np.random.default_rng(0)
        reach = np.resize([1.0, 0.1, 10.0, 0.01, 0.001], count)[:, None]
        states = x + reach * rng.uniform(-1.0, 1.0, (count, self.nx))
        if self.heading is not None:
            states[:, self.heading] = rng.uniform(-np.pi, np.pi, count)
        return states, u + reach * rng.uniform(-1.0, 1.0, (count, self.nu))


def require_agreement(
    what: str,
    function: Any,
    z: FloatArray,
    given: FloatArray,
    nx: int,
    tolerance: float,
) -> None:
    """Raise where given derivatives (..., m, n) of a function (..., m) of z (..., n) are not so."""
    found = disagreement(function, z, as_array("derivatives", given), tolerance)
    if found is None:
        return
    row, column = found[0][-2:]
    if what == "AB":
        what, column = ("A", column) if column < nx else ("B", column - nx)
    raise JacobianError(
        f"{what}[{row}, {column}]",
        f"{given[found[0]]:.9g} is given, differences of the model say {found[1]:.9g}",
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
    velocity = np.asarray(velocity, dtype=np.float64)
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
    if states.shape[:-1] == inputs.shape[:-1]:
        return np.concatenate([states, inputs], axis=-1)
    shape = np.broadcast_shapes(states.shape[:-1], inputs.shape[:-1])
    parts = [np.broadcast_to(part, (*shape, part.shape[-1])) for part in (states, inputs)]
    return np.concatenate(parts, axis=-1)
