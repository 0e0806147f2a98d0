"""An independent judge of plans: everything is computed again from what the caller handed over.

It shares no code with the package's geometry or solvers: dynamics in a plain loop, distances by
search over directions.

    distance(p) = max_{|n|=1}  n'(p - mu) - s sqrt(n' Sigma n)  -  r                   "exact"
    distance(p) = c (|y / e| - 1),  e = s sigma + r,  c = min(s_ref sigma + r)         "axes"

Any n gives a lower bound of "exact": a poor search can only make the judge stricter with a plan
that claims to be clear.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy import stats

TOLERANCE = 1e-6  # of a constraint [m] and of the dynamics, the settings' default
_ROUNDING = float(np.finfo(np.float64).eps)
_OK = ("CONVERGED", "FEASIBLE", "PREVIOUS", "BRAKING")
_NOT_OK = ("SOFTENED", "STOPPING", "VIOLATING", "FALLBACK", "STALE")


@dataclass(frozen=True)
class Verdict:
    """What is true of a plan.

    Attributes:
        states: (N+1, nx) where the inputs lead.
        cost: Objective there, slack not included.
        distances: (M, N) to the no-go sets at stages 1 .. N [m].
        allowed: (M, N) what of a violation is rounding, given the size of the numbers [m].
        complaints: What the plan says and is not so; empty for a true plan.
    """

    states: np.ndarray
    cost: float
    distances: np.ndarray
    allowed: np.ndarray
    complaints: list[str] = field(default_factory=list)

    @property
    def clear(self) -> bool:
        """Whether every constraint holds at the samples."""
        return bool((self.distances >= -self.allowed).all())


def judge(problem, x0, x_ref, obstacles, plan, robot_covariance=None) -> Verdict:
    """Compute again what a plan claims; see `Verdict`."""
    A, B = np.array(problem.model.A), np.array(problem.model.B)
    x0, x_ref = np.array(x0, dtype=float), np.array(x_ref, dtype=float)
    U, X, s = (np.array(v, dtype=float) for v in (plan.U, plan.X, plan.s))
    if x_ref.ndim == 1:
        x_ref = np.tile(x_ref, (len(U) + 1, 1))
    states = [x0]
    for u in U:
        states.append(A @ states[-1] + B @ u)
    states = np.array(states)
    margin = sizes(problem)
    cost = sum(
        e @ (problem.Qf if i == len(U) - 1 else problem.Q) @ e
        for i, e in enumerate(states[1:] - x_ref[1:])
    )
    cost += sum(u @ problem.R @ u for u in U)
    cost += margin.weight * float(np.square(s - margin.reference).sum())
    shape = (len(obstacles), len(U))
    distances, allowed = np.full(shape, np.inf), np.full(shape, TOLERANCE)
    size = np.broadcast_to(s if s.ndim == 2 else s[:, None], shape)
    positions = states[1:, problem.model.position]
    for j, obstacle in enumerate(obstacles if np.isfinite(states).all() else ()):
        Sigma = np.array(obstacle.covariances[1:])
        if robot_covariance is not None:
            Sigma = Sigma + np.array(robot_covariance)
        reach = problem.robot_radius + obstacle.radius
        given = positions, np.array(obstacle.means[1:]), Sigma, size[j], reach
        if problem.inflation == "exact":
            distances[j] = exact_distances(*given)
        else:
            distances[j] = axes_distances(*given, margin.reference)
        largest = np.abs(Sigma).max(axis=(1, 2))
        far = np.abs(positions).max(axis=1) + np.abs(obstacle.means[1:]).max(axis=1)
        # The root of an eigenvalue loses half its digits to the larger ones.
        allowed[j] += 8 * size[j] * np.sqrt(_ROUNDING * largest) + 64 * _ROUNDING * far
    allowed += 1e-10 * np.maximum(0.0, -distances).max(initial=0.0)  # all share one program
    verdict = Verdict(states, float(cost), distances, allowed)
    verdict.complaints.extend(_complaints(problem, plan, X, U, s, verdict))
    here = x0[problem.model.position]
    reach = [problem.robot_radius + o.radius for o in obstacles]
    gaps = [float(np.linalg.norm(here - o.means[0])) for o in obstacles]
    inside = [j for j, (gap, r) in enumerate(zip(gaps, reach, strict=True)) if gap < r]
    if plan.status.name != "STALE" and list(plan.contact) != inside:
        verdict.complaints.append(f"in contact with {inside}, not {plan.contact}")
    return verdict


def sizes(problem):
    """The margin in standard deviations, whatever it was asked for in."""
    return getattr(problem, "size", problem.margin)


def _sizes_hold(problem, s, stages) -> bool:
    """Whether sizes (M,) or (M, N) are within a margin's limits, or keep a promised risk."""
    margin, kind = problem.margin, type(problem.margin).__name__
    if kind == "StageRisk":
        return bool((stats.norm.sf(s) <= margin.delta * (1 + 1e-9)).all())
    if kind == "JointRisk":
        share = stats.norm.sf(s) * (stages if s.ndim == 1 else 1)
        return bool(share.sum() <= margin.delta * (1 + 1e-9))
    if kind == "Containment":
        return bool((stats.chi2.cdf(s**2, problem.model.dim) >= margin.level - 1e-9).all())
    return bool((s <= margin.upper + 1e-9).all() and (s >= margin.lower - 1e-9).all())


