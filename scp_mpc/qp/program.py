"""A sparse quadratic program, what it means to solve it, and what a solver of it must offer.

    minimise 1/2 x'P x + q'x   subject to   lower <= A x <= upper

Sign of the multipliers: P x + q + A'y = 0 with y > 0 at upper and y < 0 at lower bounds.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from math import inf, isnan

import numpy as np
from scipy import sparse

from scp_mpc.arrays import FloatArray


@dataclass(frozen=True)
class KKTResiduals:
    """How far a point and its multipliers are from satisfying the KKT conditions.

    Attributes:
        stationarity: Largest entry of the Lagrangian's gradient, relative to the objective's own
            gradient if that is above 1.
        feasibility: Largest violation of a constraint.
        complementarity: Largest product of a multiplier and the distance to its bound, relative
            to the objective if above 1; the multiplier itself where that bound is infinite.
        curvature: Smallest curvature of the Lagrangian along directions in which the constraints
            allow to move, over its largest; at least zero, up to rounding, at a minimum. NaN where
            it was not asked for.
    """

    stationarity: float
    feasibility: float
    complementarity: float
    curvature: float = np.nan

    @property
    def worst(self) -> float:
        """The largest of the first three; NaN counts as infinite."""
        three = self.stationarity, self.feasibility, self.complementarity
        return inf if isnan(sum(three)) else max(three)  # max() may pass over NaN


@dataclass(frozen=True, eq=False)
class QuadraticProgram:
    """The program's data. The patterns of P and A are fixed; all values may be rewritten.

    Attributes:
        P: (n, n) symmetric positive semi-definite, both triangles, CSC.
        q: (n,).
        A: (m, n) CSC.
        lower: (m,) may hold minus infinity.
        upper: (m,) may hold infinity.
    """

    P: sparse.csc_matrix
    q: FloatArray
    A: sparse.csc_matrix
    lower: FloatArray
    upper: FloatArray

    def copy(self) -> "QuadraticProgram":
        """The same values in arrays of their own."""
        return QuadraticProgram(
            self.P.copy(), self.q.copy(), self.A.copy(), self.lower.copy(), self.upper.copy()
        )

    def residuals(self, x: FloatArray, y: FloatArray) -> KKTResiduals:
        """Return the KKT residuals of the point x (n,) with multipliers y (m,)."""
        Ax, Px = self.A @ x, self.P @ x
        gradient = np.abs(Px + self.q + self.A.T @ y).max() / max(1.0, np.abs(Px).max())
        below, above = Ax - self.lower, self.upper - Ax
        gap = np.where(y < 0, below, above)
        products = np.abs(y) * np.where(np.isinf(gap), 1.0, np.abs(gap))
        product = products.max() / max(1.0, abs(x @ Px / 2 + self.q @ x))
        violation = -min(below.min(), above.min())
        return KKTResiduals(float(gradient), max(0.0, float(violation)), float(product))


def bounded(lower: FloatArray, upper: FloatArray, far: float) -> tuple[FloatArray, FloatArray]:
    """Bounds (m,) with finite ones, that far from the other side, for those that are none."""
    none, nothing = lower == -inf, upper == inf
    most = np.where(nothing, np.where(none, 0.0, lower) + far, upper)
    return np.where(none, np.where(nothing, 0.0, upper) - far, lower), most


class Backend(ABC):
    """Solves programs of one pattern, again and again.

    Attributes:
        name: What it is called in settings and counts.
        stages: (effort, repairs): how often and how long to `run`, and how many changes of the
            active set to try after each run before going on.
        noise: Share of the largest multiplier below which one is none.
    """

    name: str
    noise: float = 1e-7
    stages: tuple[tuple[int, int], ...] = ((1, 100),)

    @abstractmethod
    def load(self, start: tuple[FloatArray, FloatArray]) -> None:
        """Take over the program's values as they stand, and a start x (n,), y (m,).

        Raises:
            NotFiniteError: A value is NaN, or infinite where it must not be.
            BoundsError: A lower bound exceeds its upper bound.
        """

    @abstractmethod
    def run(self, effort: int) -> tuple[FloatArray, FloatArray] | None:
        """Go on from there; return x (n,) and y (m,), or None where there is no such point.

        Args:
            effort: Iterations; solvers that know no warm start pass over it.
        """
