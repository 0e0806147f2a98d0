"""Settings of the solver: how it works, never what problem it solves."""

from dataclasses import dataclass, field

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
        sides: Where an obstacle shapes the plan, try to pass it on the other sides too.
        sides_interval: Control steps between two such attempts while it keeps shaping the plan.
        rivals: How many of the ways past it to follow to the end; all are ranked.
        deadline: Seconds after which no iteration is begun once there is a plan; other sides are
            left out when half of them are gone. None: take the time it takes.
        qp: Settings of the quadratic program's solvers.
    """

    tolerance: float = 1e-6
    max_iterations: int = 40
    condense: bool = True
    acceleration: bool = True
    sides: bool = True
    sides_interval: int = 1
    rivals: int = 1
    deadline: float | None = None
    qp: QPSettings = field(default_factory=QPSettings)

    def __post_init__(self) -> None:
        """Check every number."""
        require_positive("tolerance", self.tolerance)
        as_count("max_iterations", self.max_iterations)
        as_count("sides_interval", self.sides_interval)
        as_count("rivals", self.rivals)
        if self.deadline is not None:
            require_positive("deadline", self.deadline)
        require_flags(self, "condense", "acceleration", "sides")
        if not isinstance(self.qp, QPSettings):
            raise InvalidArgumentError("qp", f"{self.qp!r} is not a QPSettings")
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
