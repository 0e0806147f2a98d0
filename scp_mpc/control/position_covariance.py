"""How far the robot may be from its plan: what is not known now, and what the wind will add.

The plan's inputs are not the ones that will be applied: the next plans react. Left out (open
loop), the covariance grows without end. An ancillary feedback u = u_plan - K (z_hat - z_plan)
stands in for the plans to come (closed loop), with K of the linear-quadratic regulator; the
estimate z_hat and its error are uncorrelated, so that their covariances add:

    D_{i+1} = (F - G K) D_i (F - G K)' + (S^-_{i+1} - S_{i+1}),  D_0 = 0     z_hat - z_plan
    S_{i+1} = that of the filter after measurement i + 1,        S_0 now     z - z_hat
    covariance  = D_i + S_i, the rows and columns of the position

Yan & Bitmead (2005), Incorporating state estimation into model predictive control, Automatica
41(4); van den Berg, Abbeel & Goldberg (2011), LQG-MP, IJRR 30(7). The inputs' bounds are not seen:
where they bite, the true covariance is larger.

Notation:
    F   (nz, nz)    state matrix with the disturbance       K   (nu, nz)    feedback
    G   (nz, nu)    input matrix                            S, D (nz, nz)   covariances
"""

from typing import Literal, get_args

import numpy as np

from scp_mpc.arrays import FloatArray, frozen
from scp_mpc.control.estimator import DisturbanceEstimator
from scp_mpc.control.regulator import Regulator
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.problem import Problem

Prediction = Literal["none", "open loop", "closed loop"]
_SETTLED = 1e-6  # relative change of a covariance that is none


class PositionCovariance:
    """Covariance of the robot's position along the horizon.

    Args:
        problem: Without the disturbance: horizon, and weights of the feedback.
        estimator: Of state and disturbance.
        prediction: Which inputs are to come, "open loop" or "closed loop"; "none": do not ask.
        terminal_input_weight: Of the feedback; see `Regulator`.

    Raises:
        InvalidArgumentError: No such prediction, or no feedback stabilises the robot.
    """

    def __init__(
        self,
        problem: Problem,
        estimator: DisturbanceEstimator,
        prediction: Prediction,
        terminal_input_weight: float = 1.0,
    ) -> None:
        """Find the feedback."""
        if prediction not in get_args(Prediction):
            names = ", ".join(map(repr, get_args(Prediction)))
            raise InvalidArgumentError("prediction", f"{prediction!r} is none of {names}")
        self._estimator, self._horizon, self._prediction = (
            estimator,
            problem.horizon,
            prediction,
        )
        if prediction == "closed loop":
            model = estimator.model
            self._loop = (
                model.A - model.B @ Regulator(problem, model, terminal_input_weight).feedback
            )
        self.reset()

    def reset(self) -> None:
        """Forget what was propagated last."""
        self._known: tuple[FloatArray, FloatArray] | None = None

    def along(self, covariance: FloatArray) -> FloatArray | None:
        """Covariances (N+1, d, d) [m^2] from that of the estimate now; None without prediction."""
        if self._prediction == "none":
            return None
        known = self._known
        # It settles within a few steps; from then on there is nothing to compute.
        if known is None or np.abs(known[0] - covariance).max() > _SETTLED * np.abs(known[0]).max():
            known = self._known = (covariance, self._propagated(covariance))
        return known[1]

    def _propagated(self, S: FloatArray) -> FloatArray:
        known, position = self._estimator, self._estimator.model.position
        D = np.zeros_like(S)
        covariance = [S]
        for _ in range(self._horizon):
            before = known.ahead(S)
            if self._prediction == "open loop":
                S = before
            else:
                S = known.behind(before)
                D = self._loop @ D @ self._loop.T + before - S
            covariance.append(S + D)
        blocks = np.array(covariance)[:, position[:, None], position]
        return frozen((blocks + blocks.swapaxes(1, 2)) / 2)
