"""True paths of an obstacle that are consistent with what the controller is told about it.

A prediction gives a Gaussian for each sample time, but not how their errors hang together. Each
coupling below has exactly the predicted marginals, N(mu_i, Sigma_i) at every i:

    offset      o_i = mu_i + S_i z,  one z ~ N(0, I): one error, shaped anew at each stage
    velocity    o_i = mu_i + e + i w,  e ~ N(0, Sigma_0), w ~ N(0, V): a constant unknown velocity;
                only where Sigma_i = Sigma_0 + i^2 V
    walk        o_i = o_{i-1} + mu_i - mu_{i-1} + e_i,  e_i ~ N(0, Sigma_i - Sigma_{i-1}),
                independent; only where these increments are positive semi-definite

Between two samples an obstacle moves in a straight line.

Notation:
    mu, Sigma   (N+1, d), (N+1, d, d)   the prediction [m], [m^2]
    S           (..., d, d)             symmetric square root of Sigma
"""

from collections.abc import Callable
from typing import Literal

import numpy as np

from scp_mpc.arrays import FloatArray, as_count
from scp_mpc.errors import CovarianceError, InvalidArgumentError
from scp_mpc.obstacles.prediction import ObstaclePrediction

Coupling = Literal["offset", "velocity", "walk"]

COUPLINGS: tuple[Coupling, ...] = ("offset", "velocity", "walk")
_ROUNDING = 1e-9  # relative to the largest entry of all covariances


def sample_paths(
    prediction: ObstaclePrediction,
    count: int,
    rng: np.random.Generator,
    coupling: Coupling = "offset",
) -> FloatArray:
    """Draw obstacle paths (count, N+1, d) [m] whose marginals are those of the prediction.

    Args:
        prediction: What the controller is told.
        count: Number of paths.
        rng: Where randomness comes from.
        coupling: How the errors of different stages hang together.

    Raises:
        InvalidArgumentError: The coupling is unknown, or `count` is not a whole number.
        CovarianceError: The coupling has no such marginals.
    """
    count = as_count("count", count)
    mu, Sigma = prediction.means, prediction.covariances
    stages, dim = mu.shape
    if coupling == "offset":
        z = rng.standard_normal((count, dim))
        return mu + _times(_root(Sigma), z[:, None])
    if coupling == "velocity":
        first, drift = _root(Sigma[0]), _root(_drift(Sigma))
        e, w = (_times(S, rng.standard_normal((count, 1, dim))) for S in (first, drift))
        return mu + e + np.arange(stages)[:, None] * w
    if coupling == "walk":
        steps = np.concatenate([Sigma[:1], _increments(Sigma)])
        e = _times(_root(steps), rng.standard_normal((count, stages, dim)))
        return mu + np.cumsum(e, axis=1)
    raise InvalidArgumentError("coupling", f"{coupling!r} is none of {', '.join(COUPLINGS)}")


def applicable_couplings(prediction: ObstaclePrediction) -> tuple[Coupling, ...]:
    """The couplings that the prediction allows and that differ: a constant Sigma has one."""
    Sigma = prediction.covariances
    if np.abs(Sigma - Sigma[0]).max() <= _allowed(Sigma):
        return ("offset",)
    found: list[Coupling] = ["offset"]
    checks: dict[Coupling, Callable[[FloatArray], FloatArray]]
    checks = {"velocity": _drift, "walk": _increments}
    for coupling, check in checks.items():
        try:
            check(Sigma)
        except CovarianceError:
            continue
        found.append(coupling)
    return tuple(found)


def _drift(Sigma: FloatArray) -> FloatArray:
    """V (d, d) with Sigma_i = Sigma_0 + i^2 V."""
    i2 = np.square(np.arange(len(Sigma)))[:, None, None]
    V = (Sigma[-1] - Sigma[0]) / i2[-1]
    errors = np.abs(Sigma - Sigma[0] - i2 * V).max(axis=(1, 2))
    if errors.max() > _allowed(Sigma):
        at = int(errors.argmax())
        raise CovarianceError(
            "covariances",
            f"matrix {at} is {errors[at]:.3g} m^2 off Sigma_0 + i^2 V: no constant velocity",
        )
    _require_growth(V[None], _allowed(Sigma))
    return V


def _increments(Sigma: FloatArray) -> FloatArray:
    """Sigma_i - Sigma_{i-1} (N, d, d)."""
    increments = np.diff(Sigma, axis=0)
    _require_growth(increments, _allowed(Sigma))
    return increments


def _require_growth(increments: FloatArray, allowed: float) -> None:
    smallest = np.linalg.eigvalsh(increments)[:, 0]
    if smallest.min() < -allowed:
        at = int(smallest.argmin())
        raise CovarianceError(
            "covariances",
            f"increment {at + 1} is not positive semi-definite "
            f"(smallest eigenvalue {smallest[at]:.3g} m^2): errors do not vanish again",
        )


def _allowed(Sigma: FloatArray) -> float:
    return _ROUNDING * float(np.abs(Sigma).max())


def _root(Sigma: FloatArray) -> FloatArray:
    variances, R = np.linalg.eigh(Sigma)
    deviations = np.sqrt(np.maximum(variances, 0.0))
    return (R * deviations[..., None, :]) @ np.swapaxes(R, -2, -1)


def _times(S: FloatArray, z: FloatArray) -> FloatArray:
    """S z for S (d, d) or (N+1, d, d) and z (count, 1 or N+1, d)."""
    return np.einsum("...ij,n...j->n...i", S, z)
