"""A robot given by a CasADi expression or function, with exact first and second derivatives.

Notation:
    g(x, u)     the dynamics: x' [1/s] where continuous, else the next state
    z (n,)      (x, u), n = nx + nu
    m (nx,)     weights of g's entries
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray
from scp_mpc.errors import InvalidArgumentError, MissingExtraError, ShapeError
from scp_mpc.models.function import FunctionModel
from scp_mpc.models.model import joined


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
        dynamics = _dynamics(function, x, u)
        nx, nu = self._nx, self._nu = dynamics.size1_in(0), dynamics.size1_in(1)
        self._rates, self._jacobian, self._hessian = _differentiated(dynamics, nx, nu)
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
        return _mapped(self._jacobian, (self.nx, self.nx + self.nu), joined(states, inputs))

    def hessian(self, states: FloatArray, inputs: FloatArray, weights: FloatArray) -> FloatArray:
        """Return sum_k m_k (Hessian of g_k in z), (..., n, n), for weights m (..., nx)."""
        z = joined(states, inputs)
        return _mapped(
            self._hessian, (z.shape[-1],) * 2, z, np.broadcast_to(weights, (*z.shape[:-1], self.nx))
        )

    def _called(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        return _mapped(self._rates, (self.nx,), joined(states, inputs))


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


def _differentiated(function: Any, nx: int, nu: int) -> tuple[Any, Any, Any]:
    """Functions of z: g (nx,), its transposed Jacobian (n, nx), and of m, too, a Hessian (n, n)."""
    import casadi

    symbol: Any
    try:
        try:
            function, symbol = function.expand(), casadi.SX.sym
        except RuntimeError:  # not made of scalar operations
            symbol = casadi.MX.sym
        z, m = symbol("z", nx + nu), symbol("m", nx)
        g = function(z[:nx], z[nx:])
        weighed = casadi.hessian(casadi.dot(m, g), z)[0]
        return (
            casadi.Function("g", [z], [casadi.densify(g)]),
            casadi.Function("J", [z], [casadi.densify(casadi.jacobian(g, z).T)]),
            casadi.Function("H", [z, m], [casadi.densify(weighed)]),
        )
    except RuntimeError as error:
        reason = str(error).strip().splitlines()[-1]
        raise InvalidArgumentError("function", f"has no derivatives ({reason})") from None


@lru_cache(maxsize=256)
def _many(function: Any, count: int) -> Any:
    """A function of so many points; a solver asks for few counts, and it takes 60 us to make."""
    return function.map(count)


def _mapped(function: Any, shape: tuple[int, ...], *arguments: FloatArray) -> FloatArray:
    """Values (..., *shape) at points (..., size): CasADi's memory runs by columns."""
    lead = arguments[0].shape[:-1]
    values = np.empty((*lead, *shape))
    if values.size:
        # the buffer knows addresses only: copies have to live until it is evaluated
        points = [np.ascontiguousarray(part, dtype=np.float64) for part in arguments]
        buffer, evaluate = _many(function, math.prod(lead)).buffer()
        for i, part in enumerate(points):
            buffer.set_arg(i, part.data)
        buffer.set_res(0, values.data)
        evaluate()
    return values
