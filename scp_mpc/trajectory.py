"""A state and input trajectory, and the one that inputs lead to.

Notation:
    X   (N+1, nx)   states x_0 .. x_N
    U   (N, nu)     inputs u_0 .. u_{N-1}
    f               x_{i+1} = f(x_i, u_i)
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray, as_array
from scp_mpc.errors import ShapeError


@dataclass(frozen=True, eq=False)
class Trajectory:
    """States (N+1, nx) and inputs (N, nu) over the same horizon.

    Raises:
        ShapeError: The two lengths do not belong together.
        NotFiniteError: NaN or infinity.
    """

    states: FloatArray
    inputs: FloatArray

    def __post_init__(self) -> None:
        """Copy and check both arrays."""
        object.__setattr__(self, "states", as_array("states", self.states, (-1, -1)))
        object.__setattr__(self, "inputs", as_array("inputs", self.inputs, (-1, -1)))
        if len(self.states) != len(self.inputs) + 1:
            raise ShapeError(
                "states",
                f"{len(self.states)} states do not belong to {len(self.inputs)} inputs",
            )


def rollout(
    step: Callable[[FloatArray, FloatArray], FloatArray], x0: FloatArray, inputs: ArrayLike
) -> Trajectory:
    """Apply `inputs` (N, nu) from the state `x0` (nx,) and collect the states."""
    U = as_array("inputs", inputs, (-1, -1))
    X = [x0]
    for u in U:
        X.append(step(X[-1], u))
    return Trajectory(np.array(X), U)
