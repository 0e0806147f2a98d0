"""The frozen problem: what is minimised, over which horizon, within which limits.

    minimise   sum_{i=1..N} |x_i - xref_i|^2_Q + sum_{i=0..N-1} |u_i|^2_R + sum_j w (s_j - s_ref)^2
               + v sum_{i=1..N} |e_i|_1
    over       x_1..x_N, u_0..u_{N-1}, s_j, e_1..e_N
    subject to x_{i+1} = f(x_i, u_i),  x_0 given
               p_i outside the no-go set of obstacle j at stage i, sized by s_j
               (likewise at the collision nodes within the interval before i)
               s_min <= s_j <= s_max,  u_min <= u_i <= u_max
               du_min <= u_i - u_{i-1} <= du_max  (u_{-1} the input last applied, if it is known)
               x_min - e_i <= x_i <= x_max + e_i,  |v_i| <= speed_max

There is no factor 1/2 anywhere, and `Qf` replaces Q at i = N where it is given. Inputs are weighed
from the model's `equilibrium_input`, which is zero but for robots that hover. Bounds of states,
of speed and of rates are there where they are given, and hard. For there always to be such inputs,
holding an input must be allowed: du_min <= 0 <= du_max. A state that is outside its bounds now, or
that full braking carries outside, is bounded by what full braking reaches. Only the bounds of
states that the user calls soft yield, at an exact L1 penalty and before the obstacles do.

Bounds of states act on rows E x: the bounded states, and normals of a polytope inscribed into the
ball of velocities that `speed_max` allows (16 faces in the plane, 38 in space: at least 98 % and
92 % of it in any direction).

Notation:
    e (N, nx)   excess of the states over their bounds: max(0, x - x_max, x_min - x)
    v           `state_slack_weight`
    E (nb, nx)  rows of bounded states, and of speed
"""

from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise, product
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import HalfspaceIntersection

from scp_mpc.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    as_array,
    as_bound,
    as_count,
    as_number,
    as_weight,
    frozen,
)
from scp_mpc.errors import BoundsError, InvalidArgumentError, ShapeError
from scp_mpc.geometry.inflation import AxesInflation, ExactInflation, Inflation
from scp_mpc.geometry.margin import (
    Containment,
    JointRisk,
    Margin,
    MarginSpec,
    StageRisk,
    size_at,
)
from scp_mpc.models.linear import LinearModel
from scp_mpc.models.model import Model
from scp_mpc.models.riccati import terminal_weight
from scp_mpc.settings import require_positive

ROUNDING = 1e-9  # [unit of the input] by which a rate may exceed its bounds

_INFLATIONS: dict[str, type[Inflation]] = {"exact": ExactInflation, "axes": AxesInflation}


