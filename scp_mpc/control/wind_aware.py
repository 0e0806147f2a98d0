"""Model predictive control that knows what pushes the robot: an estimator before the controller.

measurement -> estimate of state and disturbance -> MPC with both, and the position's covariance

Wind aside, nothing changes: with a disturbance of zero the plan is that of `MPC`.
"""

from collections.abc import Sequence
from dataclasses import replace
from threading import Lock

import numpy as np
from numpy.typing import ArrayLike

from scp_mpc.arrays import FloatArray, as_array, frozen, require_sampled
from scp_mpc.control.estimator import DisturbanceEstimator, Estimate
from scp_mpc.control.mpc import MPC
from scp_mpc.control.position_covariance import PositionCovariance, Prediction
from scp_mpc.control.regulator import Regulator
from scp_mpc.errors import ConcurrentUseError, InvalidArgumentError
from scp_mpc.models.disturbed import Disturbed
from scp_mpc.models.linear import as_linear
from scp_mpc.obstacles.prediction import ObstaclePrediction
from scp_mpc.problem import Problem
from scp_mpc.scp.plan import Plan
from scp_mpc.settings import Settings


class WindAwareMPC:
    """`MPC` with an estimator before it; problem, reference and plan stay those of the robot.

        robot = Disturbed(problem.model, alpha=0.85, affects=[1, 3])
        mpc = WindAwareMPC(problem, DisturbanceEstimator(robot, std=0.08))
        plan = mpc.step(measured, x_ref, obstacles)

    `plan.X` is (N+1, nx), its row 0 the estimated state, and the estimated disturbance moves the
    rows after it: it does not obey the nominal dynamics. `plan.iterate` keeps the disturbance.

    Args:
        problem: What to solve at each step, as without a disturbance.
        estimator: Of state and disturbance; it belongs to this controller.
        settings: How to solve it.
        prediction: What is added to the covariance of the obstacles' positions: nothing, or how far
            the robot may be from its plan, with the plans to come ("closed loop") or without
            ("open loop"); see `position_covariance.py`.
        terminal_input_weight: If given, the last state is weighed by the cost-to-go of a regulator
            whose inputs cost so many times R, wind included, instead of by `problem.Qf`; see
            `regulator.py`. The feedback of a closed loop is then that regulator's.

    Raises:
        InvalidArgumentError: The estimator's robot is not the problem's; or as in
            `PositionCovariance`.
    """

    def __init__(
        self,
        problem: Problem,
        estimator: DisturbanceEstimator,
        settings: Settings | None = None,
        *,
        prediction: Prediction = "closed loop",
        terminal_input_weight: float | None = None,
    ) -> None:
        """Set up the solver for the robot with its disturbance."""
        if not isinstance(estimator, DisturbanceEstimator):
            raise InvalidArgumentError("estimator", f"{estimator!r} is not a DisturbanceEstimator")
        inner = disturbed(problem, estimator.model)
        if terminal_input_weight is not None:
            weight = Regulator(problem, estimator.model, terminal_input_weight).terminal_weight()
            inner = replace(inner, Qf=weight)
        easy = 1.0 if terminal_input_weight is None else terminal_input_weight
        self._position_covariance = PositionCovariance(problem, estimator, prediction, easy)
        self._mpc = MPC(inner, settings)
        self._problem, self._estimator = problem, estimator
        self._applied: FloatArray | None = None
        self._busy = Lock()
        estimator.reset()

    def __getstate__(self) -> dict[str, object]:
        """All but the lock: a copy goes on from the same plan."""
        return {name: value for name, value in self.__dict__.items() if name != "_busy"}

    def __setstate__(self, state: dict[str, object]) -> None:
        """Make a lock of its own."""
        self.__dict__.update(state, _busy=Lock())

    @property
    def problem(self) -> Problem:
        """The problem as it was given, without the disturbance."""
        return self._problem

    @property
    def settings(self) -> Settings:
        """The solver's settings."""
        return self._mpc.settings

    @property
    def mpc(self) -> MPC:
        """The controller behind, whose state has the disturbance; with its counts and overruns."""
        return self._mpc

    @property
    def estimate(self) -> Estimate | None:
        """What the last plan was made with; None before the first step."""
        return self._estimator.estimate

    def step(
        self,
        y: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction] = (),
        *,
        applied: ArrayLike | None = None,
        time: float | None = None,
        robot_covariance: ArrayLike | None = None,
    ) -> Plan:
        """Return the plan for this control step; apply `plan.u0`.

        Args:
            y: (ny,) measurement now, as the estimator expects it: the state, unless told otherwise.
            x_ref: (N+1, nx) reference, or (nx,) to be held.
            obstacles: As in `MPC.step`.
            applied: (nu,) input that was applied since the last step; the last plan's if None.
            time: As in `MPC.step`.
            robot_covariance: (d, d) or (N+1, d, d) [m^2], added to what the estimator knows.

        Raises:
            InvalidArgumentError: Or one of its subclasses. The controller is then as before.
            ConcurrentUseError: Another thread is using this controller.
        """
        self._enter()
        try:
            return self._step(y, x_ref, obstacles, applied, time, robot_covariance)
        finally:
            self._busy.release()

    def reset(self) -> None:
        """Forget all steps and all that was estimated.

        Raises:
            ConcurrentUseError: Another thread is using this controller.
        """
        self._enter()
        try:
            self._mpc.reset()
            self._estimator.reset()
            self._position_covariance.reset()
            self._applied = None
        finally:
            self._busy.release()

    def _enter(self) -> None:
        # The controller behind has a lock of its own, but the estimator comes before it.
        if not self._busy.acquire(blocking=False):
            raise ConcurrentUseError(
                "this controller is at work in another thread; give each its own"
            )

    def _step(
        self,
        y: ArrayLike,
        x_ref: ArrayLike,
        obstacles: Sequence[ObstaclePrediction],
        applied: ArrayLike | None,
        time: float | None,
        robot_covariance: ArrayLike | None,
    ) -> Plan:
        model, problem = self._estimator.model, self._problem
        N, nx, d = problem.horizon, problem.model.nx, model.dim
        require_sampled("x_ref", x_ref, model.dt)
        x_ref = as_array("x_ref", x_ref, (N + 1, nx), (nx,))
        given = None
        if robot_covariance is not None:
            given = as_array("robot_covariance", robot_covariance, (d, d), (N + 1, d, d))
        before = self._estimator.estimate
        u = self._applied if applied is None else applied
        try:
            now = self._estimator.update(y, u)
            plan = self._mpc.step(
                model.joined(now.state, now.disturbance),
                model.joined(x_ref),
                obstacles,
                time=time,
                robot_covariance=_sum(self._position_covariance.along(now.covariance), given),
            )
        except BaseException:
            self._estimator.restore(before)
            raise
        self._applied = plan.u0
        return replace(plan, X=frozen(np.ascontiguousarray(plan.X[:, :nx])))


def disturbed(problem: Problem, model: Disturbed) -> Problem:
    """The same problem for the robot with its disturbance, which costs nothing.

    Raises:
        InvalidArgumentError: `model` is of another robot.
    """
    plain, other = as_linear("problem.model", problem.model), model.nominal
    same = (
        np.array_equal(plain.A, other.A)
        and np.array_equal(plain.B, other.B)
        and np.array_equal(plain.position, other.position)
        and plain.dt == other.dt
    )
    if not same:
        raise InvalidArgumentError("model", "not the problem's robot with a disturbance")
    Q, Qf = (np.pad(weight, (0, model.nw)) for weight in (problem.Q, problem.Qf))
    free = np.full(model.nw, np.inf)
    x_min, x_max = np.append(problem.x_min, -free), np.append(problem.x_max, free)
    x_soft = np.append(problem.x_soft, np.zeros(model.nw, dtype=np.bool_))
    return replace(problem, model=model, Q=Q, Qf=Qf, x_min=x_min, x_max=x_max, x_soft=x_soft)


def _sum(first: FloatArray | None, second: FloatArray | None) -> FloatArray | None:
    if first is None or second is None:
        return second if first is None else first
    return first + second
