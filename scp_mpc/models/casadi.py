"""A robot given by a CasADi expression or function, with exact first and second derivatives.

Notation:
    g(x, u)     the dynamics: x' [1/s] where continuous, else the next state
    z (n,)      (x, u), n = nx + nu
    m (nx,)     weights of g's entries
"""

import math
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray, as_count
from scp_mpc.errors import InvalidArgumentError, MissingExtraError, ShapeError
from scp_mpc.models.function import FunctionModel
from scp_mpc.models.model import Linearisation, joined

_MOST_SIZES = 64  # numbers of points for which buffers are kept


class Mapped:
    """A CasADi function at many points at once, from and to numpy's arrays.

    Args:
        function: Of columns; its values dense.
        shapes: Of its values at one point, as numpy has them: CasADi's memory runs by columns.
    """

    def __init__(self, function: Any, *shapes: tuple[int, ...]) -> None:
        """Nothing is evaluated yet."""
        self._function, self._shapes = function, shapes
        self._idle: defaultdict[int, list[Any]] = defaultdict(list)  # by number of points

    def __reduce__(self) -> Any:
        """Copies make buffers of their own."""
        return Mapped, (self._function, *self._shapes)

    def __call__(self, *arguments: FloatArray) -> list[FloatArray]:
        """Return values (..., *shape), one per shape, at points (..., size)."""
        lead = arguments[0].shape[:-1]
        found = [np.empty((*lead, *shape)) for shape in self._shapes]
        count = math.prod(lead)
        if not count:
            return found
        # a buffer knows addresses only: copies have to live until it is evaluated
        points = [np.ascontiguousarray(part, dtype=np.float64) for part in arguments]
        if len(self._idle) > _MOST_SIZES:
            self._idle.clear()
        idle = self._idle[count]
        try:
            buffer, evaluate = idle.pop()  # no two threads get the same
        except IndexError:
            buffer, evaluate = self._function.map(count).buffer()
        for i, part in enumerate(points):
            buffer.set_arg(i, part.data)
        for i, part in enumerate(found):
            buffer.set_res(i, part.data)
        evaluate()
        idle.append((buffer, evaluate))
        return found


