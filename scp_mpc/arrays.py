"""Validated float64 arrays: what crosses the public border is copied, checked and frozen here."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scp_mpc.errors import (
    BoundsError,
    CovarianceError,
    InvalidArgumentError,
    NotFiniteError,
    ShapeError,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

_LARGEST = 1e15
_SAME_INTERVAL = 1e-6  # relative difference of intervals that is none


class SampledArray(np.ndarray[Any, np.dtype[np.float64]]):
    """An array (n, ...) that knows how far its rows are apart: `dt` seconds; None for unknown.

    Arithmetic and copies keep it, views of some of the rows do not.
    """

    dt: float | None

    @classmethod
    def of(cls, array: FloatArray, dt: float) -> "SampledArray":
        """The same data, with its interval."""
        sampled = array.view(cls)
        sampled.dt = float(dt)
        return sampled

    def __array_finalize__(self, obj: object) -> None:
        """Take over the interval where the shape is the same."""
        same = isinstance(obj, SampledArray) and obj.shape == self.shape
        self.dt = getattr(obj, "dt", None) if same else None


def require_sampled(argument: str, x: ArrayLike, wanted: float) -> None:
    """Raise unless rows that know their interval have the `wanted` one [s]: `require_interval`."""
    if isinstance(x, SampledArray):
        require_interval(argument, x.dt, wanted, "make it with the robot's dt")


def require_interval(argument: str, dt: float | None, wanted: float, remedy: str) -> None:
    """Raise unless an interval `dt` [s] is the `wanted` one; None, unknown, is believed to be.

    Raises:
        InvalidArgumentError: With both numbers and the remedy.
    """
    if dt is not None and abs(dt - wanted) > _SAME_INTERVAL * wanted:
        raise InvalidArgumentError(
            argument, f"rows are {dt:g} s apart, the robot's intervals {wanted:g} s: {remedy}"
        )


def as_array(argument: str, value: ArrayLike, *shapes: tuple[int, ...]) -> FloatArray:
    """Return `value` as a finite, C-contiguous float64 copy of one of the given shapes.

    Args:
        argument: Name used in error messages.
        value: Anything numpy can turn into an array of numbers.
        shapes: Accepted shapes; -1 stands for any length. No shape means that any will do.

    Raises:
        InvalidArgumentError: The value is not numeric.
        ShapeError: The shape fits none of `shapes`.
        NotFiniteError: An entry is NaN or infinite.
    """
    array = _as_real(argument, value, *shapes)
    require_finite(argument, array)
    return array


def as_bound(argument: str, value: ArrayLike | None, size: int, none: float) -> FloatArray:
    """Return bounds (size,) from a number, (size,) numbers, or None; frozen.

    Args:
        argument: Name used in error messages.
        value: Lower or upper bounds; infinite entries bound nothing.
        size: How many numbers they bound.
        none: What stands for no bound: minus infinity for lower bounds, infinity for upper ones.

    Raises:
        InvalidArgumentError: The value is not numeric.
        ShapeError: Neither a number nor `(size,)`.
        NotFiniteError: An entry is NaN.
        BoundsError: An entry is the infinity of the other side, or finite and beyond 1e15.
    """
    array = np.full(size, none)
    if value is not None:
        array[:] = _as_real(argument, value, (), (size,))
    wrong = array == -none
    if wrong.any():
        raise BoundsError(argument, f"{-none} at index {int(np.argmax(wrong))} allows nothing")
    require_finite(argument, np.where(array == none, 0.0, array))
    return frozen(array)


def _as_real(argument: str, value: Any, *shapes: tuple[int, ...]) -> FloatArray:
    plain = type(value) is np.ndarray and value.dtype == np.float64
    if plain and (not shapes or value.shape in shapes):
        return value.copy()  # nothing to convert, as in most control steps
    try:
        raw = np.asarray(value)
        if raw.dtype.kind not in "biuf":
            raise TypeError(f"dtype {raw.dtype}")
        if np.ma.is_masked(value):
            raise TypeError("masked entries")
        array = np.array(raw, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(argument, f"not an array of real numbers ({error})") from None
    if shapes and not any(_fits(array.shape, shape) for shape in shapes):
        wanted = " or ".join(str(shape).replace("-1", "any") for shape in shapes)
        raise ShapeError(argument, f"shape {array.shape} does not fit {wanted}")
    return array


def require_finite(argument: str, array: FloatArray) -> None:
    """Raise with the place and the value of the first entry that is not finite, or absurd.

    Raises:
        NotFiniteError: NaN or infinity.
        BoundsError: A magnitude beyond 1e15, where float64 resolves no more than metres.
    """
    if np.vdot(array, array) <= _LARGEST * _LARGEST:  # no NaN, and no entry as large: the quick way
        return
    if array.size and not np.abs(array).max() <= _LARGEST:
        place = tuple(int(i) for i in np.argwhere(~(np.abs(array) <= _LARGEST))[0])
        where = f" at index {place}" if place else ""
        if np.isfinite(array[place]):
            raise BoundsError(argument, f"{array[place]}{where} exceeds {_LARGEST:g}")
        raise NotFiniteError(argument, f"{array[place]}{where} is not finite")


def as_count(argument: str, value: object, least: int = 1) -> int:
    """Return a whole number of at least `least` as an int.

    Raises:
        InvalidArgumentError: It is not a whole number.
        BoundsError: It is too small.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise InvalidArgumentError(argument, f"{value!r} is not a whole number")
    if value < least:
        raise BoundsError(argument, f"{value} is less than {least}")
    return int(value)


