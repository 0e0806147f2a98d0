"""Hypothesis strategies: any problem and any control step that the library must survive."""

from dataclasses import dataclass

import numpy as np
from hypothesis import strategies as st

from scp_mpc import DoubleIntegrator, Margin, ObstaclePrediction, Problem

DT = 0.2

_seeds = st.integers(0, 2**32 - 1)


@dataclass(frozen=True)
class Step:
    """One control step."""

    x0: np.ndarray
    x_ref: np.ndarray
    obstacles: list

    @property
    def given(self):
        return self.x0, self.x_ref, self.obstacles


@st.composite
def covariances(draw, dim):
    """One (d, d) matrix: from a point over lines and discs to 1e12 m^2, in any orientation."""
    kind = draw(st.sampled_from(["point", "line", "disc", "any", "needle", "huge"]))
    deviations = {
        "point": st.just(0.0),
        "disc": st.just(draw(st.floats(1e-3, 1e6))),
    }.get(kind, st.floats(-6, 6).map(lambda e: 10.0**e))
    sigma = np.array([draw(deviations) for _ in range(dim)])
    if kind == "any":
        sigma = np.clip(sigma, 1e-2, 3.0)
    elif kind == "line":
        sigma = np.append(np.zeros(dim - 1), min(sigma[-1], 10.0))
    elif kind == "needle":
        sigma = np.append(np.zeros(dim - 1), sigma[-1])
    V = np.linalg.qr(np.random.default_rng(draw(_seeds)).normal(size=(dim, dim)))[0]
    Sigma = V @ np.diag(sigma**2) @ V.T
    return (Sigma + Sigma.T) / 2


@st.composite
def problems(draw, dim=2, horizons=(1, 3, 8), most=3, **changes):
    """A problem whose bounds need not contain zero and whose sizes may be fixed or free."""
    low = np.array(draw(st.lists(st.floats(-3, 2), min_size=dim, max_size=dim)))
    width = np.array(draw(st.lists(st.floats(0, 4), min_size=dim, max_size=dim)))
    reference = draw(st.sampled_from([0.0, 0.5, 1.6448536269514722, 2.4476519360399265]))
    margin = Margin(reference, draw(st.sampled_from([1.0, 0.5, 0.0])) * reference, reference + 1)
    values = {
        "model": DoubleIntegrator(DT, dim),
        "horizon": draw(st.sampled_from(horizons)),
        "Q": [0.2, 0.05] * dim,
        "R": [0.001] * dim,
        "u_min": low,
        "u_max": low + width,
        "robot_radius": draw(st.sampled_from([0.0, 0.15])),
        "margin": margin,
        "inflation": draw(st.sampled_from(["exact", "axes"])),
        "max_obstacles": most,
    }
    return Problem(**(values | changes))


@st.composite
def steps(draw, problem, far=(0.0, 1e6)):
    """A state, a reference and 0 .. M obstacles for a problem."""
    N, dim = problem.horizon, problem.model.dim
    rng = np.random.default_rng(draw(_seeds))
    x0 = rng.normal(size=2 * dim) + draw(st.sampled_from(far))
    x_ref = x0 + 3 * rng.normal(size=2 * dim)
    obstacles = []
    for _ in range(draw(st.integers(0, problem.max_obstacles))):
        where = draw(st.sampled_from(["on", "near", "about", "same", "path", "away"]))
        velocity = rng.normal(size=dim) * draw(st.sampled_from([0.0, 1.0, 5.0]))
        reach = {"on": 0.0, "near": 0.3, "away": 1e6}.get(where, 1.5)
        means = x0[::2] + reach * rng.normal(size=dim) + DT * np.outer(np.arange(N + 1), velocity)
        if where == "same" and obstacles:
            means = obstacles[-1].means
        elif where == "path":  # its mean is where the robot would be without inputs
            means = x0[::2] + DT * np.outer(np.arange(N + 1), x0[1::2])
        Sigma = draw(covariances(dim))
        if draw(st.booleans()):
            other = draw(covariances(dim))
            Sigma = np.array([Sigma if i % 2 else other for i in range(N + 1)])
        obstacles.append(ObstaclePrediction(means, Sigma, draw(st.sampled_from([0.0, 0.2]))))
    return Step(x0, x_ref, obstacles)
