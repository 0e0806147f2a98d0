"""A control step in coordinates in which its cost is a circle: the condensed problem.

Constraints act on the outputs y only (`layout.py`). Every plan that obeys the dynamics, linearised
about the present plan where they are nonlinear, is

    y = y_free + S v,        cost = cost_free + |v|^2 / 2

where y_free is the plan that nothing constrains, and v are its inputs (and sizes) in coordinates
that make the Hessian the identity.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

from scp_mpc.arrays import FloatArray
from scp_mpc.solver.layout import Layout
from scp_mpc.solver.motion import Motion
from scp_mpc.solver.sampling import Sampling
from scp_mpc.solver.step_data import StepData


@dataclass(frozen=True, eq=False)
class Chart:
    """The condensed problem of one control step, about one plan.

    Attributes:
        y_free: (ny,) outputs of the plan that nothing constrains.
        response: (ny, nv) S.
        boxed: (nf, nv) its rows of the bounded entries, in C's order.
        cost_free: Computes the cost of that plan; most charts are never asked.
    """

    y_free: FloatArray
    response: FloatArray
    boxed: FloatArray
    cost_free: Callable[[], float]

    @cached_property
    def least(self) -> float:
        """Cost of the plan that nothing constrains: any other costs |v|^2 / 2 more."""
        return self.cost_free()

    def y(self, v: FloatArray) -> FloatArray:
        """Outputs (ny,) of a solution v (nv,)."""
        moved: FloatArray = self.y_free + self.response @ v
        return moved

    def guess(self, v: FloatArray) -> FloatArray | None:  # noqa: ARG002
        """Deviations (N, nx) of a solution, where they are no more than a guess; or None."""
        return None


@dataclass(frozen=True, eq=False)
class Rolled:
    """A plan that obeys the dynamics.

    Attributes:
        inputs: (N, nu) u.
        deviations: (N, nx) e.
        positions: (C, d) p, as deviations from the track.
        motion: Derivatives about it.
    """

    inputs: FloatArray
    deviations: FloatArray
    positions: FloatArray
    motion: Motion


class Condensation(ABC):
    """Eliminates the dynamics of a problem.

    Attributes:
        layout: What y holds.
        sampling: The points of the positions in y.
    """

    layout: Layout
    sampling: Sampling

    @abstractmethod
    def begin(self, step: StepData) -> None:
        """Read a control step."""

    @abstractmethod
    def rolled(self, inputs: FloatArray, guess: FloatArray | None = None) -> Rolled:
        """Roll inputs (N, nu) out from the state now; `guess` (N, nx) of the deviations."""
