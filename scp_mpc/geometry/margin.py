"""What is promised about an obstacle, and the size s of its ellipsoid that follows.

Notation:
    J       number of obstacles         N       number of stages (intervals)
    K       nodes in each interval at which an obstacle is constrained
    delta   risk; Phi, the standard normal distribution function
"""

from dataclasses import dataclass
from typing import Literal

from scp_mpc.arrays import as_number
from scp_mpc.errors import BoundsError, InvalidArgumentError
from scp_mpc.geometry.risk import containment_size, size_at_risk
from scp_mpc.settings import require_positive

CHI_SQUARE_95 = 5.991  # 95 % quantile of the chi-square distribution with 2 degrees of freedom


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

    @classmethod
    def fixed(cls, size: float) -> "Margin":
        """A size that never gives way."""
        return cls(size, size, max(size, 10.0))


@dataclass(frozen=True)
class Containment:
    """The ellipsoid contains the obstacle's centre with this probability, at each point in time.

    s^2 is a quantile of the chi-square distribution with as many degrees of freedom as the
    workspace has dimensions. This is no collision probability: a half-space tangent to the 95 %
    ellipse is missed with 0.7 %, and several stages together with more.

    Attributes:
        level: The probability, between 0 and 1.
    """

    level: float = 0.95

    def __post_init__(self) -> None:
        """Check the level."""
        if not 0 < as_number("level", self.level) < 1:
            raise BoundsError("level", f"{self.level} is not between 0 and 1")

    def size(self, dim: int) -> float:
        """The size s in a workspace of that dimension."""
        return containment_size(self.level, dim)


@dataclass(frozen=True)
class StageRisk:
    """P(the robot touches obstacle j during (t_{i-1}, t_i]) <= delta, for each j and i.

    s = Phi^-1(1 - delta / (K + 1)): the nodes of an interval, its beginning included, share the
    risk equally (Boole), for touching anywhere between two nodes takes one of them too near. With
    the samples alone it is P(the robot touches obstacle j at t_i), and s = Phi^-1(1 - delta).

    Attributes:
        delta: Largest risk per obstacle and stage, between 0 and 1/2.
    """

    delta: float

    def __post_init__(self) -> None:
        """Check the risk."""
        _require_risk("delta", self.delta)

    def size(self, nodes: int) -> float:
        """The size s where that many nodes share the risk of an interval."""
        return float(size_at_risk(self.delta / nodes))


@dataclass(frozen=True)
class JointRisk:
    """P(the robot touches any obstacle within the horizon) <= delta, if it is clear of them now.

    Attributes:
        delta: Largest risk of the whole plan, between 0 and 1/2.
        allocation: "uniform": each of the J N K nodes gets the same share (Boole). "iterative":
            what a point does not use goes to those that hold the plan up (iterative risk
            allocation: Ono and Williams, 2008); never costs more than the uniform one.
    """

    delta: float
    allocation: Literal["uniform", "iterative"] = "uniform"

    def __post_init__(self) -> None:
        """Check the risk and the allocation."""
        _require_risk("delta", self.delta)
        if self.allocation not in ("uniform", "iterative"):
            raise InvalidArgumentError(
                "allocation", f"{self.allocation!r} is neither 'uniform' nor 'iterative'"
            )

    def size(self, nodes: int) -> float:
        """The size s where all obstacles together have that many nodes."""
        return float(size_at_risk(self.delta / max(nodes, 1)))


MarginSpec = Margin | Containment | StageRisk | JointRisk


def size_at(
    promise: MarginSpec, dim: int, obstacles: int, stages: int, count: int, gaps: int
) -> float:
    """The uniform size s of a promise.

    Args:
        promise: What is promised.
        dim: Dimension of the workspace.
        obstacles: J.
        stages: N.
        count: K.
        gaps: Points at the beginning of an interval, if the promise covers what happens between
            two nodes; else 0.
    """
    if isinstance(promise, Margin):
        return promise.reference
    if isinstance(promise, Containment):
        return promise.size(dim)
    if isinstance(promise, StageRisk):
        return promise.size(count + gaps)
    return promise.size(obstacles * stages * count)


def _require_risk(argument: str, value: float) -> None:
    if not 0 < as_number(argument, value) < 0.5:
        raise BoundsError(argument, f"{value} is not between 0 and 0.5")
