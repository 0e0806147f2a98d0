"""A robot that something unseen pushes: its state carries the push along.

    x_{i+1} = A x_i + B u_i + E w_i,    w_{i+1} = alpha w_i

Whoever plans with this model plans with a push that fades: a first-order Gauss-Markov process
without its noise. Pannocchia & Rawlings (2003), Disturbance models for offset-free model-predictive
control, AIChE J. 49(2).

Notation:
    x   (nx,)       state of the robot      w       (nw,)       disturbance
    z   (nx+nw,)    [x; w], this model's state
    A   (nx, nx)    B (nx, nu)              E       (nx, nw)    what w does to x
"""

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray, as_array, as_number, frozen
from scp_mpc.errors import BoundsError, InvalidArgumentError, ShapeError
from scp_mpc.models.linear import LinearModel


class Disturbed(LinearModel):
    """A linear robot with a disturbance behind its own state: z = [x; w].

    Args:
        nominal: The robot without a disturbance.
        alpha: What is left of the disturbance one step later, 0 to 1; 1 for a constant one.
        affects: Indices (nw,) of the states that are pushed, or E (nx, nw). None: whatever the
            inputs affect, E = B, so that w is an unknown input.

    Attributes:
        nominal: As above.
        alpha: As above.
        E: (nx, nw).

    Raises:
        BoundsError: alpha is not within [0, 1].
        ShapeError: `affects` does not fit the state.
        InvalidArgumentError: `affects` names no states of the robot, or one twice.
    """

    nominal: LinearModel
    alpha: float
    E: FloatArray

    def __init__(
        self, nominal: LinearModel, alpha: float = 0.85, affects: ArrayLike | None = None
    ) -> None:
        """Put robot and disturbance into one pair of matrices."""
        if not isinstance(nominal, LinearModel) or isinstance(nominal, Disturbed):
            raise InvalidArgumentError("nominal", f"{nominal!r} is not a plain LinearModel")
        alpha = as_number("alpha", alpha)
        if not 0 <= alpha <= 1:
            raise BoundsError("alpha", f"{alpha} is not within [0, 1]")
        E = nominal.B if affects is None else _columns(affects, nominal.nx)
        nw = E.shape[1]
        A = np.block([[nominal.A, E], [np.zeros((nw, nominal.nx)), alpha * np.eye(nw)]])
        B = np.concatenate([nominal.B, np.zeros((nw, nominal.nu))])
        super().__init__(A, B, nominal.dt, nominal.position, nominal.velocity)
        for name, value in {"nominal": nominal, "alpha": alpha, "E": E}.items():
            object.__setattr__(self, name, value)

    @property
    def nw(self) -> int:
        """Number of disturbances."""
        return int(self.E.shape[1])

    def between(self, fraction: float) -> tuple[FloatArray, FloatArray]:
        """Return C (d, nx+nw) and D (d, nu) as `LinearModel.between`; w is held like an input."""
        plain = self.nominal
        pushed = LinearModel(plain.A, np.hstack([self.E, plain.B]), plain.dt, plain.position)
        C, D = pushed.between(fraction)
        return np.hstack([C, D[:, : self.nw]]), np.ascontiguousarray(D[:, self.nw :])

    def joined(self, states: FloatArray, disturbance: FloatArray | None = None) -> FloatArray:
        """Append a disturbance (nw,), none if None, to states (..., nx): (..., nx+nw)."""
        w = np.zeros(self.nw) if disturbance is None else disturbance
        tail = np.broadcast_to(w, (*states.shape[:-1], self.nw))
        return np.concatenate([states, tail], axis=-1)


def _columns(affects: ArrayLike, nx: int) -> FloatArray:
    """E from what the caller wrote."""
    array = np.asarray(affects)
    if array.ndim == 1 and array.dtype.kind in "iu":
        indices = array.tolist()
        if not indices or len(set(indices) & set(range(nx))) < len(indices):
            raise InvalidArgumentError("affects", f"{affects!r} are not distinct indices < {nx}")
        return frozen(np.eye(nx)[:, indices])
    E = as_array("affects", affects, (nx, -1))
    if not E.shape[1] or not E.any():
        raise ShapeError("affects", f"shape {E.shape} pushes nothing")
    return frozen(E)
