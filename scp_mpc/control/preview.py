"""What a reference does beyond the horizon, folded into the last row within it.

With the Riccati equation's terminal weight, a plan of N stages is the beginning of the optimal one
without end, where no constraint is active beyond stage N and the reference goes on by itself
(constant velocity). A reference that needs inputs, as a circle does, makes the cost to go
affine; moving the reference's last row by a linear function of the later ones accounts for that
exactly (`scp_mpc.models.riccati`).

Notation:
    N, L    horizon, rows beyond it
    w_i     (nx,)   A xref_i - xref_{i+1}
"""

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray, as_array, as_count, require_sampled
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.models.linear import LinearModel
from scp_mpc.models.riccati import lqr_preview
from scp_mpc.problem import Problem


class Preview:
    """Folds L rows of reference beyond the horizon into the last row of the N + 1 within.

    After these rows the reference is taken to go on without input. What lies L stages away counts
    as the closed loop's slowest pole to the power of L.

    Args:
        problem: With `Qf="lqr"`.
        rows: L.

    Raises:
        InvalidArgumentError: The model is not linear, or the terminal weight not that of the
            Riccati equation.
    """

    def __init__(self, problem: Problem, rows: int) -> None:
        """Solve the Riccati equation and take the closed loop to its powers."""
        self._problem, self._rows = problem, as_count("rows", rows)
        model = problem.model
        if not isinstance(model, LinearModel):
            raise InvalidArgumentError("problem", f"{model!r} is not a LinearModel")
        S, self._moves = lqr_preview(model.A, model.B, problem.Q, problem.R, self._rows)
        self._A = model.A
        away = float(np.abs(problem.Qf - S).max())
        if away > 1e-9 * np.abs(S).max():
            raise InvalidArgumentError(
                "problem", f'Qf is not that of Problem(Qf="lqr"), by {away:.3g}'
            )

    def fold(self, x_ref: ArrayLike) -> FloatArray:
        """Return (N+1, nx) for `MPC.step` from a reference (N+1+L, nx).

        The optimal inputs are those of the long reference; the cost differs by a constant.

        Raises:
            ShapeError: The reference is not N + 1 + L rows long.
            NotFiniteError: NaN or infinity.
        """
        N, A = self._problem.horizon, self._A
        require_sampled("x_ref", x_ref, self._problem.model.dt)
        rows = as_array("x_ref", x_ref, (N + 1 + self._rows, len(A)))
        w = rows[N:-1] @ A.T - rows[N + 1 :]
        folded = rows[: N + 1].copy()
        folded[N] -= np.einsum("jkl,jl->k", self._moves, w)
        return folded
