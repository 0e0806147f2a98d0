"""Scenes: everything outside of the robot, from bodies whose way is known.

A scene that reacts to the robot, or draws its people anew for each run, is a subclass with its own
`reset` and `advance`.

Notation:
    M   number of bodies        d   dimension of the workspace
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray, as_array, frozen
from scp_mpc.obstacles.polytope import Polytope
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.settings import require_positive


@dataclass(frozen=True, eq=False)
class Body:
    """Something in the way: a disc or ball, or a convex polytope rounded by its radius.

    Args:
        position: (d,) for ever [m], or a function from the time [s] to (d,), with NaN for absent.
        radius: [m].
        shape: Polytope in the body's own frame; None for a disc.
        covariances: (d, d), or (N+1, d, d) over a horizon, of what a perfect sensor tells of the
            body's true future [m^2]; None for certainty.
        name: What the robot knows it by.
    """

    position: FloatArray | Callable[[float], ArrayLike]
    radius: float
    shape: Polytope | None = None
    covariances: FloatArray | None = None
    name: int | str | None = None

    def __post_init__(self) -> None:
        """Copy and check."""
        if not callable(self.position):
            fixed = frozen(as_array("position", self.position, (2,), (3,)))
            object.__setattr__(self, "position", fixed)
        if self.shape is None or self.radius != 0:
            require_positive("radius", self.radius)

    def at(self, time: float) -> FloatArray:
        """Position (d,) at a time [m]."""
        if callable(self.position):
            return np.asarray(self.position(time), dtype=np.float64)
        return self.position

    def predicted(self, time: float, dt: float, horizon: int) -> ObstaclePrediction:
        """The true future from a time on; who leaves meanwhile is told to go on as it went."""
        if callable(self.position):
            means = np.array([self.at(time + i * dt) for i in range(horizon + 1)])
            gone = np.isnan(means).any(axis=1)
            if gone.any() and (k := int(gone.argmax())):
                way = means[k - 1] - means[max(k - 2, 0)]
                means[k:] = means[k - 1] + np.arange(1, horizon + 2 - k)[:, None] * way
        else:
            means = np.tile(self.position, (horizon + 1, 1))
        Sigma = self.covariances
        if Sigma is None:
            Sigma = np.zeros((means.shape[1], means.shape[1]))
        more: dict[str, Any] = {"name": self.name, "shape": self.shape, "dt": dt}
        return ObstaclePrediction(means, Sigma, self.radius, **more)


class Scene:
    """Where the robot starts, what it is to track, and what is in its way.

    Args:
        start: (nx,) state of the robot at time 0.
        reference: (nx,) to be held, or a function of time [s] and state (nx,) that returns what
            `MPC.step` takes for x_ref.
        bodies: What is in the way.
    """

    def __init__(
        self,
        start: ArrayLike,
        reference: ArrayLike | Callable[[float, FloatArray], ArrayLike],
        bodies: Sequence[Body] = (),
    ) -> None:
        """Copy what can be copied."""
        self._start = frozen(as_array("start", start, (-1,)))
        self._reference = reference if callable(reference) else np.array(reference, np.float64)
        self._bodies = tuple(bodies)

    def start(self) -> FloatArray:
        """State (nx,) of the robot at time 0."""
        return self._start

    @property
    def bodies(self) -> tuple[Body, ...]:
        """What is in the way, M of it; radii, shapes and names do not change during a run."""
        return self._bodies

    def x_ref(self, time: float, x: FloatArray) -> FloatArray:
        """Reference (nx,) or (N+1, nx) for a robot in state x (nx,) at a time."""
        if callable(self._reference):
            return np.asanyarray(self._reference(time, x), dtype=np.float64)
        return self._reference

    def predictions(self, time: float, dt: float, horizon: int) -> list[ObstaclePrediction]:
        """What a perfect sensor tells of all bodies that are there."""
        return [
            body.predicted(time, dt, horizon)
            for body in self.bodies
            if not np.isnan(body.at(time)).any()
        ]

    def reset(self, rng: np.random.Generator) -> FloatArray:  # noqa: ARG002
        """Positions (M, d) of the bodies at time 0 of a new run [m], NaN where absent."""
        return self._positions(0.0)

    def advance(self, time: float, x: FloatArray) -> FloatArray:  # noqa: ARG002
        """Positions (M, d) at a time [m], one interval after the last, in straight lines.

        Args:
            time: At the end of the interval [s].
            x: (nx,) state of the robot there.
        """
        return self._positions(time)

    def _positions(self, time: float) -> FloatArray:
        return np.array([body.at(time) for body in self.bodies])
