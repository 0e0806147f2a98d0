"""What the controller is told about one moving obstacle."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import (
    FloatArray,
    as_array,
    as_number,
    frozen,
    require_positive_semidefinite,
)
from scp_mpc.errors import BoundsError, ShapeError


@dataclass(frozen=True, eq=False)
class ObstaclePrediction:
    """Gaussian positions N(mean_i, covariance_i) of a round obstacle at i = 0 .. N.

    Row 0 is now; the controller constrains rows 1 .. N.

    Args:
        means: (N+1, d) expected positions [m].
        covariances: (N+1, d, d) position covariances [m^2], or one (d, d) for all rows.
        radius: Radius of the obstacle [m].

    Attributes:
        spread: (N+1,) largest standard deviation in any direction [m].

    Raises:
        ShapeError: The shapes do not belong together.
        NotFiniteError: NaN or infinity.
        CovarianceError: A covariance is not symmetric positive semi-definite.
        BoundsError: The radius is negative.
    """

    means: FloatArray
    covariances: FloatArray
    radius: float
    spread: FloatArray

    def __init__(self, means: ArrayLike, covariances: ArrayLike, radius: float) -> None:
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
        object.__setattr__(self, "means", frozen(mu))
        object.__setattr__(self, "covariances", frozen(Sigma))
        object.__setattr__(self, "radius", radius)
        spread = np.sqrt(np.maximum(variances[:, -1], 0.0))
        object.__setattr__(self, "spread", frozen(spread))

    @property
    def horizon(self) -> int:
        """Number of intervals N."""
        return len(self.means) - 1

    @property
    def dim(self) -> int:
        """Dimension of the workspace."""
        return int(self.means.shape[1])
