"""The native core as a step engine: plans like those of the loop, unpacked when they are asked for.

What a step brings is written into the core's buffers with no more than a look at its shape; the
core checks every number, and where it refuses one, `Step.read` says which and why.
"""

from collections.abc import Callable, Sequence
from functools import cached_property
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scp_mpc.arrays import FloatArray, SampledArray, as_array, frozen, require_sampled
from scp_mpc.deadline import Timer
from scp_mpc.errors import InvalidArgumentError, TooManyObstaclesError
from scp_mpc.native.core import NativeCore, Outcome
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.obstacles.predictions import ObstaclePredictions, as_predictions
from scp_mpc.problem import Problem
from scp_mpc.qp.program import KKTResiduals
from scp_mpc.scp.iterate import Iterate, Multipliers
from scp_mpc.scp.nodes import Nodes
from scp_mpc.scp.plan import Candidate, Plan, Status, Timing
from scp_mpc.scp.step import Step
from scp_mpc.settings import Settings

_STATUSES = [status for status in Status if status is not Status.STALE]  # as in `scp_status`
_DUALS = {name: name for name in ("dynamics", "margin", "obstacles", "rates")}
_DUALS |= {"inputs": "input_bounds", "slack": "pins", "states": "state_bounds"}
_COUNTS = {"kkt": "kkt", "native": "solved"} | {n: n for n in ("ranked", "cut", "infeasible")}


class Given(NamedTuple):
    """What a step was given, nobody else's: arguments of `Step.read`."""

    problem: Problem
    x0: FloatArray
    x_ref: FloatArray
    obstacles: ObstaclePredictions
    robot_covariance: FloatArray | None
    nodes: Nodes
    u_last: FloatArray | None

    def read(self) -> Step:
        """The step."""
        return Step.read(*self)


class NativePlan(Plan):
    """A plan of the core's; its parts are made when they are asked for."""

    _outcome: Outcome
    _given: Given
    _times: tuple[float, float, float, float]

    @classmethod
    def of(
        cls,
        core: NativeCore,
        given: Given,
        times: tuple[float, float, float, float],
        status: Status | None,
        left_out: int,
    ) -> "NativePlan":
        """The plan of the step that the core has just made."""
        plan, outputs, outcome = object.__new__(cls), core.outputs, core.outcome()
        vars(plan).update(
            _outcome=outcome,
            _given=given,
            _times=times,
            U=outcome.part(outcome.plan, "inputs"),
            status=_STATUSES[outputs.status] if status is None else status,
            cost=outputs.cost,
            iterations=outputs.iterations,
            switched=bool(outputs.switched),
            history=(),
            left_out=left_out,
        )
        if not outputs.contact:
            vars(plan)["contact"] = ()
        return plan

    def __getattr__(self, name: str) -> Any:
        """Make a part, once."""
        if name not in _PARTS or "_outcome" not in vars(self):
            raise AttributeError(name)
        part = vars(self)[name] = _PARTS[name](self._outcome, self._given, self)
        return part

    @cached_property
    def timing(self) -> Timing:
        """See `Plan`."""
        return Timing(*self._times)


def _iterate(outcome: Outcome, given: Given, _: Plan) -> Iterate:
    free = None
    if outcome.obstacle_free is not None:
        free = _named(given.problem, None, *outcome.iterate("obstacle_free"))
    return _named(given.problem, free, *outcome.iterate("plan"))


def _named(
    problem: Problem, free: Iterate | None, has_multipliers: bool, part: dict[str, FloatArray]
) -> Iterate:
    """An iterate of its arrays."""
    duals = None
    if has_multipliers:
        values = {name: part[theirs] for name, theirs in _DUALS.items()}
        if not problem.limits_rates:
            del values["rates"]
        duals = Multipliers(**values)
    primal = part["states"], part["inputs"], part["s"], part["slack"]
    return Iterate(*primal, duals, free).frozen()


