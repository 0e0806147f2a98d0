"""Robots with linear, time-invariant dynamics.

Notation:
    x   (nx,)       state               A   (nx, nx)
    u   (nu,)       input               B   (nx, nu)
    p   (d,)        position, p = x[position]
"""

from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import FloatArray, IntArray, as_array, as_number, frozen
from scp_mpc.errors import BoundsError, InvalidArgumentError, ShapeError


@dataclass(frozen=True, eq=False)
class LinearModel:
    """x_{i+1} = A x_i + B u_i, with the position read off the state.

    Args:
        A: (nx, nx) state matrix.
        B: (nx, nu) input matrix.
        dt: Sampling time [s].
        position: Indices (d,) of the position's coordinates within the state, d = 2 or 3.

    Raises:
        ShapeError: A is not square, or B has another number of rows.
        InvalidArgumentError: `position` is not 2 or 3 distinct indices of the state.
        BoundsError: dt is not positive.
    """

    A: FloatArray
    B: FloatArray
    dt: float
    position: IntArray

    def __post_init__(self) -> None:
        """Copy, check and freeze the matrices."""
        A = as_array("A", self.A, (-1, -1))
        if A.shape[0] != A.shape[1]:
            raise ShapeError("A", f"shape {A.shape} is not square")
        B = as_array("B", self.B, (len(A), -1))
        if B.shape[1] == 0:
            raise ShapeError("B", f"shape {B.shape} has no input")
        dt = as_number("dt", self.dt)
        if dt <= 0:
            raise BoundsError("dt", f"{dt} s is not positive")
        position = np.array(self.position)
        whole = position.dtype.kind in "iu" and position.shape in ((2,), (3,))
        if not whole or len(set(position.tolist()) & set(range(len(A)))) < len(position):
            raise InvalidArgumentError(
                "position", f"{self.position!r} is not 2 or 3 distinct indices below {len(A)}"
            )
        position = position.astype(np.intp)
        position.setflags(write=False)
        object.__setattr__(self, "A", frozen(A))
        object.__setattr__(self, "B", frozen(B))
        object.__setattr__(self, "dt", dt)
        object.__setattr__(self, "position", position)

    @property
    def nx(self) -> int:
        """Number of states."""
        return len(self.A)

    @property
    def nu(self) -> int:
        """Number of inputs."""
        return int(self.B.shape[1])

    @property
    def dim(self) -> int:
        """Dimension of the workspace, 2 or 3."""
        return len(self.position)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state A x + B u."""
        return self.A @ x + self.B @ u
