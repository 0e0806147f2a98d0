"""A prediction that has grown old: moved on along itself, and less certain for it."""

import numpy as np

from scp_mpc.arrays import as_number, require_finite
from scp_mpc.errors import BoundsError
from scp_mpc.obstacles.prediction import ObstaclePrediction


def propagated(
    prediction: ObstaclePrediction, age: float, dt: float, growth: float
) -> ObstaclePrediction:
    """Return the same prediction, seen `age` seconds later.

    Row i becomes what was predicted for i + age/dt, see `ObstaclePrediction.interpolated`, plus a
    growth I, which is for what the prediction could not know.

    Args:
        prediction: N + 1 rows, `dt` apart.
        age: Seconds from its row 0 to row 0 of the result.
        dt: Interval between rows [s].
        growth: Variance that each second adds in every direction [m^2/s].

    Raises:
        BoundsError: A negative age or growth, dt not positive, or a result beyond 1e15.
    """
    age, growth = as_number("age", age), as_number("growth", growth)
    if age < 0:
        raise BoundsError("age", f"{age} s is negative")
    if growth < 0:
        raise BoundsError("growth", f"{growth} m^2/s is negative")
    if as_number("dt", dt) <= 0:
        raise BoundsError("dt", f"{dt} s is not positive")
    if age == 0:
        return prediction
    means, covariances = prediction.interpolated(np.arange(prediction.horizon + 1) + age / dt)
    covariances += age * growth * np.eye(prediction.dim)
    require_finite("age", np.append(means[-1], covariances[-1]))  # nothing else is as far out
    stamp = None if prediction.stamp is None else prediction.stamp + age
    return prediction.with_rows(means, covariances, stamp)