def as_number(argument: str, value: Any) -> float:
    """Return `value` as a finite float.

    Raises:
        InvalidArgumentError: It is not one number, or not finite.
    """
    if type(value) is float and -_LARGEST <= value <= _LARGEST:
        return value
    return float(as_array(argument, value, ()))


def frozen(array: FloatArray) -> FloatArray:
    """Mark an array read-only and return it."""
    array.setflags(write=False)
    return array


def as_weight(argument: str, value: ArrayLike, size: int) -> FloatArray:
    """Return a weight matrix (size, size) from its diagonal or its full symmetric form.

    Raises:
        ShapeError: Neither `(size,)` nor `(size, size)`.
        CovarianceError: The matrix is not symmetric positive semi-definite.
    """
    array = as_array(argument, value, (size,), (size, size))
    matrix = np.diag(array) if array.ndim == 1 else array
    require_positive_semidefinite(argument, matrix[None])
    return frozen(np.ascontiguousarray(matrix))


def require_positive_semidefinite(argument: str, matrices: FloatArray) -> FloatArray:
    """Check a stack (n, d, d) of symmetric matrices; return their eigenvalues (n, d), ascending.

    Asymmetry and negative eigenvalues are forgiven up to 1e-9 of the largest entry: that much is
    rounding in a product such as J Sigma J'.

    Raises:
        CovarianceError: With the index of the first offender and its offending number.
    """
    allowed = 1e-9 * np.abs(matrices).max(axis=(-2, -1), initial=0.0)
    asymmetry = np.abs(matrices - np.swapaxes(matrices, -2, -1)).max(axis=(-2, -1), initial=0.0)
    if (asymmetry > allowed).any():
        at = int(np.argmax(asymmetry > allowed))
        raise CovarianceError(argument, f"matrix {at} is not symmetric (by {asymmetry[at]:.3g})")
    eigenvalues = np.linalg.eigvalsh(matrices).astype(np.float64)
    smallest = eigenvalues[..., 0]
    if (smallest < -allowed).any():
        at = int(np.argmax(smallest < -allowed))
        raise CovarianceError(
            argument,
            f"matrix {at} is not positive semi-definite (smallest eigenvalue {smallest[at]:.3g})",
        )
    return eigenvalues


def _fits(shape: Sequence[int], wanted: Sequence[int]) -> bool:
    return len(shape) == len(wanted) and all(
        w in (-1, n) for n, w in zip(shape, wanted, strict=True)
    )
