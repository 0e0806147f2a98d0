"""The promises that are put to the test: a kind of risk, delta, and the shape of the no-go set.

stage               P(contact with obstacle j in (t_{i-1}, t_i]) <= delta for each stage i and j
sample              P(contact with j at t_i) <= delta, constrained and measured at the samples
                    alone: what the shape of the no-go set by itself is worth
samples only        as `stage`, but constrained at the samples alone
joint, uniform      P(any contact over the horizon) <= delta, in equal shares
joint, iterative    the same, in shares that go where they are needed
containment         the ellipsoid contains 1 - delta of the Gaussian (chi-square), so that each
                    stage's contact has a probability of at most delta
report              the report's size, 2.45 standard deviations: 95 % containment
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Literal

from scipy.stats import chi2, norm

from scp_mpc.arrays import as_number
from scp_mpc.errors import BoundsError, InvalidArgumentError
from scp_mpc.geometry.margin import Containment, JointRisk, Margin, MarginSpec, StageRisk
from scp_mpc.models.linear import LinearModel
from scp_mpc.problem import Problem
from scp_mpc.settings import require_positive

DELTAS = (0.1, 0.05, 0.01)
KINDS = (
    "stage",
    "sample",
    "samples only",
    "joint, uniform",
    "joint, iterative",
    "containment",
    "report",
)
_AT_SAMPLES = ("sample", "samples only", "report")  # nothing is constrained in between
INFLATIONS: tuple[Literal["exact", "axes"], ...] = ("exact", "axes")
_REPORT = (Margin(), 0.05)


@dataclass(frozen=True)
class RiskSetting:
    """One promise.

    Attributes:
        kind: One of `KINDS`.
        delta: The promised probability.
        inflation: Shape of the no-go set.
        scale: Factor on the size s; anything but 1 is a deliberate mistake.
    """

    kind: str
    delta: float
    inflation: Literal["exact", "axes"]
    scale: float = 1.0

    def __post_init__(self) -> None:
        """Check every value."""
        if self.kind not in KINDS:
            raise InvalidArgumentError("kind", f"{self.kind!r} is none of {', '.join(KINDS)}")
        if not 0 < as_number("delta", self.delta) < 1:
            raise BoundsError("delta", f"{self.delta} is not between 0 and 1")
        require_positive("scale", self.scale)

    @property
    def joint(self) -> bool:
        """Whether delta is for the whole horizon and all obstacles."""
        return self.kind.startswith("joint")

    @property
    def name(self) -> str:
        """What tables and files call it."""
        scale = "" if self.scale == 1 else f" x {self.scale:g}"
        return f"{self.kind}, {self.inflation}, {self.delta:g}{scale}"


def all_settings(deltas: Sequence[float] = DELTAS) -> list[RiskSetting]:
    """Every kind and delta with both inflations; two kinds stand alone."""
    kinds = [kind for kind in KINDS if kind not in ("report", "samples only")]
    settings = [RiskSetting(k, d, i) for i, k, d in product(INFLATIONS, kinds, deltas)]
    settings += [RiskSetting("samples only", d, "exact") for d in deltas]
    return [*settings, RiskSetting("report", _REPORT[1], "axes")]


def driven_settings(deltas: Sequence[float] = DELTAS) -> list[RiskSetting]:
    """Those that are driven in closed loop, which takes more time: of `axes` the stages' only."""
    return [
        setting
        for setting in all_settings(deltas)
        if setting.kind not in ("sample", "samples only")
        and (setting.inflation == "exact" or setting.kind in ("stage", "report"))
    ]


def problem_for(
    setting: RiskSetting, model: LinearModel, horizon: int, obstacles: int, **given: Any
) -> Problem:
    """The problem that makes this promise.

    Args:
        setting: The promise.
        model: The robot.
        horizon: N.
        obstacles: M.
        given: The problem's other arguments.
    """
    values: dict[str, Any] = {
        "horizon": horizon,
        "Q": [0.2, 0.05] * model.dim,
        "R": [0.001] * model.dim,
        "u_min": -3.0,
        "u_max": 3.0,
        "margin": _promise(setting, horizon * obstacles, model.dim),
        "inflation": setting.inflation,
        "max_obstacles": obstacles,
    }
    if setting.kind in _AT_SAMPLES:
        values["nodes_per_interval"] = 1
    return Problem(model, **(values | given))


def _promise(setting: RiskSetting, shares: int, dim: int) -> MarginSpec:
    if setting.scale != 1:
        return Margin.fixed(setting.scale * _size(setting, shares, dim))
    if setting.kind == "report":
        return _REPORT[0]
    if setting.kind == "containment":
        return Containment(1 - setting.delta)
    if setting.kind == "joint, uniform":
        return JointRisk(setting.delta, "uniform")
    if setting.kind == "joint, iterative":
        return JointRisk(setting.delta, "iterative")
    return StageRisk(setting.delta)


def _size(setting: RiskSetting, shares: int, dim: int) -> float:
    """The size s of the promise at the samples, for the deliberate mistake."""
    if setting.kind == "report":
        return _REPORT[0].reference
    if setting.kind == "containment":
        return float(chi2.isf(setting.delta, dim)) ** 0.5
    return float(norm.isf(setting.delta / shares if setting.joint else setting.delta))
