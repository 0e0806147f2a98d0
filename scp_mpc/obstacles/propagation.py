"""A prediction that has grown old: moved on along itself, and less certain for it.

Notation:
    a       age [s]                             mu_i    (d,)    mean of row i
    w       whole part of a/dt                  Sigma_i (d, d)  covariance of row i
    f       the rest of a/dt, below 1           N       last row
    D       Sigma_N - Sigma_{N-1}               D+      its positive semi-definite part
"""

import numpy as np

from scp_mpc.arrays import FloatArray, as_number, require_finite
from scp_mpc.errors import BoundsError
from scp_mpc.obstacles.prediction import ObstaclePrediction


def propagated(
    prediction: ObstaclePrediction, age: float, dt: float, growth: float
) -> ObstaclePrediction:
    """Return the same prediction, seen `age` seconds later.

    Row i becomes what was predicted for i + w + f, plus a growth I:

    mu    = mu_{i+w}    + f (mu_{i+w+1} - mu_{i+w})               for i + w < N,
            mu_N        + (i + w + f - N) (mu_N - mu_{N-1})       after that
    Sigma = Sigma_{i+w} + f (Sigma_{i+w+1} - Sigma_{i+w})         for i + w < N,
            Sigma_N     + (i + w + f - N) D+                      after that

    Beyond the last row the mean goes on at the last interval's velocity, and the covariance goes
    on growing in the directions in which it grew last; it never shrinks there. `growth` is for
    what the prediction could not know.

    Args:
        prediction: N + 1 rows, `dt` apart.
        age: Seconds from its row 0 to row 0 of the result, a >= 0.
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
    mu, Sigma, N = prediction.means, prediction.covariances, prediction.horizon
    w, f = divmod(age / dt, 1.0)
    first = int(min(w, N))
    after = (w + f - N) + np.arange(N - first, N + 1)[:, None]
    D = positive_part(Sigma[N] - Sigma[N - 1])
    means = np.concatenate(
        [
            mu[first:N] + f * (mu[first + 1 :] - mu[first:N]),
            mu[N] + after * (mu[N] - mu[N - 1]),
        ]
    )
    covariances = np.concatenate(
        [
            Sigma[first:N] + f * (Sigma[first + 1 :] - Sigma[first:N]),
            Sigma[N] + after[..., None] * D,
        ]
    )
    covariances += age * growth * np.eye(prediction.dim)
    require_finite("age", np.append(means[N], covariances[N]))  # nothing else is as far out
    stamp = None if prediction.stamp is None else prediction.stamp + age
    return prediction.with_rows(means, covariances, stamp)


def positive_part(matrix: FloatArray) -> FloatArray:
    """The nearest positive semi-definite matrix to a symmetric one: itself if it is one."""
    values, vectors = np.linalg.eigh(matrix)
    if values[0] >= 0:
        return matrix
    part: FloatArray = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return (part + part.T) / 2
