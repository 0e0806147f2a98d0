"""The predictions of all obstacles as arrays, checked once as a whole."""

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, overload

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import (
    FloatArray,
    as_array,
    as_number,
    frozen,
    require_interval,
    require_positive_semidefinite,
)
from scp_mpc.errors import BoundsError, InvalidArgumentError, ShapeError
from scp_mpc.obstacles.prediction import (
    ObstaclePrediction,
    deviations,
    require_fitting,
    require_hashable,
    require_own_frame,
    require_solid,
)
from scp_mpc.obstacles.solid import Solid

_ROUNDING = 1e-12  # relative; eigenvalues decide about determinants that small


@dataclass(frozen=True, eq=False, init=False)
class ObstaclePredictions(Sequence[ObstaclePrediction]):
    """Gaussian positions of J obstacles at i = 0 .. N: a sequence of `ObstaclePrediction`.

    It is accepted wherever such a sequence is, and checked in a fraction of the time.

    Args:
        means: (J, N+1, d) expected positions [m].
        covariances: (J, N+1, d, d) position covariances [m^2], or one (d, d) for all.
        radii: (J,) of the obstacles, or by which shapes are rounded, or a number for all [m].
        stamp: Time of row 0 [s], of all; None for now.
        names: J of them; None for nobody.
        shapes: J `Polytope`s, or None for a ball; None for balls alone.
        dt: Interval between rows [s]; None for the robot's.

    Raises:
        InvalidArgumentError: Or one of its subclasses, as `ObstaclePrediction`; counts matrices
            from 0, through all rows of all obstacles.
    """

    means: FloatArray
    covariances: FloatArray
    radii: FloatArray
    stamp: float | None
    names: tuple[Hashable, ...] | None
    shapes: tuple[Solid | None, ...] | None
    dt: float | None

    def __init__(
        self,
        means: ArrayLike,
        covariances: ArrayLike,
        radii: ArrayLike,
        stamp: float | None = None,
        names: Sequence[Hashable] | None = None,
        shapes: Sequence[Solid | None] | None = None,
        dt: float | None = None,
    ) -> None:
        """Copy, check and freeze."""
        mu = as_array("means", means)
        if mu.ndim != 3 or mu.shape[2] not in (2, 3):
            raise ShapeError("means", f"shape {mu.shape} is not (J, N+1, 2) or (J, N+1, 3)")
        J, rows, d = mu.shape
        if rows < 2:
            raise ShapeError("means", f"{rows} row(s); a prediction needs now and a future")
        Sigma = as_array("covariances", covariances, (J, rows, d, d), (d, d))
        if not _is_surely_positive(Sigma):
            require_positive_semidefinite("covariances", Sigma.reshape(-1, d, d))
        if Sigma.ndim == 2:
            Sigma = np.tile(Sigma, (J, rows, 1, 1))
        sizes = as_array("radii", radii, (J,), ())
        if J and not sizes.min() >= 0:
            raise BoundsError("radii", f"{sizes.min()} m is negative")
        if stamp is not None:
            stamp = as_number("stamp", stamp)
        if dt is not None and as_number("dt", dt) <= 0:
            raise BoundsError("dt", f"{dt} s is not positive")
        names = None if names is None else _each("names", names, J)
        for j, name in enumerate(names or ()):
            require_hashable(f"names[{j}]", name)
        shapes = None if shapes is None else _each("shapes", shapes, J)
        for j, shape in enumerate(shapes or ()):
            if shape is not None:
                require_solid(f"shapes[{j}]", shape, d)
                require_own_frame(f"shapes[{j}]", shape, mu[j, 0])
        sizes = sizes if sizes.ndim else np.full(J, sizes)
        self._set(mu, Sigma, sizes, stamp, names, shapes, dt)

    @classmethod
    def of(
        cls, obstacles: Sequence[ObstaclePrediction], horizon: int, dim: int, dt: float
    ) -> "ObstaclePredictions":
        """Return predictions stacked, for a robot with horizon N in its workspace at its interval.

        Raises:
            ShapeError: Other rows or another dimension.
            InvalidArgumentError: Another interval.
        """
        if isinstance(obstacles, cls):
            if obstacles.means.shape[1:] != (horizon + 1, dim):
                wanted = f"(any, {horizon + 1}, {dim})"
                raise ShapeError("obstacles.means", f"{obstacles.means.shape} is not {wanted}")
            if obstacles.dt is not None and obstacles.dt != dt:
                require_interval("obstacles.dt", obstacles.dt, dt, "predict with the robot's dt")
            return obstacles
        require_fitting(obstacles, horizon, dim, dt)
        rows = len(obstacles), horizon + 1
        mu = np.array([o.means for o in obstacles]).reshape(*rows, dim)
        Sigma = np.array([o.covariances for o in obstacles]).reshape(*rows, dim, dim)
        radii = np.array([o.radius for o in obstacles], dtype=np.float64)
        shapes = tuple(o.shape for o in obstacles)
        self: ObstaclePredictions = object.__new__(cls)
        self._set(mu, Sigma, radii, None, None, shapes if any(shapes) else None, None)
        stds = np.array([o.largest_std for o in obstacles]).reshape(rows)
        vars(self).update(_each=tuple(obstacles), largest_stds=stds)
        return self

    def _set(
        self,
        means: FloatArray,
        covariances: FloatArray,
        radii: FloatArray,
        stamp: float | None,
        names: Any,
        shapes: Any,
        dt: float | None,
    ) -> None:
        arrays = {"means": means, "covariances": covariances, "radii": radii}
        for array in arrays.values():
            frozen(array)
        vars(self).update(arrays, stamp=stamp, names=names, shapes=shapes, dt=dt)

    def __len__(self) -> int:
        """J."""
        return len(self.radii)

    @overload
    def __getitem__(self, index: int) -> ObstaclePrediction: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[ObstaclePrediction, ...]: ...
    def __getitem__(
        self, index: int | slice
    ) -> ObstaclePrediction | tuple[ObstaclePrediction, ...]:
        """One of them, or some."""
        return self._each[index]

    @cached_property
    def largest_stds(self) -> FloatArray:
        """(J, N+1) largest standard deviations in any direction [m]."""
        return frozen(deviations(np.linalg.eigvalsh(self.covariances)))

    @cached_property
    def _each(self) -> tuple[ObstaclePrediction, ...]:
        """Views of the arrays."""
        made = tuple(object.__new__(ObstaclePrediction) for _ in self.radii)
        for j, one in enumerate(made):
            name = None if self.names is None else self.names[j]
            shape = None if self.shapes is None else self.shapes[j]
            gaussian, radius = (self.means[j], self.covariances[j]), float(self.radii[j])
            one._set(*gaussian, radius, self.stamp, name, shape, self.dt, self.largest_stds[j])
        return made