class CasadiModel(FunctionModel):
    """x' = g(x, u) by Runge-Kutta steps, or x_{i+1} = g(x_i, u_i) where `discrete`.

    Derivatives are CasADi's, all points are evaluated in one call. Needs the extra `casadi`.

    Args:
        function: A CasADi `Function` of (x, u) that returns g (nx,), or an expression of the
            symbols x and u.
        x: The symbol (nx,) of the state, with an expression.
        u: The symbol (nu,) of the input, with an expression.
        dt: Sampling time [s].
        position: Indices of the position within the state, 2 or 3.
        discrete: As of `FunctionModel`, like all others.
        heading: Likewise.
        velocity: Likewise.
        equilibrium_input: Likewise.
        substeps: Likewise.
        stopping_input: Likewise.
        state: Likewise.

    Attributes:
        dynamics: CasADi's function g of x and u.
        stops: `stopping_input` as given.

    Raises:
        MissingExtraError: CasADi is not installed.
        InvalidArgumentError: Not a function of one x and one u, other symbols in the expression, or
            no derivatives; else as of `FunctionModel`.
        ShapeError: x, u or g is no column, or g has another length than x.
    """

    def __init__(
        self,
        function: Any,
        x: Any = None,
        u: Any = None,
        *,
        dt: float,
        position: ArrayLike,
        discrete: bool = False,
        heading: int | None = None,
        velocity: ArrayLike | None = None,
        equilibrium_input: ArrayLike | None = None,
        substeps: int = 1,
        stopping_input: Callable[[FloatArray], FloatArray] | None = None,
        state: Callable[[FloatArray, FloatArray], Any] | None = None,
    ) -> None:
        """Differentiate, and check everything that can be checked."""
        self.dynamics = dynamics = _dynamics(function, x, u)
        self.stops = stopping_input
        nx, nu = dynamics.size1_in(0), dynamics.size1_in(1)
        self._rates, self._gradient, self._bend, self._after, self._sensitivity = _differentiated(
            dynamics, as_count("substeps", substeps), bool(discrete)
        )
        super().__init__(
            self._called,
            nx=nx,
            nu=nu,
            dt=dt,
            position=position,
            discrete=discrete,
            heading=heading,
            velocity=velocity,
            equilibrium_input=equilibrium_input,
            vectorised=True,
            substeps=substeps,
            stopping_input=stopping_input,
            state=state,
        )

    def derivative(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Return g (..., nx) at states (..., nx) and inputs (..., nu)."""
        return self._called(states, inputs)

    def jacobians(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        """Return dg/dz (..., nx, nx+nu) at states (..., nx) and inputs (..., nu)."""
        return self._gradient(joined(states, inputs))[0]

    def hessian(self, states: FloatArray, inputs: FloatArray, weights: FloatArray) -> FloatArray:
        """Return sum_k m_k (Hessian of g_k in z), (..., n, n), for weights m (..., nx)."""
        z = joined(states, inputs)
        return self._bend(z, np.broadcast_to(weights, (*z.shape[:-1], self.nx)))[0]

    def advance(
        self, states: FloatArray, inputs: FloatArray, fraction: ArrayLike = 1.0
    ) -> FloatArray:
        """Return the states (..., nx) after a share of an interval with the input held."""
        return self._after(*self._held(states, inputs, fraction))[0]

    def linearise(
        self, states: FloatArray, inputs: FloatArray, fraction: ArrayLike = 1.0
    ) -> Linearisation:
        """Return `advance` with its derivatives; arguments as there."""
        after, both = self._sensitivity(*self._held(states, inputs, fraction))
        return Linearisation(after, both[..., : self.nx], both[..., self.nx :])

    def _called(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        return self._rates(joined(states, inputs))[0]

    def _held(
        self, states: FloatArray, inputs: FloatArray, fraction: ArrayLike
    ) -> tuple[FloatArray, FloatArray]:
        x, u, h = self._broadcast(states, inputs, fraction)
        h = h * (self.substeps / self.dt) if self.discrete else h
        return joined(x, u), np.broadcast_to(h, (*x.shape[:-1], 1))


def _dynamics(function: Any, x: Any, u: Any) -> Any:
    """The CasADi function of x and u, checked."""
    try:
        import casadi
    except ModuleNotFoundError:
        raise MissingExtraError("CasadiModel needs CasADi: pip install 'scp-mpc[casadi]'") from None
    if not isinstance(function, casadi.Function):
        if not isinstance(function, casadi.SX | casadi.MX):
            raise InvalidArgumentError("function", f"{function!r} is nothing of CasADi")
        try:
            expression: Any = function
            function = casadi.Function("g", [x, u], [expression])
        except (RuntimeError, NotImplementedError, TypeError) as error:
            reason = str(error).strip().splitlines()[-1]
            raise InvalidArgumentError(
                "function", f"is no function of the symbols x and u alone ({reason})"
            ) from None
    elif x is not None or u is not None:
        raise InvalidArgumentError("x", "goes with an expression, not with a function")
    if (function.n_in(), function.n_out()) != (2, 1):
        raise InvalidArgumentError(
            "function", f"takes {function.n_in()} arguments and returns {function.n_out()}"
        )
    if [name.lower() for name in function.name_in()] == ["u", "x"]:
        raise InvalidArgumentError("function", "takes (u, x), but is called with (x, u)")
    shapes = function.size_in(0), function.size_in(1), function.size_out(0)
    if any(shape[1] != 1 or not shape[0] for shape in shapes) or shapes[0] != shapes[2]:
        raise ShapeError("function", f"{shapes[0]}, {shapes[1]} to {shapes[2]} is no g(x, u)")
    return function


def _differentiated(function: Any, substeps: int, discrete: bool) -> tuple[Mapped, ...]:
    """Functions of z: g, dg/dz, and of m, too, a Hessian; of h, too, f, and f with its derivative.

    Of a continuous robot h is the time of one substep, of a discrete one the share of an interval.
    """
    import casadi

    nx, nu = function.size1_in(0), function.size1_in(1)
    n = nx + nu
    symbol: Any = casadi.SX.sym
    try:
        try:
            function = function.expand()
        except RuntimeError:  # not made of scalar operations
            symbol = casadi.MX.sym
        z, m, h = symbol("z", n), symbol("m", nx), symbol("h", 1)
        x, u = z[:nx], z[nx:]
        g, after = function(x, u), x
        if discrete:
            after = x + h * (g - x)
        for _ in range(0 if discrete else substeps):
            k1 = function(after, u)
            k2 = function(after + h / 2 * k1, u)
            k3 = function(after + h / 2 * k2, u)
            k4 = function(after + h * k3, u)
            after = after + h / 6 * (k1 + 2 * (k2 + k3) + k4)
        weighed = casadi.hessian(casadi.dot(m, g), z)[0]
        slopes, sensitivity = (casadi.jacobian(value, z).T for value in (g, after))

        def mapped(arguments: list[Any], values: list[Any], *shapes: tuple[int, ...]) -> Mapped:
            dense = [casadi.densify(value) for value in values]
            return Mapped(casadi.Function("f", arguments, dense), *shapes)

        return (
            mapped([z], [g], (nx,)),
            mapped([z], [slopes], (nx, n)),
            mapped([z, m], [weighed], (n, n)),
            mapped([z, h], [after], (nx,)),
            mapped([z, h], [after, sensitivity], (nx,), (nx, n)),
        )
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1]
        raise InvalidArgumentError("function", f"has no derivatives ({reason})") from None