def _slack(_: Outcome, given: Given, plan: Plan) -> FloatArray:
    slack = plan.iterate.slack[: len(given.obstacles)]
    return frozen(given.nodes.stages(slack).max(axis=2, initial=0.0))


def _residuals(outcome: Outcome, *_: Any) -> KKTResiduals:
    outputs = outcome.outputs
    three = outputs.stationarity, outputs.feasibility, outputs.complementarity
    return KKTResiduals(*three, outputs.curvature)


def _finished(outcome: Outcome, *_: Any) -> dict[str, int]:
    outputs = outcome.outputs
    counts = {name: int(getattr(outputs, member)) for name, member in _COUNTS.items()}
    return {name: count for name, count in counts.items() if count}


def _candidates(outcome: Outcome, given: Given, _: Plan) -> tuple[Candidate, ...]:
    outputs, d = outcome.outputs, given.problem.model.dim
    return tuple(
        Candidate(c.obstacle, frozen(np.array(c.side[:d])), c.time, c.merit)
        for c in outputs.candidate[: outputs.candidates]
    )


def _step(_: Outcome, given: Given, plan: Plan) -> Step:
    """The step, its radii as the plan's own motion between the nodes asks for."""
    step, nodes = given.read(), given.nodes
    if step.count and nodes.instants > 1:
        step = step.widened(nodes.radii(step.radii, step.drift, nodes.motion(plan.X, plan.U)))
    return step


_PARTS: dict[str, Callable[[Outcome, Given, Plan], Any]] = {
    "iterate": _iterate,
    "X": lambda outcome, _, __: outcome.part(outcome.plan, "states"),
    "s": lambda _, given, plan: plan.iterate.s[: len(given.obstacles)],
    "slack": _slack,
    "x_slack": lambda _, given, plan: frozen(given.problem.excess(plan.X)),
    "kkt": _residuals,
    "qps": _finished,
    "candidates": _candidates,
    "step": _step,
}


