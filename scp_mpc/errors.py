"""Exceptions for misuse.

Outcomes of a solve are statuses (`scp_mpc.solver.plan.Status`), never exceptions. An exception
means that the caller handed over something that cannot be meant; it names the argument and the
offending number, and is raised before any state changes.
"""


class ScpMpcError(Exception):
    """Base class of every exception that this library raises on purpose."""


class InvalidArgumentError(ScpMpcError, ValueError):
    """An argument has a value that cannot be used.

    Attributes:
        argument: Name of the argument as the caller wrote it.
    """

    def __init__(self, argument: str, problem: str) -> None:
        """Compose the message `argument: problem`."""
        super().__init__(f"{argument}: {problem}")
        self.argument = argument


class ShapeError(InvalidArgumentError):
    """An array has the wrong shape or length."""


class NotFiniteError(InvalidArgumentError):
    """An array that must be finite holds NaN or infinity."""


class CovarianceError(InvalidArgumentError):
    """A covariance is not symmetric positive semi-definite."""


class BoundsError(InvalidArgumentError):
    """A lower bound exceeds its upper bound, or a size has the wrong sign."""


class TooManyObstaclesError(InvalidArgumentError):
    """More obstacles were passed than `Problem.max_obstacles` provides for."""
