"""Settings of solver and controller: how they work, never what problem they solve."""

from dataclasses import dataclass, field
from typing import Literal, get_args, get_type_hints

from scp_mpc.arrays import as_count, as_number
from scp_mpc.errors import BoundsError, InvalidArgumentError


@dataclass(frozen=True)
class QPSettings:
    """OSQP's settings, and what follows where it does not name the active set.

    Attributes:
        rho: OSQP's step sizes, for rows of length one, from one run to the next: what is hard for
            one of them is often easy for another.
        sigma: OSQP's regularisation.
        alpha: OSQP's relaxation, between 0 and 2.
        iterations: ADMM iterations to run, one after the other, until the active set is found.
        repairs: Changes of the active set to try after each of these runs.
        rescue: Whether to ask PIQP for what is not solved then.
    """

    rho: tuple[float, ...] = (10.0, 1.0)
    sigma: float = 1e-6
    alpha: float = 1.6
    iterations: tuple[int, ...] = (10, 25)
    repairs: tuple[int, ...] = (1, 100)
    rescue: bool = True

    def __post_init__(self) -> None:
        """Check every number, because OSQP does not."""
        for name in ("sigma", "alpha"):
            require_positive(f"qp.{name}", getattr(self, name))
        if not isinstance(self.rho, tuple) or not self.rho:
            raise InvalidArgumentError("qp.rho", f"{self.rho!r} is not a tuple of numbers")
        for rho in self.rho:
            require_positive("qp.rho", rho)
        if self.alpha >= 2:
            raise BoundsError("qp.alpha", f"{self.alpha} is not below 2")
        for name, least in (("iterations", 1), ("repairs", 0)):
            counts = getattr(self, name)
            if not isinstance(counts, tuple) or not counts:
                raise InvalidArgumentError(f"qp.{name}", f"{counts!r} is not a tuple of counts")
            for count in counts:
                as_count(f"qp.{name}", count, least=least)
        if len(self.iterations) != len(self.repairs):
            raise InvalidArgumentError(
                "qp.repairs", f"{len(self.repairs)} entries, but {len(self.iterations)} iterations"
            )
        require_flags(self, "rescue")

    @property
    def stages(self) -> tuple[tuple[int, int], ...]:
        """Iterations and repairs of each run."""
        return tuple(zip(self.iterations, self.repairs, strict=True))


@dataclass(frozen=True)
class StalenessPolicy:
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
            if as_number(f"staleness.{name}", getattr(self, name)) < 0:
                raise BoundsError(f"staleness.{name}", f"{getattr(self, name)} is negative")
        if self.stop_after < self.grow_after:
            raise BoundsError("staleness.stop_after", f"{self.stop_after} s is before grow_after")
        for name in ("beyond", "stamps"):
            words = get_args(get_type_hints(StalenessPolicy)[name])
            if getattr(self, name) not in words:
                raise InvalidArgumentError(
                    f"staleness.{name}", f"{getattr(self, name)!r} is none of {', '.join(words)}"
                )


@dataclass(frozen=True)
class Settings:
    """Settings of the sequential convex programming.

    Attributes:
        tolerance: KKT residual of the original problem at which a plan is certified.
        max_iterations: SCP iterations of one run of the loop at most; each solves one program.
        solver: Who solves the programs: "osqp", "piqp", or any solver of qpsolvers by its name. Or
            "native": the whole step is made by the core in C, if that was compiled.
        multi_start: Where an obstacle shapes the plan, try other candidates, too: its other sides,
            other times.
        multi_start_interval: Control steps between two such attempts while it keeps shaping the
            plan.
        max_candidates: How many of the ways past it to follow to the end; all are ranked.
        deadline: Seconds in which a step is to end: nothing is begun that is predicted, from how
            long it took lately, to end later. "dt": for the controller `MPC` the sampling interval;
            for one step of `SCP` alone none. None: take the time it takes, so that the same calls
            give the same plans on any machine.
        max_programs: Programs that one step may solve or rank, all runs and candidates together:
            the worst case, also without a deadline.
        max_replayed: Steps in a row that may live on an old plan before the robot brakes.
        history: Whether plans keep what happened in each SCP iteration; the native core does not.
        qp: OSQP's settings; the native core has no use for them.
        staleness: How old predictions may be; for the controller `MPC` alone.
    """

    tolerance: float = 1e-6
    max_iterations: int = 40
    solver: str = "osqp"
    multi_start: bool = True
    multi_start_interval: int = 1
    max_candidates: int = 1
    deadline: float | Literal["dt"] | None = "dt"
    max_programs: int = 200
    max_replayed: int = 10
    history: bool = False
    qp: QPSettings = field(default_factory=QPSettings)
    staleness: StalenessPolicy = field(default_factory=StalenessPolicy)

    def __post_init__(self) -> None:
        """Check every number."""
        require_positive("tolerance", self.tolerance)
        as_count("max_iterations", self.max_iterations)
        as_count("multi_start_interval", self.multi_start_interval)
        as_count("max_candidates", self.max_candidates)
        as_count("max_programs", self.max_programs)
        as_count("max_replayed", self.max_replayed)
        if isinstance(self.deadline, str) and self.deadline != "dt":
            raise InvalidArgumentError("deadline", f"{self.deadline!r} is not 'dt'")
        if self.deadline is not None and not isinstance(self.deadline, str):
            require_positive("deadline", self.deadline)
        require_flags(self, "multi_start", "history")
        if not isinstance(self.solver, str):
            raise InvalidArgumentError("solver", f"{self.solver!r} is not a name")
        if not isinstance(self.qp, QPSettings):
            raise InvalidArgumentError("qp", f"{self.qp!r} is not a QPSettings")
        if not isinstance(self.staleness, StalenessPolicy):
            raise InvalidArgumentError("staleness", f"{self.staleness!r} is not a StalenessPolicy")

    def time_limit(self, dt: float | None = None) -> float | None:
        """The deadline [s] of a step in a loop with interval dt [s], or in none; None for never."""
        return dt if isinstance(self.deadline, str) else self.deadline


def require_positive(argument: str, value: float) -> None:
    """Raise `BoundsError` unless `value` is a positive finite number."""
    if as_number(argument, value) <= 0:
        raise BoundsError(argument, f"{value} is not positive")


def require_flags(owner: object, *names: str) -> None:
    """Raise `InvalidArgumentError` unless the named attributes are True or False."""
    for name in names:
        if not isinstance(getattr(owner, name), bool):
            raise InvalidArgumentError(name, f"{getattr(owner, name)!r} is neither True nor False")
