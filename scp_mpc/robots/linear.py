"""Robots with linear, time-invariant dynamics.

Notation:
    x   (nx,)       state               A   (nx, nx)
    u   (nu,)       input               B   (nx, nu)
    p   (d,)        position, p = x[position]
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import fractional_matrix_power

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

    def between(self, fraction: float) -> tuple[FloatArray, FloatArray]:
        """Return C (d, nx) and D (d, nu): the position C x + D u within an interval.

        For an input held over the interval, [[A, B], [0, I]] ^ fraction advances state and input
        by that part of it. Where that power is not real, as for a purely discrete model, the
        position is interpolated between both ends.

        Args:
            fraction: Of the interval, between 0 and 1.
        """
        nx, size = self.nx, self.nx + self.nu
        whole = np.eye(size)
        whole[:nx, :nx], whole[:nx, nx:] = self.A, self.B
        part: Any = np.asarray(fractional_matrix_power(whole, fraction))
        rest = np.asarray(fractional_matrix_power(whole, 1 - fraction))
        away = np.abs(rest @ part - whole).max()
        if np.iscomplexobj(part) or not away <= 1e-9 * np.abs(whole).max():
            part = (1 - fraction) * np.eye(size) + fraction * whole
        rows = np.ascontiguousarray(part[self.position].real)
        return rows[:, :nx], rows[:, nx:]

    def brake(self, x: FloatArray) -> FloatArray:
        """Return the input (nu,), bounds aside, after which the position comes to rest.

        Without further input the next position but one would differ from the next by
        P (A - I) (A x + B u); least squares make that vanish.
        """
        halt: FloatArray = -self._braking @ x
        return halt

    @cached_property
    def _braking(self) -> FloatArray:
        drift = (self.A - np.eye(self.nx))[self.position]
        gain: FloatArray = np.linalg.pinv(drift @ self.B) @ drift @ self.A
        return gain