class NativeEngine:
    """Makes the plans of control steps with the native core.

    Args:
        problem: What to solve.
        settings: How to solve it.
        nodes: Where plans are constrained.
        deadline: Of a step [s]; None for none.
        timer: Tells the time [s] to deadlines; None for the machine's clock.

    Raises:
        MissingCoreError: There is no native core.
        InvalidArgumentError: `Settings(history=True)`: the core keeps none.
    """

    def __init__(
        self,
        problem: Problem,
        settings: Settings,
        nodes: Nodes,
        deadline: float | None,
        timer: Timer | None,
    ) -> None:
        """Lay the core out."""
        if settings.history:
            raise InvalidArgumentError("history", "is not kept by solver = 'native'")
        self._problem, self._nodes = problem, nodes
        self._laid_out = problem, settings, deadline, timer
        self.core = NativeCore(*self._laid_out)

    def solve(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        nominal: Iterate | None = None,
        multi_start: bool = True,
        robot_covariance: ArrayLike | None = None,
        u_last: ArrayLike | None = None,
        brake_first: bool = False,
    ) -> Plan:
        """`SCP.solve_from`."""
        began = perf_counter()
        given = self._write(x0, x_ref, obstacles, robot_covariance, u_last)
        guesses = 0
        if nominal is not None:
            guesses = self._guess(nominal.unwrapped(self._problem.model, given.x0))
        wrote = perf_counter()
        return self._plan(given, self.core.solve(guesses, multi_start, brake_first), began, wrote)

    def step(
        self,
        began: float,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        robot_covariance: ArrayLike | None = None,
        u_last: ArrayLike | None = None,
        left_out: int = 0,
    ) -> Plan:
        """A step of the controller, with what the core remembers of those before.

        Args:
            began: When, by the machine's clock [s].
            x0: As in `MPC.step`, like the others.
            x_ref: Likewise.
            obstacles: As many as there are slots for at most.
            robot_covariance: As in `MPC.step`.
            u_last: Likewise.
            left_out: How many there are besides.
        """
        given = self._write(x0, x_ref, obstacles, robot_covariance, u_last)
        wrote = perf_counter()
        return self._plan(given, self.core.step(), began, wrote, left_out=left_out)

    def brake(
        self,
        began: float,
        x0: ArrayLike,
        x_ref: ArrayLike,
        u_last: ArrayLike | None = None,
        left_out: int = 0,
    ) -> Plan:
        """`step` without predictions, for they are too old."""
        given = self._write(x0, x_ref, (), None, u_last)
        wrote = perf_counter()
        return self._plan(given, self.core.brake(), began, wrote, Status.STALE, left_out)

    def _plan(
        self,
        given: Given,
        wrong: str | None,
        began: float,
        wrote: float,
        status: Status | None = None,
        left_out: int = 0,
    ) -> Plan:
        """What the core came to, or the error that it stands for."""
        solved = perf_counter()
        if wrong is not None:
            given.read()
            raise InvalidArgumentError(wrong, "is refused by the native core")
        times = 0.0, wrote - began, solved - wrote, solved - began
        return NativePlan.of(self.core, given, times, status, left_out)

    def _write(
        self,
        x0: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        robot_covariance: ArrayLike | None,
        u_last: ArrayLike | None,
    ) -> Given:
        """Write a step into the core's buffers."""
        model = self._problem.model
        known = self._write_obstacles(obstacles)  # first: where there is no room, the core changes
        inputs, views = self.core.inputs, self.core.views
        _write("x0", x0, views)
        if isinstance(x_ref, SampledArray):
            require_sampled("x_ref", x_ref, model.dt)
        _write("x_ref", x_ref, views, views["x0"].shape)
        inputs.has_u_last = u_last is not None
        last = uncertain = None
        if u_last is not None:
            _write("u_last", u_last, views)
            last = views["u_last"].copy()
        inputs.has_robot_covariance = robot_covariance is not None
        if robot_covariance is not None:
            _write("robot_covariance", robot_covariance, views, (model.dim, model.dim))
            uncertain = views["robot_covariance"].copy()
        x = views["x0"].copy(), views["x_ref"].copy()
        return Given(self._problem, *x, known, uncertain, self._nodes, last)

    def _write_obstacles(self, obstacles: Sequence[ObstaclePrediction]) -> ObstaclePredictions:
        problem, core = self._problem, self.core
        model, M, known = problem.model, problem.max_obstacles, as_predictions(obstacles)
        J = len(known)
        if J > M:
            raise TooManyObstaclesError("obstacles", f"{J} exceed max_obstacles = {M}")
        stacked = ObstaclePredictions.of(known, problem.horizon, model.dim, model.dt)
        if stacked.shapes is not None and not core.has_room(stacked.shapes):
            core = NativeCore(*self._laid_out, room=stacked.shapes)
            core.memory, self.core = self.core.memory, core
        views = core.views
        views["means"][:J] = stacked.means
        views["covariances"][:J] = stacked.covariances
        views["radii"][:J] = stacked.radii
        core.set_shapes(stacked.shapes)
        core.inputs.count = J
        return stacked

    def _guess(self, nominal: Iterate) -> int:
        """Write where to start; return how many plans that are."""
        known = [nominal] if nominal.obstacle_free is None else [nominal, nominal.obstacle_free]
        for k, plan in enumerate(known):
            duals, parts = plan.multipliers, self.core.guess(k, plan.multipliers is not None)
            for name in ("states", "inputs", "s", "slack"):
                parts[name][:] = getattr(plan, name)
            if duals is not None:
                for name, theirs in _DUALS.items():
                    values = getattr(duals, name)
                    parts[theirs][:] = values if values.size else 0.0
        return len(known)


def _write(
    name: str, value: ArrayLike, views: dict[str, NDArray[Any]], *shapes: tuple[int, ...]
) -> None:
    """Write an argument into its view; only its shape and kind are checked here."""
    view = views[name]
    if type(value) is not np.ndarray or value.dtype != np.float64 or value.shape != view.shape:
        value = as_array(name, value, view.shape, *shapes)
    view[...] = value
