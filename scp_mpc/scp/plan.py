"""What the solver returns: a plan, how it ended, and how far it can be trusted."""

from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.qp.program import KKTResiduals
from scp_mpc.scp.certificate import CURVATURE_TOLERANCE, Nominal
from scp_mpc.scp.history import Record
from scp_mpc.scp.iterate import Iterate, Multipliers
from scp_mpc.scp.step import Step


class Status(Enum):
    """How a plan ended, with the sentence that a log should show."""

    CONVERGED = "The KKT conditions of the original problem hold to the tolerance."
    FEASIBLE = "The plan meets every constraint, but the search ended before it was optimal."
    PREVIOUS = (
        "Nothing better in time, or no way to rest after it: a known plan meets every constraint."
    )
    BRAKING = "Nothing better in time: the robot brakes and meets every constraint while it does."
    SOFTENED = "No plan that meets every constraint was found; this one violates them by its slack."
    STOPPING = "No plan that meets every constraint: this one violates some as slowly as braking."
    VIOLATING = "The search ended while the plan still violates a constraint; not handed out."
    FALLBACK = "No plan is known that meets every constraint, nor one better than braking: brake."
    STALE = "The predictions are too old to plan with: brake, whatever is in the way."

    @property
    def ok(self) -> bool:
        """Whether every constraint of the problem holds, so that the plan is safe to follow."""
        return self in _SAFE

    @property
    def certified(self) -> bool:
        """Whether the KKT conditions hold, with slack or without."""
        return self in (Status.CONVERGED, Status.SOFTENED)


_SAFE = (Status.CONVERGED, Status.FEASIBLE, Status.PREVIOUS, Status.BRAKING)


@dataclass(frozen=True)
class Timing:
    """Seconds of one control step: geometry, writing values, QP solvers, everything."""

    linearise: float
    update: float
    solve: float
    total: float


@dataclass(frozen=True, eq=False)
class Candidate:
    """Another plan that was tried beside the one from the nominal plan.

    Attributes:
        obstacle: Index of the obstacle that it was to pass on another side.
        side: (d,) direction from the obstacle to where it passes.
        time: Stages by which it was to pass earlier than the plan that ignores the obstacles.
        merit: Lower bound of the first program about it, cost and penalty on slack; infinite if
            that program has no solution without slack, or none that can win.
    """

    obstacle: int
    side: FloatArray
    time: float
    merit: float


@dataclass(frozen=True, eq=False)
class PlanRisk:
    """Upper bounds of the probability that the robot touches an obstacle if it follows the plan.

    They hold for the Gaussians that were predicted, with Boole's inequality over points, stages
    and obstacles, whatever the correlation between them, and for a robot that is clear now. With
    `nodes_per_interval=1` they are about the samples only.

    Attributes:
        stages: (J, N) of touching obstacle j between samples i - 1 and i, which takes one of the
            points there, the one at i - 1 included, too near.
        obstacles: (J,) of touching obstacle j at all.
        joint: Of touching any.
    """

    stages: FloatArray
    obstacles: FloatArray
    joint: float


