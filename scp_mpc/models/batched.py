"""A user's function at many points: in one call where it allows that, else one by one."""

import inspect
import logging
from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from scp_mpc.arrays import FloatArray, as_array
from scp_mpc.errors import InvalidArgumentError, ShapeError

Layout = Literal["any", "rows", "columns", "single"]
_log = logging.getLogger(__name__)
_MANY = 600  # points of the trial; norms and the like over all of them give themselves away
_ALIKE = 1e-9  # relative difference of values that count as the same: array and scalar sines differ


class Batched:
    """A function of x (nx,) and u (nu,) over any leading axes.

    Layouts: "any" takes (..., nx) and (..., nu); "rows" (K, nx) and (K, nu), points first;
    "columns" (nx, K) and (nu, K), points last, as `x[0]`, `x[1]` read them; "single" one point.

    Args:
        name: Of the argument, for messages.
        function: It.
        shape: Of its value at one point; its second axis may come in two parts, as a pair.
        layout: How it is called; None to try "rows" and "columns" and compare with "single".
        point: A state and an input at which it must have a value.
        trial: States (P, nx) and inputs (P, nu) to try at, P no size of the model's.

    Raises:
        InvalidArgumentError: It raises at that point, or takes u first.
        ShapeError: It returns another shape.
        NotFiniteError: It returns NaN or infinity there.
    """

    def __init__(
        self,
        name: str,
        function: Callable[[Any, Any], Any],
        shape: tuple[int, ...],
        layout: Layout | None,
        point: tuple[FloatArray, FloatArray],
        trial: tuple[FloatArray, FloatArray],
    ) -> None:
        """Call it once, and find the layout."""
        self._name, self._function, self._shape = name, function, shape
        self.layout: Layout = layout or "single"
        if _parameters(function) == ["u", "x"]:
            raise InvalidArgumentError(name, "takes (u, x), but is called with (x, u)")
        try:
            as_array(name, self(*point))
        except InvalidArgumentError:
            raise
        except Exception as error:
            raise InvalidArgumentError(name, f"raises {error!r}, called with (x, u)") from error
        if layout is None:
            self._find(*trial)

    def __call__(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Return the values (..., *shape) at states (..., nx) and inputs (..., nu).

        Raises:
            ShapeError: It returns another shape.
        """
        lead, x, u = states.shape[:-1], states.view(), inputs.view()
        if inputs.shape[:-1] != lead:
            lead = np.broadcast_shapes(lead, inputs.shape[:-1])
            x = np.broadcast_to(states, (*lead, states.shape[-1]))
            u = np.broadcast_to(inputs, (*lead, inputs.shape[-1]))
        x.setflags(write=False)  # whatever a user's function does
        u.setflags(write=False)
        if self.layout == "any":
            return self._shaped(self._read(self._function(x, u)), (*lead, *self._shape))
        x, u = x.reshape(-1, x.shape[-1]), u.reshape(-1, u.shape[-1])
        if self.layout == "rows":
            values = self._read(self._function(x, u))
        elif self.layout == "columns":
            values = self._read(self._function(x.T, u.T), columns=True)
            values = np.moveaxis(self._shaped(values, (*self._shape, len(x))), -1, 0)
        else:
            rows = [self._read(self._function(*point)) for point in zip(x, u, strict=True)]
            values = np.array([self._shaped(row, self._shape) for row in rows])
        return self._shaped(values, (len(x), *self._shape)).reshape(*lead, *self._shape)

    def _find(self, x: FloatArray, u: FloatArray) -> None:
        with np.errstate(all="ignore"):
            try:
                expected = self(x, u)
            except Exception:  # no function of all the plane: nothing to compare with
                return
            size, times = np.abs(expected).max(axis=0, initial=0.0), -(-_MANY // len(x))
            expected = np.concatenate([expected] * times)
            x, u = np.concatenate([x] * times), np.concatenate([u] * times)
            for layout in ("rows", "columns"):
                self.layout = layout
                try:
                    found = self(x, u)
                except Exception:  # whatever a function of one point does with many
                    continue
                if (
                    found.dtype == expected.dtype
                    and (
                        (np.abs(found - expected) <= _ALIKE * size)
                        | (np.isnan(found) & np.isnan(expected))
                        | (found == expected)
                    ).all()
                ):
                    return
        self.layout = "single"
        _log.info("%s takes one point at a time, which is slower: numpy, no branches?", self._name)

    def _read(self, value: Any, columns: bool = False) -> Any:
        """A value as an array: the parts of a pair side by side, constants as often as need be."""
        if len(self._shape) == 1:
            if columns and isinstance(value, list | tuple):
                value = np.broadcast_arrays(*value)
            return np.asarray(value)
        if not isinstance(value, tuple | list) or len(value) != 2:
            raise InvalidArgumentError(self._name, "the pair dg/dx, dg/du is needed")
        by_x, by_u = (np.asarray(part) for part in value)
        axis = 1 if columns else -1
        if by_x.ndim < 2 or by_x.ndim != by_u.ndim:
            raise ShapeError(self._name, f"shapes {by_x.shape} and {by_u.shape} are no pair")
        try:
            return np.concatenate([by_x, by_u], axis=axis)
        except ValueError:
            raise ShapeError(
                self._name, f"shapes {by_x.shape} and {by_u.shape} are no pair"
            ) from None

    def _shaped(self, value: FloatArray, shape: tuple[int, ...]) -> FloatArray:
        if value.shape != shape:
            raise ShapeError(self._name, f"shape {value.shape} returned, {shape} needed")
        return value


def _parameters(function: Callable[[Any, Any], Any]) -> list[str]:
    try:
        return [name.lower() for name in inspect.signature(function).parameters][:2]
    except (TypeError, ValueError):  # has no signature
        return []
