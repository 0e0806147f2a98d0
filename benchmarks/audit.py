"""An audit of plans from the caller's data alone, for millions of them.

Plain numpy; nothing of the package's geometry or solvers, whose faults it is there to find.

Notation:
    y       (K, d)  p - mu of the pairs of obstacle and stage that are near
    n       (K, d)  unit vectors    sd = max_n  n'y - s sqrt(n' Sigma n)
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm

from benchmarks.peers.nlp import linear_model, require_round
from scp_mpc.arrays import FloatArray
from scp_mpc.geometry.margin import JointRisk, StageRisk
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.scp.plan import Plan

_TOLERANCE = 1e-6  # [m], that of the settings
_ROUNDING = float(np.finfo(np.float64).eps)
_LEAST = 1e-40  # of t, relative
_HALVINGS = 60  # of a range of forty decades


@dataclass(frozen=True)
class Finding:
    """What is wrong with a plan; empty strings for nothing.

    Attributes:
        invalid: The inputs cannot be applied: shape, not finite, or beyond their limits.
        lie: The plan says that every constraint holds, and one does not.
    """

    invalid: str = ""
    lie: str = ""


def audit(
    problem: Problem, x0: FloatArray, obstacles: Sequence[ObstaclePrediction], plan: Plan
) -> Finding:
    """Compute again what a plan says.

    Args:
        problem: What was solved.
        x0: (nx,) state now.
        obstacles: M predictions.
        plan: The outcome.
    """
    U = plan.U
    if U.shape != (problem.horizon, problem.model.nu):
        return Finding(invalid=f"inputs of shape {U.shape}")
    if not np.isfinite(U).all():
        return Finding(invalid="inputs are not finite")
    first = ((plan.u0 < problem.u_min) | (plan.u0 > problem.u_max)).any()
    over = max(float((U - problem.u_max).max()), float((problem.u_min - U).max()))
    if first or over > 1e-9:
        return Finding(invalid=f"an input is {over:.3g} beyond its limit")
    change = np.diff(U, axis=0)
    over = max((change - problem.du_max).max(initial=0), (problem.du_min - change).max(initial=0))
    if over > 1e-8:
        return Finding(invalid=f"a rate is {over:.3g} beyond its limit")
    if not plan.ok:
        return Finding()
    states = _states(problem, x0, U)
    defect = float(np.abs(states - plan.X).max())
    if not defect <= _TOLERANCE * max(1.0, float(np.abs(states).max())):
        return Finding(lie=f"{plan.status.name}: the states do not follow by {defect:.3g}")
    x = states[1:]
    over = max(float((x - problem.x_max).max()), float((problem.x_min - x).max()))
    if over > _TOLERANCE * max(1.0, float(np.abs(states).max())):
        return Finding(lie=f"{plan.status.name}: a state is {over:.3g} beyond its bound")
    positions = x[:, problem.model.position]
    depth = _depth(problem, positions, obstacles, _sizes(problem, plan.s))
    if depth > 0:
        return Finding(lie=f"{plan.status.name}: a constraint is violated by {depth:.3g} m")
    return Finding()


def _states(problem: Problem, x0: FloatArray, U: FloatArray) -> FloatArray:
    model = linear_model(problem)
    A, B = model.A, model.B
    states = [x0]
    for u in U:
        states.append(A @ states[-1] + B @ u)
    return np.array(states)


def _depth(
    problem: Problem,
    positions: FloatArray,
    obstacles: Sequence[ObstaclePrediction],
    s: FloatArray,
) -> float:
    """Largest violation at the samples [m] beyond what rounding explains; 0 for none."""
    if not obstacles:
        return 0.0
    require_round(obstacles)
    means = np.array([o.means[1:] for o in obstacles])
    Sigma = np.array([o.covariances[1:] for o in obstacles])
    shape = means.shape[:2]
    reach = problem.robot_radius + np.array([o.radius for o in obstacles])
    y = positions - means
    sizes = np.broadcast_to(s if s.ndim == 2 else s[:, None], shape)
    reaches = np.broadcast_to(reach[:, None], shape)
    largest = np.abs(Sigma).max(axis=(2, 3))
    far = np.abs(positions).max() + np.abs(means).max()
    allowed = _TOLERANCE + 8 * sizes * np.sqrt(_ROUNDING * largest) + 64 * _ROUNDING * far
    # One direction proves most pairs clear.
    length = np.maximum(np.linalg.norm(y, axis=2), 1e-300)
    n = y / length[..., None]
    width = np.einsum("mni,mnij,mnj->mn", n, Sigma, n)
    near = length - sizes * np.sqrt(np.maximum(width, 0.0)) < reaches
    if not near.any():
        return 0.0
    given = y[near], Sigma[near], sizes[near], reaches[near]
    axes = problem.inflation == "axes"
    outside = _axes(*given, problem.size.reference) if axes else _exact(*given)
    return max(0.0, float((-outside - allowed[near]).max()))


def _sizes(problem: Problem, s: FloatArray) -> FloatArray:
    """What each sample must keep at least: a share of a risk is never more than all of it."""
    margin = problem.margin
    if isinstance(margin, StageRisk | JointRisk):
        return np.full(len(s), float(norm.isf(margin.delta)))
    return s


def _axes(
    y: FloatArray, Sigma: FloatArray, s: FloatArray, reach: FloatArray, s_ref: float
) -> FloatArray:
    """The report's constraint (K,) in metres: c (|y / e| - 1)."""
    variances, V = np.linalg.eigh(Sigma)
    sigma = np.sqrt(np.maximum(variances, 0.0))
    e = np.maximum(s[:, None] * sigma + reach[:, None], 1e-9)
    c = np.maximum(s_ref * sigma.min(axis=1) + reach, 1e-9)
    along = np.einsum("kji,kj->ki", V, y)
    distance: FloatArray = c * (np.linalg.norm(along / e, axis=1) - 1)
    return distance


def _exact(y: FloatArray, Sigma: FloatArray, s: FloatArray, reach: FloatArray) -> FloatArray:
    """Signed distance (K,) to ellipsoid (+) ball, exact outside the ellipsoid, from below inside.

    The outward normal is proportional to y_l / (t + e_l^2) along the axes, where t >= 0 solves
    sum_l (e_l y_l / (t + e_l^2))^2 = 1: found by bisection. Whatever n it is, n'y - s sqrt(n'
    Sigma n) is no more than the distance.
    """
    variances, V = np.linalg.eigh(Sigma)
    e2 = s[:, None] ** 2 * np.maximum(variances, 0.0)
    along = np.einsum("kji,kj->ki", V, y)
    high = np.maximum(np.linalg.norm(np.sqrt(e2) * along, axis=1), _LEAST)
    low = high * _LEAST
    for _ in range(_HALVINGS):
        t = np.sqrt(low * high)
        outside = (e2 * np.square(along / (t[:, None] + e2))).sum(axis=1) > 1
        low, high = np.where(outside, t, low), np.where(outside, high, t)
    n = along / (high[:, None] + e2)
    n /= np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-300)
    n = np.einsum("kij,kj->ki", V, n)
    width = np.einsum("ki,kij,kj->k", n, Sigma, n)
    distance: FloatArray = np.einsum("ki,ki->k", n, y) - s * np.sqrt(np.maximum(width, 0.0))
    return distance - reach