def exact_distances(p, mu, Sigma, s, reach) -> np.ndarray:
    """Signed distance (K,) of points (K, d) to s-sigma ellipsoids, s (K,), less `reach`."""
    offsets = p - mu
    _, V = np.linalg.eigh(Sigma)
    # Only to place the search: directions in the orthant of the axes in which the point lies.
    axes = V * np.where((offsets[:, None] @ V) < 0, -1.0, 1.0)

    def value(n):  # (K, G, d)
        width = np.einsum("kgi,kij,kgj->kg", n, Sigma, n)
        return np.einsum("kgi,ki->kg", n, offsets) - s[:, None] * np.sqrt(np.maximum(width, 0.0))

    search = _quarter if p.shape[1] == 2 else _octant
    return search(value, axes) - reach


def axes_distances(p, mu, Sigma, s, reach, s_ref) -> np.ndarray:
    """The report's constraint (K,) in metres; see the module."""
    out = []
    for point, mean, covariance, size in zip(p, mu, Sigma, s, strict=True):
        variances, V = np.linalg.eigh(covariance)
        sigma = np.sqrt(np.maximum(variances, 0.0))
        e = np.maximum(size * sigma + reach, 1e-9)
        c = max(float((s_ref * sigma + reach).min()), 1e-9)
        out.append(c * (np.linalg.norm(V.T @ (point - mean) / e) - 1))
    return np.array(out)


def _fan(linear: int, fine: int) -> np.ndarray:
    """Angles from 0 to a right angle, ever denser towards both ends: thin ellipses turn there."""
    ends = np.geomspace(1e-12, 0.02, fine)
    middle = np.linspace(0.02, np.pi / 2 - 0.02, linear)
    return np.concatenate([[0.0], ends, middle[1:-1], np.pi / 2 - ends[::-1], [np.pi / 2]])


def _bracketed(grid, best):
    return grid[np.maximum(best - 1, 0)], grid[np.minimum(best + 1, len(grid) - 1)]


def _quarter(value, axes) -> np.ndarray:
    """Largest value over n = cos(t) a + sin(t) b, t from 0 to a right angle; (K, 2, 2) axes."""

    def at(t):  # (K, G)
        n = np.cos(t)[..., None] * axes[:, None, :, 0] + np.sin(t)[..., None] * axes[:, None, :, 1]
        return value(n)

    grid = _fan(121, 40)
    values = at(np.tile(grid, (len(axes), 1)))
    low, high = _bracketed(grid, values.argmax(axis=1))
    most = values.max(axis=1)
    for _ in range(9):
        t = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, 21)
        values = at(t)
        best, k = values.argmax(axis=1), np.arange(len(t))
        most = np.maximum(most, values.max(axis=1))
        low, high = t[k, np.maximum(best - 1, 0)], t[k, np.minimum(best + 1, 20)]
    return most


