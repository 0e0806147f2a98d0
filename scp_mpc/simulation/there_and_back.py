"""There and back again: a robot that crosses a scene for as long as the run lasts."""

from collections.abc import Sequence

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.control.mpc import MPC
from scp_mpc.control.path import Path
from scp_mpc.control.path_reference import PathReference
from scp_mpc.errors import InvalidArgumentError
from scp_mpc.models.model import Model
from scp_mpc.simulation.crossing import Crossing
from scp_mpc.simulation.run import Run
from scp_mpc.simulation.scene import Body, Scene
from scp_mpc.simulation.simulate import simulate


class ThereAndBack(Scene):
    """The robot turns round at either end of a crossing.

    Args:
        crossing: The first way.
        model: Of the robot, planar.
        horizon: N.
        bodies: What is in the way.

    Raises:
        ShapeError: The robot is not planar.
    """

    def __init__(
        self, crossing: Crossing, model: Model, horizon: int, bodies: Sequence[Body] = ()
    ) -> None:
        """Put the robot at the start, at rest."""
        self.crossing, self._model, self._horizon = crossing, model, horizon
        self._set_off(crossing)
        # a robot with a nose points it where it is about to go
        places = np.stack([crossing.start, crossing.start])
        start = model.state(places, np.stack([np.zeros(2), crossing.direction]))[0]
        super().__init__(start, start, bodies)

    def x_ref(self, time: float, x: FloatArray) -> FloatArray:  # noqa: ARG002
        """States (N+1, nx) from the robot's own place on, so that it waits for one held up."""
        return self._follow.states(x)

    def reset(self, rng: np.random.Generator) -> FloatArray:
        """See `Scene`."""
        self._set_off(self.crossing)
        return super().reset(rng)

    def advance(self, time: float, x: FloatArray) -> FloatArray:
        """See `Scene`; turn round where the goal is reached."""
        if self._now.reached(x[self._model.position]):
            self._set_off(self._now.reversed())
        return super().advance(time, x)

    def _set_off(self, crossing: Crossing) -> None:
        self._now = crossing
        self._follow = PathReference(
            Path.polyline([crossing.start, crossing.goal]),
            speed=crossing.speed,
            model=self._model,
            horizon=self._horizon,
            reach=crossing.length,
            retreat=crossing.length,
        )


def crossing_of(run: Run) -> Crossing:
    """Return the first way of a run.

    Raises:
        InvalidArgumentError: It did not go there and back.
    """
    if not isinstance(run.scene, ThereAndBack):
        raise InvalidArgumentError("run", f"of a {type(run.scene).__name__}, not there and back")
    return run.scene.crossing


def arrivals(run: Run) -> list[int]:
    """Return the control steps at which a goal was reached: the ends of all finished passes."""
    crossing, found = crossing_of(run), []
    for k, position in enumerate(run.positions[1:], 1):
        if crossing.reached(position):
            found.append(k)
            crossing = crossing.reversed()
    return found


def time_alone(run: Run) -> float | None:
    """Seconds that the first pass takes with nobody there; None if its goal is not reached."""
    crossing, problem = crossing_of(run), run.problem
    nobody = ThereAndBack(crossing, problem.model, problem.horizon)
    steps = 100 + int(10 * crossing.length / problem.model.dt)
    reached = arrivals(simulate(MPC(problem, run.settings), nobody, steps=steps))
    return reached[0] * problem.model.dt if reached else None
