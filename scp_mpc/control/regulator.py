"""The linear-quadratic regulator of a robot with a disturbance: its feedback and its cost-to-go.

    P   by Riccati's equation for A, B, Q, R;       L = A - B K_x
    P_w = L' (P E + alpha P_w)
    K   = (R + B'PB)^-1 B' [P A, P E + alpha P_w]   u = -K z

The cost-to-go is |x + P^-1 P_w w|^2_P but for a term in w alone, which no input changes: Anderson &
Moore (1990), Optimal Control: Linear Quadratic Methods, on regulators with disturbances.

Notation:
    A, B, E, alpha  as in `models/disturbed.py`     z   (nz,)       [x; w]
    P   (nx, nx)    cost-to-go of the state         P_w (nx, nw)    of state and disturbance
"""

import numpy as np
from scipy.linalg import solve_discrete_are

from scp_mpc.arrays import FloatArray, as_number
from scp_mpc.errors import BoundsError, InvalidArgumentError
from scp_mpc.models.disturbed import Disturbed
from scp_mpc.problem import Problem


class Regulator:
    """Infinite horizon, no obstacles, no bounds.

    Args:
        problem: Without the disturbance: Q and R.
        model: Its robot with the disturbance.
        terminal_input_weight: Factor on R. With more of it the regulator asks for less, so that it
            stays within the inputs' bounds for longer, and its cost-to-go is worth more as a
            terminal weight (De Dona, Seron, Mayne & Goodwin, 2002, Systems & Control Letters
            47(1)).

    Attributes:
        feedback: K (nu, nz).

    Raises:
        BoundsError: `terminal_input_weight` is not positive.
        InvalidArgumentError: No feedback stabilises the robot.
    """

    def __init__(
        self, problem: Problem, model: Disturbed, terminal_input_weight: float = 1.0
    ) -> None:
        """Solve both equations."""
        if as_number("terminal_input_weight", terminal_input_weight) <= 0:
            raise BoundsError("terminal_input_weight", f"{terminal_input_weight} is not positive")
        A, B, R = model.nominal.A, model.nominal.B, terminal_input_weight * problem.R
        try:
            P = np.asarray(solve_discrete_are(A, B, problem.Q, R))
        except (np.linalg.LinAlgError, ValueError) as error:
            raise InvalidArgumentError("problem", f"no regulator for it ({error})") from None
        inverse = np.linalg.inv(R + B.T @ P @ B)
        Kx = inverse @ B.T @ P @ A
        L, push = (A - B @ Kx).T, P @ model.E
        Pw = np.linalg.solve(np.eye(len(A)) - model.alpha * L, L @ push)
        self.feedback: FloatArray = np.hstack([Kx, inverse @ B.T @ (push + model.alpha * Pw)])
        self._P, self._Pw = (P + P.T) / 2, Pw

    def terminal_weight(self) -> FloatArray:
        """(nz, nz), positive semi-definite."""
        P, Pw = self._P, self._Pw
        map_ = np.hstack([np.eye(len(P)), np.linalg.pinv(P, hermitian=True) @ Pw])
        weight: FloatArray = map_.T @ P @ map_
        return (weight + weight.T) / 2
