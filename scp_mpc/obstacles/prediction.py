"""What the controller is told about one moving obstacle."""

from collections.abc import Hashable, Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scp_mpc.arrays import (
    FloatArray,
    as_array,
    as_number,
    frozen,
    require_positive_semidefinite,
)
from scp_mpc.errors import BoundsError, InvalidArgumentError, ShapeError


@dataclass(frozen=True, eq=False)
class ObstaclePrediction:
    """Gaussian positions N(mean_i, covariance_i) of a round obstacle at i = 0 .. N.

    Row 0 is now, or at `stamp` where that is given; the controller constrains rows 1 .. N.
    `dataclasses.replace(prediction, stamp=..., name=...)` adds what a predictor does not know.

    Args:
        means: (N+1, d) expected positions [m].
        covariances: (N+1, d, d) position covariances [m^2], or one (d, d) for all rows.
        radius: Radius of the obstacle [m].
        stamp: Time of row 0 [s], on the clock of `MPC.step`; None for now.
        name: Who it is, the same at every step, for example a tracker's number; None for nobody.

    Attributes:
        spread: (N+1,) largest standard deviation in any direction [m].

    Raises:
        InvalidArgumentError: An argument is not numeric, or the name is not hashable.
        ShapeError: The shapes do not belong together.
        NotFiniteError: NaN or infinity.
        CovarianceError: A covariance is not symmetric positive semi-definite.
        BoundsError: The radius is negative.
    """

    means: FloatArray
    covariances: FloatArray
    radius: float
    stamp: float | None
    name: Hashable
    spread: FloatArray = field(init=False)

    def __init__(
        self,
        means: ArrayLike,
        covariances: ArrayLike,
        radius: float,
        stamp: float | None = None,
        name: Hashable = None,
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
            _require_hashable(name)
        self._set(mu, Sigma, radius, stamp, name, variances)

    def moved(
        self, means: FloatArray, covariances: FloatArray, stamp: float | None
    ) -> "ObstaclePrediction":
        """Return the same obstacle elsewhere, unchecked: for what follows from checked arrays."""
        moved = object.__new__(ObstaclePrediction)
        variances = np.linalg.eigvalsh(covariances)
        moved._set(means, covariances, self.radius, stamp, self.name, variances)
        return moved

    def _set(
        self,
        means: FloatArray,
        covariances: FloatArray,
        radius: float,
        stamp: float | None,
        name: Hashable,
        variances: NDArray[np.floating],
    ) -> None:
        spread = np.sqrt(np.maximum(variances[:, -1], 0.0))
        object.__setattr__(self, "means", frozen(means))
        object.__setattr__(self, "covariances", frozen(covariances))
        object.__setattr__(self, "radius", radius)
        object.__setattr__(self, "stamp", stamp)
        object.__setattr__(self, "name", name)
        object.__setattr__(self, "spread", frozen(spread))

    @property
    def horizon(self) -> int:
        """Number of intervals N."""
        return len(self.means) - 1

    @property
    def dim(self) -> int:
        """Dimension of the workspace."""
        return int(self.means.shape[1])


def _require_hashable(name: object) -> None:
    try:
        hash(name)
    except TypeError:
        raise InvalidArgumentError("name", f"{name!r} is not hashable") from None


def as_predictions(obstacles: object) -> tuple[ObstaclePrediction, ...]:
    """Return any iterable of predictions as a tuple.

    Raises:
        InvalidArgumentError: It is none, or holds something else.
    """
    if isinstance(obstacles, ObstaclePrediction) or not isinstance(obstacles, Iterable):
        raise InvalidArgumentError("obstacles", f"{obstacles!r} is not a list of predictions")
    given = tuple(obstacles)
    for j, obstacle in enumerate(given):
        if not isinstance(obstacle, ObstaclePrediction):
            raise InvalidArgumentError(
                f"obstacles[{j}]", f"{obstacle!r} is not an ObstaclePrediction"
            )
    return given
