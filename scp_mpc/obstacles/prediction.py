"""What the controller is told about one moving obstacle."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scp_mpc.arrays import (
    FloatArray,
    as_array,
    as_count,
    as_number,
    frozen,
    require_interval,
    require_positive_semidefinite,
)
from scp_mpc.errors import BoundsError, GeometryError, InvalidArgumentError, ShapeError
from scp_mpc.obstacles.solid import Solid

_NEAR = 0.1  # of a body's size, beyond its faces, that counts as within
_SAME = 1e-6  # of it, from its middle, that counts as there


@dataclass(frozen=True, eq=False)
class ObstaclePrediction:
    """Gaussian positions N(mean_i, covariance_i) of an obstacle at i = 0 .. N.

    It is a ball, or a polytope that does not turn, with the origin of its frame at the position.

    Row 0 is now, or at `stamp` where that is given; the controller constrains rows 1 .. N.
    `dataclasses.replace(prediction, stamp=..., name=...)` adds what a predictor does not know.
    Rows are `dt` seconds apart. A robot with another interval refuses them, see `resampled`; where
    `dt` is None, as by default for arrays made by hand, they are believed to be at the robot's.

    Args:
        means: (N+1, d) expected positions [m].
        covariances: (N+1, d, d) position covariances [m^2], or one (d, d) for all rows.
        radius: Radius of the obstacle, or by which its shape is rounded [m].
        stamp: Time of row 0 [s], on the clock of `MPC.step`; None for now.
        name: Who it is, the same at every step, for example a tracker's number; None for nobody.
        shape: A `Polytope`, its corners relative to the means; None for a ball. Of its covariances
            the largest standard deviation counts, in all directions; zero ones make it a wall.
        dt: Interval between rows [s]; None for the robot's.

    Attributes:
        largest_std: (N+1,) largest standard deviation in any direction [m].

    Raises:
        InvalidArgumentError: An argument is not numeric, or the name is not hashable.
        ShapeError: The shapes do not belong together.
        NotFiniteError: NaN or infinity.
        CovarianceError: A covariance is not symmetric positive semi-definite.
        BoundsError: The radius is negative, or dt not positive.
        GeometryError: Corners and means seem to be world coordinates both.
    """

    means: FloatArray
    covariances: FloatArray
    radius: float
    stamp: float | None
    name: Hashable
    shape: Solid | None
    dt: float | None
    largest_std: FloatArray = field(init=False)

    def __init__(
        self,
        means: ArrayLike,
        covariances: ArrayLike,
        radius: float,
        stamp: float | None = None,
        name: Hashable = None,
        shape: Solid | None = None,
        dt: float | None = None,
    ) -> None:
        """Copy, check and freeze."""
        mu = as_array("means", means, (-1, 2), (-1, 3))
        rows, dim = mu.shape
        if rows < 2:
            raise ShapeError("means", f"{rows} row(s); a prediction needs now and a future")
        Sigma = as_array("covariances", covariances, (rows, dim, dim), (dim, dim))
        if Sigma.ndim == 2:
            Sigma = np.repeat(Sigma[None], rows, axis=0)
        variances = require_positive_semidefinite("covariances", Sigma)
        radius = as_number("radius", radius)
        if radius < 0:
            raise BoundsError("radius", f"{radius} m is negative")
        if stamp is not None:
            stamp = as_number("stamp", stamp)
        if name is not None:
            require_hashable("name", name)
        if shape is not None:
            require_solid("shape", shape, dim)
            require_own_frame("shape", shape, mu[0])
        if dt is not None:
            dt = as_number("dt", dt)
            if dt <= 0:
                raise BoundsError("dt", f"{dt} s is not positive")
        self._set(mu, Sigma, radius, stamp, name, shape, dt, deviations(variances))

    @classmethod
    def static(
        cls,
        horizon: int,
        at: ArrayLike,
        radius: float,
        name: Hashable = None,
        shape: Solid | None = None,
    ) -> "ObstaclePrediction":
        """Return the prediction of what stays where it is, for certain: a pillar, a wall.

        Args:
            horizon: N, as in the problem.
            at: (d,) position [m].
            radius: Radius of a disc or ball, or by which the shape is rounded [m].
            name: Who it is.
            shape: A `Polytope`; None for a ball.
        """
        rows = as_count("horizon", horizon) + 1
        position = as_array("at", at, (2,), (3,))
        dim = len(position)
        return cls(
            np.tile(position, (rows, 1)), np.zeros((dim, dim)), radius, name=name, shape=shape
        )

    def with_rows(
        self, means: FloatArray, covariances: FloatArray, stamp: float | None
    ) -> "ObstaclePrediction":
        """Return the same obstacle elsewhere, unchecked: for what follows from checked arrays."""
        other = object.__new__(ObstaclePrediction)
        largest_std = deviations(np.linalg.eigvalsh(covariances))
        kept = self.radius, stamp, self.name, self.shape, self.dt
        other._set(means, covariances, *kept, largest_std)
        return other

    def interpolated(self, rows: NDArray[Any]) -> tuple[FloatArray, FloatArray]:
        """Return means (n, d) and covariances (n, d, d) at rows (n,), which need not be whole.

        Both are linear between two rows. Beyond the last one the mean goes on at the last
        interval's velocity, and the covariance goes on growing in the directions in which it grew
        last, never shrinking. Before the first one the mean goes back, and nothing is surer.
        """
        mu, Sigma, N = self.means, self.covariances, self.horizon
        k = np.clip(np.floor(rows), 0, N).astype(np.intp)
        f, after = (rows - k)[:, None], np.minimum(k + 1, N)
        last = np.minimum(k, N - 1)
        means = mu[k] + f * (mu[last + 1] - mu[last])
        covariances = Sigma[k] + np.maximum(f, 0.0)[..., None] * (Sigma[after] - Sigma[k])
        beyond = np.maximum(rows - N, 0.0)[:, None, None]
        if beyond.any():
            covariances += beyond * positive_part(Sigma[N] - Sigma[N - 1])
        return means, covariances

    def resampled(self, dt: float, horizon: int) -> "ObstaclePrediction":
        """Return the same prediction for a robot with another interval, see `interpolated`.

        Args:
            dt: Between the rows of the result [s].
            horizon: N of the result; it may look farther ahead than this prediction.

        Raises:
            InvalidArgumentError: Or a subclass: this prediction's own interval is not known.
        """
        if self.dt is None:
            raise InvalidArgumentError("dt", "not known: replace(prediction, dt=...)")
        if as_number("dt", dt) <= 0:
            raise BoundsError("dt", f"{dt} s is not positive")
        rows = np.arange(as_count("horizon", horizon) + 1) * (dt / self.dt)
        other = self.with_rows(*self.interpolated(rows), self.stamp)
        object.__setattr__(other, "dt", float(dt))
        return other

    def _set(
        self,
        means: FloatArray,
        covariances: FloatArray,
        radius: float,
        stamp: float | None,
        name: Hashable,
        shape: Solid | None,
        dt: float | None,
        largest_std: FloatArray,
    ) -> None:
        object.__setattr__(self, "means", frozen(means))
        object.__setattr__(self, "covariances", frozen(covariances))
        object.__setattr__(self, "radius", radius)
        object.__setattr__(self, "stamp", stamp)
        object.__setattr__(self, "name", name)
        object.__setattr__(self, "shape", shape)
        object.__setattr__(self, "dt", dt)
        object.__setattr__(self, "largest_std", frozen(largest_std))

    @property
    def horizon(self) -> int:
        """Number of intervals N."""
        return len(self.means) - 1

    @property
    def dim(self) -> int:
        """Dimension of the workspace."""
        return int(self.means.shape[1])


def deviations(variances: NDArray[np.floating]) -> FloatArray:
    """Roots (...) of the largest eigenvalues of covariances, given all (..., d), ascending."""
    return np.sqrt(np.maximum(variances[..., -1], 0.0))


def positive_part(matrix: FloatArray) -> FloatArray:
    """The nearest positive semi-definite matrix to a symmetric one: itself if it is one."""
    values, vectors = np.linalg.eigh(matrix)
    if values[0] >= 0:
        return matrix
    part: FloatArray = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return (part + part.T) / 2


def require_hashable(argument: str, name: object) -> None:
    """Raise unless a name can be one."""
    try:
        hash(name)
    except TypeError:
        raise InvalidArgumentError(argument, f"{name!r} is not hashable") from None


def require_solid(argument: str, shape: object, dim: int) -> None:
    """Raise unless it is a body in so many dimensions."""
    if not isinstance(shape, Solid):
        raise InvalidArgumentError(argument, f"{shape!r} is not a Polytope")
    if shape.dim != dim:
        raise ShapeError(argument, f"{shape.dim}-dimensional, but the means are {dim}-dimensional")


def require_own_frame(argument: str, shape: Solid, mean: FloatArray) -> None:
    """Raise if a body's corners are around its mean: then they would be offset by it once more.

    A frame's origin may be outside of the body, and the obstacle may pass where its corners are in
    their own frame. Both at once are refused if the origin is farther away than the body is large
    and the mean within, or if the mean is the very middle of the corners.
    """
    middle = shape.vertices.mean(axis=0)
    size = float(np.linalg.norm(shape.vertices - middle, axis=1).max())
    outside = float((-shape.offsets).max())  # of the origin, from the farthest of the faces
    within = bool((shape.normals @ mean <= shape.offsets + _NEAR * size).all())
    centred = float(np.linalg.norm(mean - middle)) <= _SAME * size
    if (within and outside > size) or (centred and outside > 0):
        offset = float(np.linalg.norm(mean))
        raise GeometryError(
            argument,
            f"its corners are around the mean {mean.tolist()}: offset by {offset:.3g} m twice. "
            "Corners are relative to the mean",
        )


def unchecked_predictions(
    means: FloatArray,
    covariances: FloatArray,
    radius: float,
    stamp: float,
    names: Sequence[Hashable],
    dt: float,
) -> list[ObstaclePrediction]:
    """Return many predictions at once, unchecked: for what a tracker has made of checked arrays.

    Args:
        means: (n, N+1, d) [m], given away.
        covariances: (n, N+1, d, d) [m^2], given away.
        radius: Of each [m].
        stamp: Time of row 0 [s].
        names: n of them.
        dt: Interval between rows [s].
    """
    largest_stds = deviations(np.linalg.eigvalsh(covariances))
    made = []
    for mu, Sigma, largest_std, name in zip(means, covariances, largest_stds, names, strict=True):
        made.append(object.__new__(ObstaclePrediction))
        made[-1]._set(mu, Sigma, radius, stamp, name, None, dt, largest_std)
    return made


def require_fitting(
    obstacles: Sequence[ObstaclePrediction], horizon: int, dim: int, dt: float
) -> None:
    """Check that predictions are over a robot's horizon N, in its workspace and at its interval.

    Raises:
        ShapeError: Other rows or another dimension.
        InvalidArgumentError: Another interval.
    """
    for j, obstacle in enumerate(obstacles):
        if obstacle.means.shape != (horizon + 1, dim):
            raise ShapeError(
                f"obstacles[{j}].means",
                f"shape {obstacle.means.shape} is not {(horizon + 1, dim)}",
            )
        if obstacle.dt is not None and obstacle.dt != dt:
            remedy = f"prediction.resampled({dt:g}, {horizon})"
            require_interval(f"obstacles[{j}].dt", obstacle.dt, dt, remedy)