def as_predictions(obstacles: object) -> Sequence[ObstaclePrediction]:
    """Return any iterable of predictions as a sequence: as it is, or a tuple.

    Raises:
        InvalidArgumentError: It is none, or holds something else.
    """
    if isinstance(obstacles, ObstaclePredictions):
        return obstacles
    if isinstance(obstacles, ObstaclePrediction) or not isinstance(obstacles, Iterable):
        raise InvalidArgumentError("obstacles", f"{obstacles!r} is not a list of predictions")
    given = tuple(obstacles)
    for j, obstacle in enumerate(given):
        if not isinstance(obstacle, ObstaclePrediction):
            raise InvalidArgumentError(
                f"obstacles[{j}]", f"{obstacle!r} is not an ObstaclePrediction"
            )
    return given


def _each(argument: str, values: Sequence[Any], count: int) -> tuple[Any, ...]:
    given = tuple(values)
    if len(given) != count:
        raise ShapeError(argument, f"{len(given)} for {count} obstacles")
    return given


def _is_surely_positive(Sigma: FloatArray) -> bool:
    """Whether finite matrices (..., d, d) are symmetric and positive definite, or perhaps.

    By their minors (Sylvester): eigenvalues take LAPACK a microsecond for each matrix.
    """
    a, b, c = Sigma[..., 0, 0], Sigma[..., 1, 1], Sigma[..., 0, 1]
    minor = a * b - c * c
    if not (a.size and a.min() > 0 and minor.min() >= 0):
        return False
    if np.count_nonzero(c - Sigma[..., 1, 0]):
        return False
    if Sigma.shape[-1] == 2:
        return True
    e, f, g = Sigma[..., 0, 2], Sigma[..., 1, 2], Sigma[..., 2, 2]
    size = a + b + g
    determinant = g * minor + 2.0 * c * e * f - a * f * f - b * e * e
    sure = (minor > _ROUNDING * size * size) & (determinant > _ROUNDING * size * size * size)
    return bool(sure.all() and (e == Sigma[..., 2, 0]).all() and (f == Sigma[..., 2, 1]).all())