@dataclass(frozen=True, eq=False)
class Plan:
    """The plan of one control step. M counts the obstacles that were passed.

    Attributes:
        X: (N+1, nx) states, row 0 the given one.
        U: (N, nu) inputs.
        s: (M,) sizes of the obstacles' ellipsoids; where a risk is promised, see `risk` instead.
        slack: (M, N) violation of each obstacle's constraint at stages 1 .. N, or between a stage
            and the one before [m].
        x_slack: (N, nx) by how much the states at stages 1 .. N are outside their bounds.
        cost: Value of the objective, slack not included.
        status: How it ended.
        kkt: Residuals of the original problem's KKT conditions at this plan.
        iterations: Steps of the descent that led to this plan.
        qps: Quadratic programs in this control step by who finished them: the solver that was
            asked, "osqp" by default, whose active set was exact after one repair at most;
            "repaired" where it took more; "piqp", the rescue; "native", the core in C; "kkt", a few
            linear systems instead of a program: a linear robot's plan that ignores the obstacles.
            And those that nobody finished: "ranked", an alternative whose optimum was bounded from
            below, by the core in C found; "cut", one that cannot win; "infeasible", one that was
            proved to have no solution.
        candidates: Alternative plans that were tried; `switched` if one of them won.
        timing: Seconds spent.
        iterate: The point with its multipliers, padded to all obstacle slots, at all nodes.
        history: With `Settings(history=True)`, what happened in each SCP iteration that led here.
        step: What it was made from.
        left_out: Obstacles that nothing is promised about: there were more than slots for them.
    """

    X: FloatArray
    U: FloatArray
    s: FloatArray
    slack: FloatArray
    x_slack: FloatArray
    cost: float
    status: Status
    kkt: KKTResiduals
    iterations: int
    qps: dict[str, int]
    candidates: tuple[Candidate, ...]
    switched: bool
    timing: Timing
    iterate: Iterate
    history: tuple[Record, ...]
    step: Step
    left_out: int = 0

    @property
    def u0(self) -> FloatArray:
        """The input (nu,) to apply now."""
        return self.U[0]

    @property
    def ok(self) -> bool:
        """Whether every constraint holds, so that the plan is safe to follow: not in a contact."""
        return self.status.ok and not self.contact

    @cached_property
    def contact(self) -> tuple[int, ...]:
        """Obstacles that the robot touches now, if they are where they are expected to be.

        No plan can undo that: stages 1 .. N are constrained. How it is left is up to the status.
        """
        return self.step.contact

    @cached_property
    def risk(self) -> PlanRisk:
        """Bounds of the collision probability, computed when they are asked for."""
        step = self.step
        path = step.nodes.positions(self.iterate.states, self.iterate.inputs)
        nodes = step.nodes.stages(step.risks(path))
        whole, stages = nodes.sum(axis=(1, 2)), nodes.sum(axis=2)
        if step.problem.nodes_per_interval > 1:  # an interval begins at the node before it
            stages[:, 1:] += nodes[:, :-1, -step.nodes.discs :].sum(axis=2)
        joint = min(1.0, float(whole.sum()))
        return PlanRisk(np.minimum(stages, 1.0), np.minimum(whole, 1.0), joint)

    @property
    def multipliers(self) -> Multipliers | None:
        """Multipliers of the constraints, padded to all obstacle slots; None after a fallback."""
        return self.iterate.multipliers


@dataclass(frozen=True, eq=False)
class Result:
    """Where one run of the loop ended; or a plan that needs no program.

    Attributes:
        iterate: The primal-dual point.
        cost: Objective, slack not included.
        merit: Cost and the penalty on the slack.
        residuals: KKT residuals of the original problem.
        status: How it ended.
        iterations: Convex subproblems solved.
        nominal: The same point as the loop knows it; None if it comes from elsewhere.
        history: What happened in each of them, where that was asked for.
    """

    iterate: Iterate
    cost: float
    merit: float
    residuals: KKTResiduals
    status: Status
    iterations: int
    nominal: Nominal | None = None
    history: tuple[Record, ...] = ()

    def beats(self, other: "Result", lead: float) -> bool:
        """Whether this plan is safe and the other is not, or its merit is better by `lead`."""
        if self.status.ok != other.status.ok:
            return self.status.ok
        if not self.status.ok and self.status.certified != other.status.certified:
            return self.status.certified
        return self.merit < other.merit - lead


def judge(residuals: KKTResiduals, slack: float, tolerance: float) -> Status:
    """Return the status of a plan with the given residuals and largest slack."""
    outside = not (residuals.feasibility <= tolerance and slack <= tolerance)  # or NaN
    certified = residuals.worst <= tolerance and slack == slack
    if certified and residuals.curvature >= -CURVATURE_TOLERANCE:  # and not NaN, unknown
        return Status.SOFTENED if outside else Status.CONVERGED
    return Status.VIOLATING if outside else Status.FEASIBLE
