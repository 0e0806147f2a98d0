"""Plants: what the robot truly does with an input."""

from typing import Protocol

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.models.linear import as_linear
from scp_mpc.models.model import Model
from scp_mpc.simulation.disturbance import Disturbance, Push


class Plant(Protocol):
    """A robot, its disturbances among it."""

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a new run."""
        ...

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the state (nx,) one interval after x (nx,) under input u (nu,)."""
        ...


class ModelPlant:
    """The controller's own model, x_{k+1} = f(x_k, u_k) + push_k(u_k).

    Args:
        model: f; a linear one where there is a disturbance.
        disturbance: What pushes; None for nothing.
    """

    def __init__(self, model: Model, disturbance: Disturbance | None = None) -> None:
        """Nothing pushes before `reset`."""
        self._model, self._disturbance = model, disturbance
        self._push: Push | None = None

    def reset(self, rng: np.random.Generator) -> None:
        """Begin a new run."""
        if self._disturbance is not None:
            self._push = self._disturbance.begin(as_linear("model", self._model), rng)

    def step(self, x: FloatArray, u: FloatArray) -> FloatArray:
        """Return the next state (nx,)."""
        after = self._model.step(x, u)
        return after if self._push is None else after + self._push(u)