@dataclass(frozen=True, eq=False)
class Problem:
    """Everything about the optimal control problem that does not change from step to step.

    Args:
        model: Dynamics of the robot.
        horizon: N, the number of intervals; there are N + 1 states.
        Q: State weight (nx,) or (nx, nx), positive semi-definite.
        R: Input weight (nu,) or (nu, nu), positive semi-definite; definite for nonlinear models.
        u_min: Lower input bounds, a number or (nu,).
        u_max: Upper input bounds, a number or (nu,).
        Qf: Weight of the last state; Q if None. "lqr": the solution of the Riccati equation, which
            is the cost of all that follows where no constraint is active beyond the horizon.
        robot_radius: Radius of the robot [m].
        margin: The obstacles' sizes s_j: a `Margin` that may give way, or a promise that does not,
            `StageRisk`, `JointRisk` or `Containment`. None: 95 % containment, in the plane as the
            report's `Margin`.
        inflation: "exact" for ellipsoid (+) ball, "axes" for the report's lengthened axes.
        growth_time: Seconds ahead up to which the covariances of obstacles grow for the plan; None
            for the whole horizon. What is farther ahead is planned again, with later measurements,
            before it is executed: with this the robot does not wander about ellipses that will
            have shrunk by then. It should be no shorter than what braking takes. Not for promises
            of a risk, which are about all of the plan.
        max_obstacles: Number of obstacle slots M in the program.
        nodes_per_interval: K, collision nodes in each interval, the sample included. Above 1 the
            radii grow, interval by interval, so that nothing passes between two nodes. 1: the
            samples alone, as in the report.
        slack_weight: Cost per metre of slack and stage where the constraints cannot all be met.
            The penalty is exact as long as it exceeds the obstacles' multipliers.
        x_min: Lower bounds of the states at stages 1 .. N, a number or (nx,); entries may be minus
            infinity. None: no lower bounds.
        x_max: Upper bounds likewise; entries may be infinity.
        x_soft: Which bounds of states may yield, at `state_slack_weight`, before obstacles do: a
            truth value or (nx,) of them. By default none.
        speed_max: Largest Euclidean speed at stages 1 .. N [m/s], for models whose state holds a
            velocity; None for no limit.
        du_min: Lower bounds of the change u_i - u_{i-1} of the input from one interval to the next
            [unit of the input per interval], a number or (nu,), never positive; entries may be
            minus infinity. None: no lower bounds.
        du_max: Upper bounds likewise, never negative; entries may be infinity.
        state_slack_weight: Cost per unit and stage by which a soft state is outside its bounds.
            The penalty is exact as long as it exceeds the bounds' multipliers.
        discs: (n,) centres of the discs of `robot_radius` that cover a longer robot, from its
            position along its heading [m]; for models that have one.

    Raises:
        InvalidArgumentError: Or one of its subclasses, with the argument and the number.
    """

    model: Model
    horizon: int
    Q: FloatArray
    R: FloatArray
    u_min: FloatArray
    u_max: FloatArray
    Qf: FloatArray
    robot_radius: float
    margin: MarginSpec
    inflation: Literal["exact", "axes"]
    growth_time: float | None
    max_obstacles: int
    nodes_per_interval: int
    slack_weight: float
    x_min: FloatArray
    x_max: FloatArray
    x_soft: BoolArray
    speed_max: float | None
    du_min: FloatArray
    du_max: FloatArray
    state_slack_weight: float
    discs: FloatArray

    def __init__(
        self,
        model: Model,
        *,
        horizon: int,
        Q: ArrayLike,
        R: ArrayLike,
        u_min: ArrayLike,
        u_max: ArrayLike,
        Qf: ArrayLike | Literal["lqr"] | None = None,
        robot_radius: float = 0.0,
        margin: MarginSpec | None = None,
        inflation: Literal["exact", "axes"] = "exact",
        growth_time: float | None = None,
        max_obstacles: int = 1,
        nodes_per_interval: int = 4,
        slack_weight: float = 1e3,
        x_min: ArrayLike | None = None,
        x_max: ArrayLike | None = None,
        x_soft: ArrayLike = False,
        speed_max: float | None = None,
        du_min: ArrayLike | None = None,
        du_max: ArrayLike | None = None,
        state_slack_weight: float = 100.0,
        discs: ArrayLike = (0.0,),
    ) -> None:
        """Copy, check and freeze."""
        if not isinstance(model, Model):
            raise InvalidArgumentError("model", f"{model!r} is not a Model")
        horizon = as_count("horizon", horizon)
        lower, upper = _bounds(u_min, u_max, model.nu)
        lowest, highest = _state_bounds(x_min, x_max, model.nx)
        if speed_max is not None:
            require_positive("speed_max", speed_max)
            if model.velocity is None:
                raise InvalidArgumentError("speed_max", f"{type(model).__name__} has no velocity")
        fall, rise = _rate_bounds(du_min, du_max, model.nu)
        radius = as_number("robot_radius", robot_radius)
        if radius < 0:
            raise BoundsError("robot_radius", f"{radius} m is negative")
        if not isinstance(inflation, str) or inflation not in _INFLATIONS:
            raise InvalidArgumentError(
                "inflation", f"{inflation!r} is none of {', '.join(_INFLATIONS)}"
            )
        max_obstacles = as_count("max_obstacles", max_obstacles, least=0)
        require_positive("slack_weight", slack_weight)
        require_positive("state_slack_weight", state_slack_weight)
        nodes_per_interval = as_count("nodes_per_interval", nodes_per_interval)
        if margin is None:
            margin = Margin() if model.dim == 2 else Containment(0.95)
        if isinstance(margin, float | int):
            meant = f"Margin(reference={margin}, lower={margin})"
            raise InvalidArgumentError("margin", f"{margin} is a number: {meant} has that size")
        if not isinstance(margin, MarginSpec):
            raise InvalidArgumentError("margin", f"{margin!r} is no Margin, risk or Containment")
        if growth_time is not None:
            require_positive("growth_time", growth_time)
            if isinstance(margin, StageRisk | JointRisk):
                raise InvalidArgumentError(
                    "growth_time", f"{growth_time} s would break the promise of {margin}"
                )
        weights = as_weight("Q", Q, model.nx), as_weight("R", R, model.nu)
        least = float(np.linalg.eigvalsh(weights[1])[0])
        if least <= 0 and not isinstance(model, LinearModel):
            raise InvalidArgumentError(
                "R", f"is singular (smallest eigenvalue {least:g}), which needs a linear model"
            )
        if isinstance(Qf, str) and Qf == "lqr":
            Qf = terminal_weight(model, *weights)
        values = {
            "model": model,
            "horizon": horizon,
            "Q": weights[0],
            "R": weights[1],
            "Qf": as_weight("Qf", Q if Qf is None else Qf, model.nx),
            "u_min": lower,
            "u_max": upper,
            "robot_radius": radius,
            "margin": margin,
            "inflation": inflation,
            "growth_time": None if growth_time is None else float(growth_time),
            "max_obstacles": max_obstacles,
            "nodes_per_interval": nodes_per_interval,
            "slack_weight": float(slack_weight),
            "x_min": lowest,
            "x_max": highest,
            "x_soft": _soft(x_soft, model.nx),
            "speed_max": None if speed_max is None else float(speed_max),
            "du_min": fall,
            "du_max": rise,
            "state_slack_weight": float(state_slack_weight),
            "discs": _discs(discs, model),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def __setstate__(self, state: dict[str, object]) -> None:
        """Freeze again: neither pickle nor deepcopy keeps arrays read-only."""
        self.__dict__.update(state)
        for value in state.values():
            if isinstance(value, np.ndarray):
                frozen(value)

    @cached_property
    def no_go(self) -> Inflation:
        """The inflation's geometry."""
        return _INFLATIONS[self.inflation](self.size.reference)

    @cached_property
    def size(self) -> Margin:
        """The margin in standard deviations; that of a promise is fixed, for all slots in use."""
        if isinstance(self.margin, Margin):
            return self.margin
        return Margin.fixed(self.size_for(self.max_obstacles, 1))

    def size_for(self, obstacles: int, count: int) -> float:
        """The uniform size s for so many obstacles, with `count` points in each interval."""
        gaps = len(self.discs) if self.nodes_per_interval > 1 else 0
        return size_at(self.margin, self.model.dim, obstacles, self.horizon, count, gaps)

    @cached_property
    def bounded_states(self) -> IntArray:
        """Indices (nb,) of the states with a finite bound."""
        return np.flatnonzero(np.isfinite(self.x_min) | np.isfinite(self.x_max))

    @cached_property
    def state_rows(self) -> FloatArray:
        """E (nb, nx): rows of the bounded states, then those of speed."""
        rows = np.eye(self.model.nx)[self.bounded_states]
        if self.speed_max is None or self.model.velocity is None:
            return frozen(rows)
        faces = np.zeros((len(_faces(len(self.model.velocity))), self.model.nx))
        faces[:, self.model.velocity] = _faces(len(self.model.velocity))
        return frozen(np.concatenate([rows, faces]))

    @cached_property
    def row_bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds (nb,) of E x."""
        lower, upper = self.x_min[self.bounded_states], self.x_max[self.bounded_states]
        fast = np.full(len(self.state_rows) - len(lower), self.speed_max or 0.0)
        return np.concatenate([lower, -fast]), np.concatenate([upper, fast])

    @cached_property
    def soft_rows(self) -> BoolArray:
        """(nb,) which of E's rows may yield."""
        soft = np.zeros(len(self.state_rows), dtype=np.bool_)
        soft[: len(self.bounded_states)] = self.x_soft[self.bounded_states]
        return soft

    @cached_property
    def limits_states(self) -> bool:
        """Whether any state or the speed has a finite bound."""
        return len(self.state_rows) > 0

    @cached_property
    def limits_rates(self) -> bool:
        """Whether any input's change per interval has a finite bound."""
        return bool(np.isfinite(self.du_min).any() or np.isfinite(self.du_max).any())

    def reach(self, u_last: FloatArray | None) -> tuple[FloatArray, FloatArray]:
        """Return what rates allow of the first input after u_last (nu,): (nu,) lower and upper.

        Infinite where rates are not bounded, and where u_last is None, unknown. Where an input was
        so far outside its bounds that no rate leads back, its rate gives way: the bound itself is
        the one value allowed.
        """
        if u_last is None:
            return np.full(self.model.nu, -np.inf), np.full(self.model.nu, np.inf)
        lower = np.minimum(u_last + self.du_min, self.u_max)
        return lower, np.maximum(u_last + self.du_max, self.u_min)

    def limited(self, inputs: FloatArray, u_last: FloatArray | None = None) -> FloatArray:
        """Return inputs (N, nu), the first after u_last (nu,), moved into all their bounds.

        One after the other, each as little as the one before allows; inputs whose later changes
        exceed their bounds by rounding alone are kept.
        """
        u = np.minimum(np.maximum(inputs, self.u_min), self.u_max)
        if not self.limits_rates:
            return u
        reached = np.clip(u[0], *self.reach(u_last))
        u[0] = np.clip(reached, self.u_min, self.u_max)
        change = np.diff(u, axis=0)
        if (change > self.du_max + ROUNDING).any() or (change < self.du_min - ROUNDING).any():
            for before, now in pairwise(u):
                reached = np.clip(now, before + self.du_min, before + self.du_max)
                now[:] = np.clip(reached, self.u_min, self.u_max)
        return u

    def excess(self, states: FloatArray) -> FloatArray:
        """Return by how much states (N+1, nx) are outside their bounds at stages 1 .. N (N, nx)."""
        x = states[1:]
        if not self.limits_states:
            return np.zeros_like(x)
        return np.maximum(0.0, np.maximum(x - self.x_max, self.x_min - x))

    def row_excess(self, states: FloatArray) -> FloatArray:
        """Return by how much E x is outside its bounds at stages 1 .. N (N, nb), speed included."""
        (lower, upper), rows = self.row_bounds, states[1:] @ self.state_rows.T
        return np.maximum(0.0, np.maximum(lower - rows, rows - upper))

    def penalty(self, slack: FloatArray, states: FloatArray) -> float:
        """Return the price of the obstacles' slack [m] and of the excess of states (N+1, nx)."""
        price = self.slack_weight * float(slack.sum())
        if self.x_soft.any():
            price += self.state_slack_weight * float(self.excess(states)[:, self.x_soft].sum())
        return price

    def cost(
        self, states: FloatArray, inputs: FloatArray, s: FloatArray, x_ref: FloatArray
    ) -> float:
        """Return the cost of states (N+1, nx), inputs (N, nu) and sizes s (M,), without slack."""
        error = states[1:] - x_ref[1:]
        track = np.vdot(error[:-1] @ self.Q, error[:-1]) + error[-1] @ self.Qf @ error[-1]
        push = inputs - self.model.equilibrium_input
        effort = np.vdot(push @ self.R, push)
        deviation = s - self.size.reference
        return float(track + effort + self.size.weight * (deviation @ deviation))


def _bounds(u_min: ArrayLike, u_max: ArrayLike, nu: int) -> tuple[FloatArray, FloatArray]:
    lower, upper = (
        frozen(np.array(np.broadcast_to(as_array(name, value, (), (nu,)), nu)))
        for name, value in (("u_min", u_min), ("u_max", u_max))
    )
    if (lower > upper).any():
        at = int(np.argmax(lower > upper))
        raise BoundsError("u_min", f"{lower[at]} exceeds u_max = {upper[at]} for input {at}")
    return lower, upper


def _discs(discs: ArrayLike, model: Model) -> FloatArray:
    offsets = as_array("discs", discs, (-1,))
    if not len(offsets):
        raise ShapeError("discs", "no disc covers the robot")
    if model.heading is None and (len(offsets) > 1 or offsets[0] != 0):
        raise InvalidArgumentError("discs", f"{type(model).__name__} has no heading to set them by")
    return frozen(offsets)


def _state_bounds(
    x_min: ArrayLike | None, x_max: ArrayLike | None, nx: int
) -> tuple[FloatArray, FloatArray]:
    lower, upper = as_bound("x_min", x_min, nx, -np.inf), as_bound("x_max", x_max, nx, np.inf)
    if (lower > upper).any():
        at = int(np.argmax(lower > upper))
        raise BoundsError("x_min", f"{lower[at]} exceeds x_max = {upper[at]} for state {at}")
    return lower, upper


def _soft(x_soft: ArrayLike, nx: int) -> BoolArray:
    soft = np.array(x_soft)
    if soft.dtype != np.bool_ or soft.shape not in ((), (nx,)):
        raise InvalidArgumentError("x_soft", f"{x_soft!r} is no truth value and no {nx} of them")
    soft = np.array(np.broadcast_to(soft, nx))
    soft.setflags(write=False)
    return soft


@cache
def _faces(dim: int) -> FloatArray:
    """Normals a (m, dim) of a polytope |a'v| <= 1 that is inscribed into the unit ball.

    In the plane a corner points along each axis, where nothing is lost.
    """
    if dim == 1:
        return np.ones((1, 1))
    if dim == 2:
        angles = (np.arange(8) + 0.5) * np.pi / 8
        normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    else:
        kinds = (0, 0, 1), (1, 1, 1), (0, 1, 2)  # axes, diagonals, and between them
        ways = [n for n in product(range(-2, 3), repeat=3) if tuple(sorted(map(abs, n))) in kinds]
        normals = np.array([n for n in ways if n > (0, 0, 0)], dtype=np.float64)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    both = np.concatenate([normals, -normals])
    cut = np.concatenate([both, -np.ones((len(both), 1))], axis=1)
    corners = HalfspaceIntersection(cut, np.zeros(dim)).intersections
    return normals * float(np.linalg.norm(corners, axis=1).max())


def _rate_bounds(
    du_min: ArrayLike | None, du_max: ArrayLike | None, nu: int
) -> tuple[FloatArray, FloatArray]:
    lower, upper = as_bound("du_min", du_min, nu, -np.inf), as_bound("du_max", du_max, nu, np.inf)
    for name, change, forbidden in (("du_min", lower, lower > 0), ("du_max", upper, upper < 0)):
        if forbidden.any():
            at = int(np.argmax(forbidden))
            raise BoundsError(name, f"{change[at]} for input {at} does not allow holding it (0)")
    return lower, upper
