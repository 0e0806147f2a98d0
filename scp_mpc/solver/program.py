"""A sparse quadratic program and the KKT residual of a candidate solution.

    minimise 1/2 x'P x + q'x   subject to   lower <= A x <= upper

Sign of the multipliers: P x + q + A'y = 0 with y > 0 at upper and y < 0 at lower bounds.
"""

from dataclasses import dataclass, field
from math import isnan

import numpy as np
from scipy import sparse

from scp_mpc.arrays import FloatArray


@dataclass(frozen=True)
class KKTResiduals:
    """How far a point and its multipliers are from satisfying the KKT conditions.

    Attributes:
        stationarity: Largest entry of |P x + q + A'y|, relative to that of |P x| if above 1.
        feasibility: Largest violation of lower <= A x <= upper.
        complementarity: Largest product of a multiplier and the distance to its bound, relative
            to the objective if above 1; the multiplier itself where that bound is infinite.
    """

    stationarity: float
    feasibility: float
    complementarity: float

    @property
    def worst(self) -> float:
        """The largest of the three; NaN counts as infinite."""
        three = self.stationarity, self.feasibility, self.complementarity
        return np.inf if isnan(sum(three)) else max(three)  # max() may pass over NaN


@dataclass(frozen=True, eq=False)
class QuadraticProgram:
    """The program's data. P and the pattern of A are fixed; all other values may be rewritten.

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
    _AT: sparse.csr_matrix = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Keep the transpose, which shares its values with A."""
        object.__setattr__(self, "_AT", self.A.T)

    def residuals(self, x: FloatArray, y: FloatArray) -> KKTResiduals:
        """Return the KKT residuals of the point x (n,) with multipliers y (m,)."""
        Ax, Px = self.A @ x, self.P @ x
        gradient = np.abs(Px + self.q + self._AT @ y).max() / max(1.0, np.abs(Px).max())
        below, above = Ax - self.lower, self.upper - Ax
        gap = np.where(y < 0, below, above)
        products = np.abs(y) * np.where(np.isinf(gap), 1.0, np.abs(gap))
        product = products.max() / max(1.0, abs(x @ Px / 2 + self.q @ x))
        violation = -min(below.min(), above.min())
        return KKTResiduals(float(gradient), max(0.0, float(violation)), float(product))
