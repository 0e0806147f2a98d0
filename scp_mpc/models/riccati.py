"""The linear-quadratic regulator: what is left to pay when nothing constrains any more.

    S = Q + A' S A - A' S B K,    K = (R + B' S B)^-1 B' S A

The inputs u = -K e drive e_{i+1} = A e_i + B u_i to zero at the least cost, and from e_0 on

    min  sum_{i=0..inf} |e_i|^2_Q + |u_i|^2_R  =  e_0' S e_0.

As the weight of the last state, S makes a finite horizon an infinite one wherever no constraint is
active beyond it.

Notation:
    e   (nx,)       error x - xref          S   (nx, nx)    weight of the cost to go
    u   (nu,)       input                   K   (nu, nx)    gain
    w_i (nx,)       A xref_i - xref_{i+1}: by how much the reference misses the input-free dynamics
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import solve_discrete_are

from scp_mpc.arrays import FloatArray, as_array, as_weight, frozen
from scp_mpc.errors import InvalidArgumentError, ShapeError
from scp_mpc.models.linear import LinearModel

_ACCURACY = 1e-6  # of the Riccati equation, relative: S is exact to far more where it exists
_TOUCHING = 1e-9  # distance from the unit circle, or from losing rank, that counts as none


def lqr_weight(A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike) -> FloatArray:
    """Return S (nx, nx), the stabilising solution of the discrete algebraic Riccati equation.

    Use it as `Problem.Qf`; for robots that are not linear, with A and B of a linearisation.

    Args:
        A: (nx, nx) state matrix.
        B: (nx, nu) input matrix.
        Q: State weight (nx,) or (nx, nx), positive semi-definite.
        R: Input weight (nu,) or (nu, nu), positive definite.

    Raises:
        ShapeError: The shapes do not belong together.
        InvalidArgumentError: There is no such solution: R is singular, or a mode of A that does
            not decay is out of the inputs' reach, or a lasting oscillation costs nothing.
    """
    A, B, Q, R = _checked(A, B, Q, R)
    try:
        found: Any = solve_discrete_are(A, B, Q, R)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise _why(A, B, Q, str(error)) from None
    S: FloatArray = (found + found.T) / 2
    closed = A - B @ _gain(A, B, R, S)
    residual = np.abs(Q + A.T @ S @ closed - S).max()
    radius = np.abs(np.linalg.eigvals(closed)).max()
    if not (residual <= _ACCURACY * np.abs(S).max(initial=1.0) and radius < 1 - _TOUCHING):
        raise _why(A, B, Q, f"closed loop with an eigenvalue of magnitude {radius:.6g}")
    return frozen(S)


def lqr_gain(A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike) -> FloatArray:
    """Return K (nu, nx): u = -K (x - xref) is optimal from any state on, for ever.

    Raises:
        InvalidArgumentError: Or a subclass, as `lqr_weight`.
    """
    S = lqr_weight(A, B, Q, R)
    A, B, Q, R = _checked(A, B, Q, R)
    return frozen(_gain(A, B, R, S))


def lqr_preview(
    A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, count: int
) -> tuple[FloatArray, FloatArray]:
    """Return (S, P): what the reference beyond a stage N adds to the cost to go from there.

    Where the reference needs inputs, the cost to go is e' S e + 2 q' e + const with
    q = sum_{j>=0} ((A - B K)')^{j+1} S w_{N+j}. Completing the square, that is the cost e' S e
    about a reference which is moved to xref_N - sum_j P_j w_{N+j}, P_j = S^+ ((A - B K)')^{j+1} S.
    (q lies in the range of S, or the cost to go would be unbounded below.)

    Args:
        A: (nx, nx) state matrix.
        B: (nx, nu) input matrix.
        Q: State weight.
        R: Input weight.
        count: L, how many rows w to foresee; the powers decay with the closed loop's poles.

    Returns:
        S (nx, nx) and P (L, nx, nx).

    Raises:
        InvalidArgumentError: Or a subclass, as `lqr_weight`.
    """
    S = lqr_weight(A, B, Q, R)
    A, B, Q, R = _checked(A, B, Q, R)
    back = np.transpose(A - B @ _gain(A, B, R, S))
    P: FloatArray = np.empty((count, *S.shape))
    power = S
    for j in range(count):
        power = back @ power
        P[j] = power
    inverse: Any = np.linalg.pinv(S, hermitian=True)
    return S, frozen(inverse @ P)


def terminal_weight(model: object, Q: FloatArray, R: FloatArray) -> FloatArray:
    """Return S (nx, nx) for a model, for `Problem(Qf="lqr")`.

    Raises:
        InvalidArgumentError: The model is not linear, or the equation has no solution.
    """
    if not isinstance(model, LinearModel):
        raise InvalidArgumentError(
            "Qf",
            f"'lqr' needs a LinearModel, not {model!r}: pass the matrix lqr_weight(A, B, Q, R) of a"
            " linearisation",
        )
    return lqr_weight(model.A, model.B, Q, R)


def _checked(
    A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    A = as_array("A", A, (-1, -1))
    if A.shape[0] != A.shape[1]:
        raise ShapeError("A", f"shape {A.shape} is not square")
    B = as_array("B", B, (len(A), -1))
    R = as_weight("R", R, B.shape[1])
    smallest, largest = np.linalg.eigvalsh(R)[[0, -1]]
    if smallest <= 1e-15 * largest or largest <= 0:
        raise InvalidArgumentError("R", f"smallest eigenvalue {smallest:.3g}: R is singular")
    return A, B, as_weight("Q", Q, len(A)), R


def _gain(A: FloatArray, B: FloatArray, R: FloatArray, S: FloatArray) -> FloatArray:
    K: Any = np.linalg.solve(R + B.T @ S @ B, B.T @ S @ A)
    return K


def _why(A: FloatArray, B: FloatArray, Q: FloatArray, found: str) -> InvalidArgumentError:
    """The mode that stands in the way (Popov, Belevitch and Hautus), or else what was found."""
    modes = np.linalg.eigvals(A)
    for mode in modes[np.abs(modes) >= 1 - 1e-6]:
        shifted = A - mode * np.eye(len(A))
        small = 1e-6 * max(1.0, np.abs(A).max(), np.abs(B).max())
        if np.linalg.svd(np.hstack([shifted, B]), compute_uv=False)[-1] < small:
            return InvalidArgumentError(
                "A", f"no input reaches its mode {_shown(mode)}, which does not decay by itself"
            )
        unseen = np.linalg.svd(np.vstack([shifted, Q]), compute_uv=False)[-1] < small
        if unseen and abs(abs(mode) - 1) < 1e-6:
            return InvalidArgumentError(
                "Q", f"puts no weight on the mode {_shown(mode)} of A, which lasts for ever"
            )
    return InvalidArgumentError("Q", f"the Riccati equation has no stabilising solution ({found})")


def _shown(mode: complex) -> str:
    return f"{mode:.6g}" if mode.imag else f"{mode.real:.6g}"
