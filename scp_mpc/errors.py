"""Exceptions for misuse.

Outcomes of a solve are statuses (`scp_mpc.scp.plan.Status`), never exceptions. An exception
means that the caller handed over something that cannot be meant; it names the argument and the
offending number, and is raised before any state changes.
"""


class ScpMpcError(Exception):
    """Base class of every exception that this library raises on purpose."""


class InvalidArgumentError(ScpMpcError, ValueError):
    """An argument has a value that cannot be used.

    Attributes:
        argument: Name of the argument as the caller wrote it.
        problem: What is wrong with it, with the offending number.
    """

    def __init__(self, argument: str, problem: str) -> None:
        super().__init__(argument, problem)
        self.argument, self.problem = argument, problem

    def __str__(self) -> str:
        """Return `argument: problem`."""
        return f"{self.argument}: {self.problem}"


class ShapeError(InvalidArgumentError):
    """An array has the wrong shape or length."""


class NotFiniteError(InvalidArgumentError):
    """An array that must be finite holds NaN or infinity."""


class CovarianceError(InvalidArgumentError):
    """A covariance is not symmetric positive semi-definite."""


class BoundsError(InvalidArgumentError):
    """A lower bound exceeds its upper bound, or a size has the wrong sign."""


class JacobianError(InvalidArgumentError):
    """A model's derivatives are not those of the model."""


class GeometryError(InvalidArgumentError):
    """Points or half-spaces do not make a convex body with an inside."""


class MissingExtraError(ScpMpcError, ImportError):
    """An optional package is not installed; it names the extra that brings it along."""


class MissingCoreError(InvalidArgumentError):
    """The native core is asked for and not there; it says why, and how to get it."""

    def __init__(self, reason: str) -> None:
        remedy = (
            "It is compiled when the package is installed: install a C compiler, for example by "
            "`apt install gcc`, or unset SCP_MPC_PURE and SCP_MPC_NO_ZIG, and install it "
            "again, by `pip install --force-reinstall --no-deps --no-cache-dir .` in a clone"
        )
        super().__init__("solver", f"'native' is not there: {reason}. {remedy}")
        self.reason = reason


class ConcurrentUseError(ScpMpcError):
    """One solver was called from two threads at once; each needs its own."""


class TooManyObstaclesError(InvalidArgumentError):
    """More obstacles were passed than `Problem.max_obstacles` provides for."""


class StaleDataError(InvalidArgumentError):
    """A time cannot be worked with: data too old, a stamp missing, a clock that is wrong."""
