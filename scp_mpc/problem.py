"""The frozen problem: what is minimised, over which horizon, within which limits.

    minimise   sum_{i=1..N} |x_i - xref_i|^2_Q + sum_{i=0..N-1} |u_i|^2_R + sum_j w (s_j - s_ref)^2
    over       x_1..x_N, u_0..u_{N-1}, s_j
    subject to x_{i+1} = f(x_i, u_i),  x_0 given
               p_i outside the no-go set of obstacle j at stage i, sized by s_j
               s_min <= s_j <= s_max,  u_min <= u_i <= u_max

There is no factor 1/2 anywhere, and `Qf` replaces Q at i = N where it is given.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray, as_array, as_count, as_number, as_weight, frozen
from scp_mpc.errors import BoundsError, InvalidArgumentError
from scp_mpc.robots.linear import LinearModel
from scp_mpc.safety.inflation import AxesInflation, ExactInflation, Inflation
from scp_mpc.settings import require_positive

CHI_SQUARE_95 = 5.991  # 95 % quantile of the chi-square distribution with 2 degrees of freedom

_INFLATIONS: dict[str, type[Inflation]] = {"exact": ExactInflation, "axes": AxesInflation}


@dataclass(frozen=True)
class Margin:
    """The size s of an obstacle's ellipsoid, in standard deviations, as a decision variable.

    Attributes:
        reference: s_ref; the default contains 95 % of a planar Gaussian.
        lower: s_min.
        upper: s_max.
        weight: w of the cost w (s - s_ref)^2.
    """

    reference: float = CHI_SQUARE_95**0.5
    lower: float = CHI_SQUARE_95**0.5
    upper: float = 10.0
    weight: float = 0.005

    def __post_init__(self) -> None:
        """Check the order 0 <= lower <= reference <= upper and the weight."""
        for name in ("reference", "lower", "upper", "weight"):
            as_number(f"margin.{name}", getattr(self, name))
        if not 0 <= self.lower <= self.upper:
            raise BoundsError("margin.lower", f"not 0 <= {self.lower} <= upper = {self.upper}")
        if not self.lower <= self.reference <= self.upper:
            raise BoundsError(
                "margin.reference", f"{self.reference} is outside [{self.lower}, {self.upper}]"
            )
        require_positive("margin.weight", self.weight)


@dataclass(frozen=True, eq=False)
class Problem:
    """Everything about the optimal control problem that does not change from step to step.

    Args:
        model: Dynamics of the robot.
        horizon: N, the number of intervals; there are N + 1 states.
        Q: State weight (nx,) or (nx, nx), positive semi-definite.
        R: Input weight (nu,) or (nu, nu), positive semi-definite.
        u_min: Lower input bounds, a number or (nu,).
        u_max: Upper input bounds, a number or (nu,).
        Qf: Weight of the last state; Q if None.
        robot_radius: Radius of the robot [m].
        margin: The obstacles' sizes s_j.
        inflation: "exact" for ellipsoid (+) ball, "axes" for the report's lengthened axes.
        max_obstacles: Number of obstacle slots M in the program.
        slack_weight: Cost per metre of slack and stage where the constraints cannot all be met.
            The penalty is exact as long as it exceeds the obstacles' multipliers.

    Raises:
        InvalidArgumentError: Or one of its subclasses, with the argument and the number.
    """

    model: LinearModel
    horizon: int
    Q: FloatArray
    R: FloatArray
    u_min: FloatArray
    u_max: FloatArray
    Qf: FloatArray
    robot_radius: float
    margin: Margin
    inflation: Literal["exact", "axes"]
    max_obstacles: int
    slack_weight: float

    def __init__(
        self,
        model: LinearModel,
        *,
        horizon: int,
        Q: ArrayLike,
        R: ArrayLike,
        u_min: ArrayLike,
        u_max: ArrayLike,
        Qf: ArrayLike | None = None,
        robot_radius: float = 0.0,
        margin: Margin | None = None,
        inflation: Literal["exact", "axes"] = "exact",
        max_obstacles: int = 1,
        slack_weight: float = 1e3,
    ) -> None:
        """Copy, check and freeze."""
        if not isinstance(model, LinearModel):
            raise InvalidArgumentError("model", f"{model!r} is not a LinearModel")
        horizon = as_count("horizon", horizon)
        lower, upper = _bounds(u_min, u_max, model.nu)
        radius = as_number("robot_radius", robot_radius)
        if radius < 0:
            raise BoundsError("robot_radius", f"{radius} m is negative")
        if not isinstance(inflation, str) or inflation not in _INFLATIONS:
            raise InvalidArgumentError(
                "inflation", f"{inflation!r} is none of {', '.join(_INFLATIONS)}"
            )
        max_obstacles = as_count("max_obstacles", max_obstacles, least=0)
        require_positive("slack_weight", slack_weight)
        margin = Margin() if margin is None else margin
        if not isinstance(margin, Margin):
            raise InvalidArgumentError("margin", f"{margin!r} is not a Margin")
        values = {
            "model": model,
            "horizon": horizon,
            "Q": as_weight("Q", Q, model.nx),
            "R": as_weight("R", R, model.nu),
            "Qf": as_weight("Qf", Q if Qf is None else Qf, model.nx),
            "u_min": lower,
            "u_max": upper,
            "robot_radius": radius,
            "margin": margin,
            "inflation": inflation,
            "max_obstacles": max_obstacles,
            "slack_weight": float(slack_weight),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    @cached_property
    def no_go(self) -> Inflation:
        """The inflation's geometry."""
        return _INFLATIONS[self.inflation](self.margin.reference)

    def cost(
        self, states: FloatArray, inputs: FloatArray, s: FloatArray, x_ref: FloatArray
    ) -> float:
        """Return the cost of states (N+1, nx), inputs (N, nu) and sizes s (M,), without slack."""
        error = states[1:] - x_ref[1:]
        track = np.vdot(error[:-1] @ self.Q, error[:-1]) + error[-1] @ self.Qf @ error[-1]
        effort = np.vdot(inputs @ self.R, inputs)
        deviation = s - self.margin.reference
        return float(track + effort + self.margin.weight * (deviation @ deviation))


def _bounds(u_min: ArrayLike, u_max: ArrayLike, nu: int) -> tuple[FloatArray, FloatArray]:
    lower, upper = (
        frozen(np.array(np.broadcast_to(as_array(name, value, (), (nu,)), nu)))
        for name, value in (("u_min", u_min), ("u_max", u_max))
    )
    if (lower > upper).any():
        at = int(np.argmax(lower > upper))
        raise BoundsError("u_min", f"{lower[at]} exceeds u_max = {upper[at]} for input {at}")
    return lower, upper
