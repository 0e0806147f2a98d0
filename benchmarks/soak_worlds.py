"""Random worlds for the soak: who stands where, how well it is known, and what goes wrong."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.errors import NotFiniteError, ScpMpcError, ShapeError
from scp_mpc.geometry.margin import JointRisk, Margin, StageRisk
from scp_mpc.models.double_integrator import DoubleIntegrator
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.settings import Settings

SLOTS = 6
_DT = 0.2  # [s]
_FREE = Margin(lower=0.5)
_SHORT = 1e-6  # [s] no time at all
_UNTIMED = Settings(deadline=None)  # the same plans on any machine
_KNOWN = ("disc", "ellipse", "line", "point", "huge", "needle")
_SHARES = (0.5, 0.32, 0.1, 0.05, 0.015, 0.015)
_COUNTS = (0.2, 0.25, 0.2, 0.15, 0.1, 0.05, 0.05)  # of 0 .. SLOTS obstacles
_ABSENT = 0.05  # chance that an obstacle is not seen in a step
_STAMPED = 0.5  # share of the episodes in which predictions have stamps and names
_LATE = (0.8, 0.19, 0.01)  # chances that they are on time, late, too late
_ON_THE_ROBOT = 0.03  # chance per obstacle at the start
_CARRIED_OFF = 0.005  # chance per step


@dataclass(frozen=True)
class Kind:
    """A problem and how it is solved.

    Attributes:
        name: In tables.
        share: Of the episodes, relative to the others.
        problem: What is solved.
        settings: How.
    """

    name: str
    share: float
    problem: Problem
    settings: Settings


def kinds() -> list[Kind]:
    """The problems of the soak; short horizons more often, which makes a million steps possible."""
    rows: list[tuple[str, float, int, dict[str, Any], Settings]] = [
        ("exact", 4, 8, {}, _UNTIMED),
        ("axes", 3, 8, {"inflation": "axes"}, _UNTIMED),
        ("free size", 2, 8, {"margin": _FREE}, _UNTIMED),
        ("axes, free size", 1, 8, {"inflation": "axes", "margin": _FREE}, _UNTIMED),
        ("samples alone", 2, 8, {"nodes_per_interval": 1}, _UNTIMED),
        ("stage risk", 2, 8, {"margin": StageRisk(0.05)}, _UNTIMED),
        ("joint risk", 1, 8, {"margin": JointRisk(0.05)}, _UNTIMED),
        ("joint risk, iterative", 0.5, 8, {"margin": JointRisk(0.05, "iterative")}, _UNTIMED),
        ("biased limits", 2, 8, {"u_min": [-0.2, 0.3], "u_max": [2.0, 1.5]}, _UNTIMED),
        (
            "in space",
            1,
            8,
            {"model": DoubleIntegrator(_DT, 3)},
            replace(_UNTIMED, multi_start=False),
        ),
        ("no time", 3, 8, {}, Settings(deadline=_SHORT)),
        ("rescue", 0.3, 8, {}, replace(_UNTIMED, solver="piqp", multi_start=False)),
        ("two iterations", 2, 15, {}, replace(_UNTIMED, max_iterations=2)),
        ("stage risk", 0.5, 15, {"margin": StageRisk(0.05)}, _UNTIMED),
        ("2 ms", 2, 30, {}, Settings(deadline=2e-3)),
        ("exact", 0.5, 30, {}, _UNTIMED),
    ]
    return [
        Kind(f"{name}, N = {horizon}", share, _problem(horizon, **changes), settings)
        for name, share, horizon, changes, settings in rows
    ]


def _problem(horizon: int, **changes: Any) -> Problem:
    dim = changes.get("model", DoubleIntegrator(_DT)).dim
    values: dict[str, Any] = {
        "model": DoubleIntegrator(_DT),
        "horizon": horizon,
        "Q": [0.2, 0.05] * dim,
        "R": [0.001] * dim,
        "u_min": -3.0,
        "u_max": 3.0,
        "robot_radius": 0.15,
        "max_obstacles": SLOTS,
    }
    return Problem(**(values | changes))


@dataclass(frozen=True, eq=False)
class Mover:
    """One obstacle: p(t) = position + t velocity, known with covariance (1 + growth i) Sigma."""

    position: FloatArray
    velocity: FloatArray
    Sigma: FloatArray
    growth: float
    radius: float

    def prediction(self, step: int, horizon: int) -> ObstaclePrediction:
        """What the controller is told at a step."""
        i = np.arange(horizon + 1)
        means = self.position + _DT * np.outer(i + step, self.velocity)
        return ObstaclePrediction(
            means, (1 + self.growth * i)[:, None, None] * self.Sigma, self.radius
        )


class World:
    """One episode: a robot that drives to and fro, obstacles on its way, wind and worse.

    Args:
        problem: Whose robot it is.
        rng: Where all chance comes from.
    """

    def __init__(self, problem: Problem, rng: np.random.Generator) -> None:
        """Place everybody."""
        self._problem, self._rng, self._step = problem, rng, 0
        dim = problem.model.dim
        self.x = np.zeros(problem.model.nx)
        self.x[1::2] = rng.normal(0.0, 1.0, dim)
        self._goal = rng.normal(0.0, 6.0, dim)
        self._movers = [self._mover() for _ in range(rng.choice(SLOTS + 1, p=_COUNTS))]
        self._wind = rng.choice([0.0, 0.0, 0.05, 0.3])
        self._stamped = bool(rng.random() < _STAMPED)

    @property
    def time(self) -> float | None:
        """Now [s], on the clock of the stamps; None where nobody has a clock."""
        return _DT * self._step if self._stamped else None

    def seen(self) -> list[ObstaclePrediction]:
        """What is predicted now; some obstacles are not seen, some predictions are late."""
        rng, horizon = self._rng, self._problem.horizon
        there = rng.random(len(self._movers)) >= _ABSENT
        seen = [
            (j, mover.prediction(self._step, horizon))
            for j, (mover, here) in enumerate(zip(self._movers, there, strict=True))
            if here
        ]
        if self.time is None:
            return [prediction for _, prediction in seen]
        late = rng.choice([0.0, rng.uniform(0.0, 0.5), 2.0], p=_LATE)
        return [replace(o, stamp=self.time - late, name=f"mover {j}") for j, o in seen]

    def reference(self) -> FloatArray:
        """(nx,) where to go: the goal, at rest."""
        held = np.zeros_like(self.x)
        held[::2] = self._goal
        return held

    def advance(self, u: FloatArray) -> None:
        """Apply an input; the wind blows, and now and then the robot is carried off."""
        rng, x = self._rng, self.x
        self.x = self._problem.model.step(x, u)
        self.x[1::2] += self._wind * rng.standard_normal(len(u))
        if rng.random() < _CARRIED_OFF:
            self.x = self.x + rng.choice([1.0, 30.0, 1e5]) * rng.standard_normal(len(x))
        if np.abs(self.x).max() > 1e6:
            self.x = np.zeros_like(x)
        self._step += 1

    def _mover(self) -> Mover:
        rng, dim = self._rng, self._problem.model.dim
        share = rng.uniform(0.0, 1.0)
        spot = share * self._goal + rng.normal(0.0, 1.5, dim)
        if rng.random() < _ON_THE_ROBOT:
            spot = self.x[::2].copy()
        velocity = rng.normal(0.0, 1.0, dim) * rng.choice([0.0, 0.5, 1.5])
        Sigma = _covariance(rng, dim)
        return Mover(spot, velocity, Sigma, rng.choice([0.0, 0.05]), rng.choice([0.0, 0.2, 0.5]))


def _covariance(rng: np.random.Generator, dim: int) -> FloatArray:
    known = rng.choice(_KNOWN, p=_SHARES)
    sigma = np.full(dim, 10 ** rng.uniform(-2.0, -0.3))
    if known == "ellipse":
        sigma = 10 ** rng.uniform(-2.0, 0.0, dim)
    elif known in ("line", "needle"):
        sigma[1:] = 0.0
        sigma[0] *= 1.0 if known == "line" else 1e6
    elif known == "point":
        sigma[:] = 0.0
    elif known == "huge":
        sigma = 10 ** rng.uniform(1.0, 6.0, dim)
    V = np.linalg.qr(rng.normal(size=(dim, dim)))[0]
    Sigma: FloatArray = V @ np.diag(sigma**2) @ V.T
    return (Sigma + Sigma.T) / 2


Call = Callable[..., object]
Fault = tuple[str, type[ScpMpcError], Callable[[Call, FloatArray, FloatArray, Problem], object]]


def _nan(values: FloatArray) -> FloatArray:
    spoilt = values.copy()
    spoilt[0] = np.nan
    return spoilt


def _crowd(problem: Problem, rows: int, count: int) -> list[ObstaclePrediction]:
    dim = problem.model.dim
    return [ObstaclePrediction(np.zeros((rows, dim)), np.eye(dim), 0.1)] * count


# Bad calls and the error that each must raise.
FAULTS: list[Fault] = [
    ("NaN in x0", NotFiniteError, lambda step, x, ref, _: step(_nan(x), ref)),
    ("NaN in x_ref", NotFiniteError, lambda step, x, ref, _: step(x, _nan(ref))),
    ("infinite x0", NotFiniteError, lambda step, x, ref, _: step(x + np.inf, ref)),
    ("short x0", ShapeError, lambda step, x, ref, _: step(x[:-1], ref)),
    ("long prediction", ShapeError, lambda step, x, ref, p: step(x, ref, _crowd(p, 99, 1))),
    (
        "NaN in a prediction",
        NotFiniteError,
        lambda step, x, ref, p: step(
            x, ref, [ObstaclePrediction(_nan(np.zeros((p.horizon + 1, 2))), np.eye(2), 0.1)]
        ),
    ),
]
