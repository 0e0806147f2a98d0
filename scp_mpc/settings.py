"""Settings of solver and controller: how they work, never what problem they solve."""

from dataclasses import dataclass, field
from typing import Literal, get_args, get_type_hints

from scp_mpc.arrays import as_count, as_number
from scp_mpc.errors import BoundsError, InvalidArgumentError


@dataclass(frozen=True)
class QPSettings:
    """Settings of the quadratic program's solvers.

    Attributes:
        accuracy: KKT residual at which a QP counts as solved; what OSQP does not bring there goes
            to the rescue solver. Where both fall short, a feasible point below 1e-3 is used.
        eps: OSQP's absolute and relative tolerance; polishing takes it from there to `accuracy`.
        max_iterations: OSQP's iterations before the rescue solver is asked.
        check_interval: Iterations between OSQP's checks for termination.
        rho: OSQP's initial step size.
        rescue: Whether to ask PIQP for what OSQP does not bring to `accuracy`.
        cold: KKT residual of the starting point beyond which PIQP is asked first: the worse the
            start, the more iterations OSQP needs.
    """

    accuracy: float = 1e-7
    eps: float = 1e-4
    max_iterations: int = 150
    check_interval: int = 5
    rho: float = 0.1
    rescue: bool = True
    cold: float = 1.0

    def __post_init__(self) -> None:
        """Check every number, because OSQP does not."""
        for name in ("accuracy", "eps", "rho", "cold"):
            require_positive(name, getattr(self, name))
        for name in ("max_iterations", "check_interval"):
            as_count(name, getattr(self, name))
        require_flags(self, "rescue")


@dataclass(frozen=True)
class Freshness:
    """How old a prediction may be, and what the controller does about it.

    Attributes:
        grow_after: Age [s] up to which a prediction is used as it is; an older one is moved on
            along itself and grown.
        stop_after: Age [s] beyond which a prediction is not used any more; see `beyond`.
        keep: Seconds for which a named obstacle is kept, moved on and grown, after it was last
            reported; 0 drops it at once.
        growth: Variance [m^2] that each second of age adds in every direction.
        beyond: What to do with predictions older than `stop_after`: "brake" returns a plan that
            brakes, "refuse" raises `StaleDataError`.
        stamps: "required" refuses a step without a time and a prediction without a stamp;
            "optional" takes such a prediction for one of now.
    """

    grow_after: float = 0.05
    stop_after: float = 1.0
    keep: float = 1.0
    growth: float = 0.1
    beyond: Literal["brake", "refuse"] = "brake"
    stamps: Literal["optional", "required"] = "optional"

    def __post_init__(self) -> None:
        """Check every number and word."""
        for name in ("grow_after", "stop_after", "keep", "growth"):
            if as_number(f"freshness.{name}", getattr(self, name)) < 0:
                raise BoundsError(f"freshness.{name}", f"{getattr(self, name)} is negative")
        if self.stop_after < self.grow_after:
            raise BoundsError("freshness.stop_after", f"{self.stop_after} s is before grow_after")
        for name in ("beyond", "stamps"):
            words = get_args(get_type_hints(Freshness)[name])
            if getattr(self, name) not in words:
                raise InvalidArgumentError(
                    f"freshness.{name}", f"{getattr(self, name)!r} is none of {', '.join(words)}"
                )


@dataclass(frozen=True)
class Settings:
    """Settings of the sequential convex programming.

    Attributes:
        tolerance: KKT residual of the original problem at which a plan is certified.
        max_iterations: Steps of one descent at most; each solves a convex subproblem, or two where
            an extrapolation did not help.
        condense: Eliminate the dynamics and solve small dense programs with an active-set method;
            else, and where that has no answer, sparse programs go to OSQP first.
        acceleration: On the sparse programs, extrapolate the linearisation point; see
            `scp_mpc.solver.acceleration`.
        multi_start: Where an obstacle shapes the plan, try to pass it on the other sides too.
        multi_start_interval: Control steps between two such attempts while it keeps shaping the
            plan.
        max_candidates: How many of the ways past it to follow to the end; all are ranked.
        deadline: Seconds in which a step is to end: nothing is begun that is predicted, from how
            long it took lately, to end later. None: take the time it takes.
        qp: Settings of the quadratic program's solvers.
        freshness: How old predictions may be; for the controller `MPC` alone.
    """

    tolerance: float = 1e-6
    max_iterations: int = 40
    condense: bool = True
    acceleration: bool = True
    multi_start: bool = True
    multi_start_interval: int = 1
    max_candidates: int = 1
    deadline: float | None = None
    qp: QPSettings = field(default_factory=QPSettings)
    freshness: Freshness = field(default_factory=Freshness)

    def __post_init__(self) -> None:
        """Check every number."""
        require_positive("tolerance", self.tolerance)
        as_count("max_iterations", self.max_iterations)
        as_count("multi_start_interval", self.multi_start_interval)
        as_count("max_candidates", self.max_candidates)
        if self.deadline is not None:
            require_positive("deadline", self.deadline)
        require_flags(self, "condense", "acceleration", "multi_start")
        if not isinstance(self.qp, QPSettings):
            raise InvalidArgumentError("qp", f"{self.qp!r} is not a QPSettings")
        if not isinstance(self.freshness, Freshness):
            raise InvalidArgumentError("freshness", f"{self.freshness!r} is not a Freshness")
        if self.qp.accuracy > self.tolerance:
            raise BoundsError(
                "qp.accuracy",
                f"{self.qp.accuracy:g} is coarser than the tolerance {self.tolerance:g}",
            )


def require_positive(argument: str, value: float) -> None:
    """Raise `BoundsError` unless `value` is a positive finite number."""
    if as_number(argument, value) <= 0:
        raise BoundsError(argument, f"{value} is not positive")


def require_flags(owner: object, *names: str) -> None:
    """Raise `InvalidArgumentError` unless the named attributes are True or False."""
    for name in names:
        if not isinstance(getattr(owner, name), bool):
            raise InvalidArgumentError(name, f"{getattr(owner, name)!r} is neither True nor False")