def _octant(value, axes) -> np.ndarray:
    """The same in space, over two angles; (K, 3, 3) axes."""

    def at(t, f):  # (K, G)
        parts = np.cos(f) * np.cos(t), np.cos(f) * np.sin(t), np.sin(f)
        return value(sum(c[..., None] * axes[:, None, :, k] for k, c in enumerate(parts)))

    def whole(ts, fs):  # (K, G) each
        t, f = ts[:, :, None], fs[:, None, :]
        shape = len(ts), ts.shape[1], fs.shape[1]
        pairs = [np.broadcast_to(a, shape).reshape(len(ts), -1) for a in (t, f)]
        values = at(*pairs)
        best = values.argmax(axis=1)
        return values.max(axis=1), best // shape[2], best % shape[2]

    grid, k = _fan(41, 16), np.arange(len(axes))
    full = np.tile(grid, (len(axes), 1))
    most, i, j = whole(full, full)
    (t0, t1), (f0, f1) = _bracketed(grid, i), _bracketed(grid, j)
    for _ in range(12):
        share = np.linspace(0.0, 1.0, 13)
        ts, fs = t0[:, None] + (t1 - t0)[:, None] * share, f0[:, None] + (f1 - f0)[:, None] * share
        better, i, j = whole(ts, fs)
        most = np.maximum(most, better)
        t0, t1 = ts[k, np.maximum(i - 2, 0)], ts[k, np.minimum(i + 2, 12)]
        f0, f1 = fs[k, np.maximum(j - 2, 0)], fs[k, np.minimum(j + 2, 12)]
    return most


def _complaints(problem, plan, X, U, s, verdict) -> list[str]:
    """What is not so, as sentences; the first of them makes the rest pointless if not finite."""
    slack = np.array(plan.slack)
    if not all(np.isfinite(v).all() for v in (X, U, s, slack, plan.cost)):
        return ["not finite"]
    said = []
    status = plan.status.name
    over = max(float((U - problem.u_max).max()), float((problem.u_min - U).max()))
    if (plan.u0 > problem.u_max).any() or (plan.u0 < problem.u_min).any() or over > 1e-9:
        said.append(f"an input is {over:.3g} beyond its limit")
    if not _sizes_hold(problem, s, slack.shape[1]):
        said.append(f"a size is not what was asked for: {s}")
    scale = max(1.0, float(np.abs(verdict.states).max()))
    defect = float(np.abs(X - verdict.states).max())
    if defect > TOLERANCE * scale:
        said.append(f"the states do not follow from the inputs by {defect:.3g}")
    if abs(plan.cost - verdict.cost) > 1e-6 * max(1.0, abs(verdict.cost)):
        said.append(f"the cost is {verdict.cost:.9g}, not {plan.cost:.9g}")
    if plan.ok != (status in _OK and not plan.contact) or status not in _OK + _NOT_OK:
        said.append(f"{status} may not say ok = {plan.ok}")
    violation = np.maximum(0.0, -verdict.distances)
    worst = float(violation.max(initial=0.0))
    if status in _OK and not verdict.clear:
        said.append(f"{status}, but a constraint is violated by {worst:.3g} m")
    # What is violated between the samples does not show at them.
    sampled = getattr(problem, "nodes_per_interval", 1) == 1
    rounding = verdict.allowed - TOLERANCE
    holds = not (violation + rounding > TOLERANCE).any()
    if status in _NOT_OK and status != "STALE" and sampled and holds:
        said.append(f"{status}, but every constraint holds (to {worst:.3g} m)")
    hidden = violation - slack - verdict.allowed
    if (hidden > 0).any():
        depth = violation.flat[hidden.argmax()]
        said.append(f"a violation of {depth:.3g} m is hidden by {hidden.max():.3g} m")
    invented = slack - violation - verdict.allowed
    if sampled and (invented > 0).any():
        depth = slack.flat[invented.argmax()]
        said.append(f"slack of {depth:.3g} m is invented by {invented.max():.3g} m")
    return said
