"""The fourteen faults that break controllers of this kind, 1 to 7: data, geometry, time, limits.

One check or small group for each; 8 to 14 are in `test_faults_over_time.py`. What a plan claims is
judged by `judge.py`, which shares no code with the package. Any single step is in
`test_steps_property.py`, any sequence of steps (check 12) in `test_state_machine.py`.
"""

import time
from dataclasses import replace

import numpy as np
import pytest
from driving import N, good, same
from holding import INF, NAN, ON_TOP, REF, WALL, hold, solve_and_hold
from instances import obstacle, problem, rotated, straight_reference

from scp_mpc import (
    MPC,
    SCP,
    CovarianceError,
    DoubleIntegrator,
    InvalidArgumentError,
    NotFiniteError,
    ObstaclePrediction,
    Settings,
    ShapeError,
    StaleDataError,
    StalenessPolicy,
    Status,
)
from scp_mpc.qp.backend import ProgramSolver
from scp_mpc.qp.osqp import OSQP
from scp_mpc.qp.others import PIQP

SOLVERS = pytest.mark.parametrize("solver", ["osqp", "piqp"])

# 1. Covariances


@pytest.mark.parametrize(
    ("covariance", "error"),
    [
        ([[1.0, 0.5], [0.4, 1.0]], CovarianceError),
        ([[0.08, 0.05], [0.05, 0.03]], CovarianceError),
        (-np.eye(2), CovarianceError),
        ([[NAN, 0], [0, 1]], NotFiniteError),
        ([[INF, 0], [0, 1]], NotFiniteError),
        (np.eye(3), ShapeError),
        (np.ones(2), ShapeError),
        (0.5, ShapeError),
    ],
)
def test_01_covariances_that_are_none_are_refused(covariance, error):
    with pytest.raises(error, match="covariances"):
        ObstaclePrediction(np.zeros((N + 1, 2)), covariance, 0.2)


@pytest.mark.parametrize("inflation", ["exact", "axes"])
@pytest.mark.parametrize(
    "deviations", [(0, 0), (1, 0), (1e-9, 1), (1e6, 1e6), (1e6, 0), (1e6, 1e-6), (1e-8, 1e-8)]
)
def test_01_covariances_at_the_edge_are_planned_with(deviations, inflation):
    case = problem(N, inflation, s_min=1.0)
    for angle in (0.0, 1.0):
        thing = obstacle(N, (1.5, 0.1), covariance=rotated(deviations, angle))
        solve_and_hold(case, REF[0], REF, [thing])


@pytest.mark.parametrize("count", [16, pytest.param(40, marks=pytest.mark.slow)])
def test_01_a_huge_covariance_does_not_spoil_a_thin_one(count):
    """The thin one is a line; what counts as zero must not be measured by its neighbour."""
    case = problem(4)
    ref = straight_reference(4)
    for seed in range(count):
        rng = np.random.default_rng(seed)
        line = rotated((1.0, 0.0), rng.uniform(0.0, np.pi))
        covariances = np.tile((line + line.T) / 2, (5, 1, 1))
        covariances[3] = 10 ** rng.uniform(8, 12) * np.eye(2)
        mean = ref[2, [0, 2]] + 0.3 * rng.normal(size=2)
        thing = ObstaclePrediction(np.tile(mean, (5, 1)), covariances, 0.2)
        solve_and_hold(case, ref[0], ref, [thing])


@pytest.mark.parametrize("count", [16, pytest.param(48, marks=pytest.mark.slow)])
def test_01_lines_in_space_may_go_through_the_robot(count):
    case = problem(
        4, model=DoubleIntegrator(0.2, 3), Q=[0.2, 0.05] * 3, R=[0.001] * 3, max_obstacles=1
    )
    for seed in range(count):
        along = np.random.default_rng(seed).normal(size=3)
        thing = ObstaclePrediction(np.zeros((5, 3)), np.outer(along, along), 0.2)
        solve_and_hold(case, np.zeros(6), np.zeros(6), [thing])


# 2. NaN and infinity


@pytest.mark.parametrize("bad", [NAN, INF, -INF])
@pytest.mark.parametrize("where", ["x0", "x_ref"])
def test_02_nan_and_infinity_are_refused_before_the_solver(where, bad, monkeypatch):
    mpc = MPC(problem(N))
    mpc.step(**good())
    step = good()
    step[where] = np.where(np.arange(4) == 2, bad, step[where])
    with monkeypatch.context() as patch:
        for call in ("solve", "rank"):
            patch.setattr(ProgramSolver, call, lambda *_: pytest.fail("the solver was asked"))
        with pytest.raises(NotFiniteError, match=where):
            mpc.step(**step)
    untouched = MPC(problem(N))
    untouched.step(**good())
    assert same([mpc.step(**good())], [untouched.step(**good())])


@pytest.mark.parametrize("bad", [NAN, INF])
def test_02_predictions_with_nan_cannot_be_made(bad):
    with pytest.raises(NotFiniteError, match="means"):
        ObstaclePrediction(np.full((N + 1, 2), bad), np.eye(2), 0.2)
    with pytest.raises(NotFiniteError, match="radius"):
        ObstaclePrediction(np.zeros((N + 1, 2)), np.eye(2), bad)


# 3. Degenerate geometry


@pytest.mark.parametrize("inflation", ["exact", "axes"])
@SOLVERS
def test_03_an_obstacle_on_the_robot_and_coincident_obstacles(inflation, solver):
    case = problem(N, inflation, max_obstacles=3)
    settings = Settings(solver=solver)
    for present in ([ON_TOP], [ON_TOP, ON_TOP], [WALL[0], WALL[0], ON_TOP], WALL):
        solve_and_hold(case, REF[0], REF, present, settings)


def test_03_obstacles_come_and_go():
    case = problem(N, max_obstacles=3)
    mpc = MPC(case)
    for present in ([], [ON_TOP], WALL, [ON_TOP, *WALL], [], WALL[:1]):
        hold(case, REF[0], REF, present, mpc.step(REF[0], REF, present))


# 4. Stale, future and missing stamps


def test_04_late_predictions_grow_and_too_old_ones_stop_the_robot():
    case, there = problem(N), obstacle(N, (2.6, 0.05), growth=0.0)
    mpc = MPC(case)
    fresh = mpc.step(REF[0], REF, [replace(there, stamp=5.0)], time=5.0)
    mpc.reset()
    late = mpc.step(REF[0], REF, [replace(there, stamp=4.5)], time=5.0)
    assert fresh.ok
    assert (mpc.obstacles[0].largest_std > there.largest_std).all()
    assert late.cost > fresh.cost
    stale = mpc.step(REF[0], REF, [replace(there, stamp=0.0)], time=5.2)
    assert stale.status is Status.STALE
    assert not stale.ok
    np.testing.assert_allclose(stale.u0, [-3.0, 0.0])
    refusing = MPC(case, Settings(staleness=StalenessPolicy(beyond="refuse")))
    with pytest.raises(StaleDataError, match="5"):
        refusing.step(REF[0], REF, [replace(there, stamp=0.0)], time=5.0)


def test_04_clocks_that_disagree_and_stamps_that_are_missing_are_refused():
    there = obstacle(N, (2.6, 0.05))
    mpc = MPC(problem(N), Settings(staleness=StalenessPolicy(stamps="required")))
    for given, time_now in ((there, 1.0), (replace(there, stamp=1.0), None)):
        with pytest.raises(InvalidArgumentError):
            mpc.step(REF[0], REF, [given], time=time_now)
    with pytest.raises(InvalidArgumentError, match="stamp"):
        mpc.step(REF[0], REF, [replace(there, stamp=9.0)], time=1.0)
    assert mpc.step(REF[0], REF, [replace(there, stamp=1.0)], time=1.0).ok
    with pytest.raises(StaleDataError):
        mpc.step(REF[0], REF, [replace(there, stamp=0.9)], time=0.9)


def test_04_what_vanishes_is_kept_and_grows():
    mpc, there = MPC(problem(N)), replace(obstacle(N, (2.6, 0.05), growth=0.0), name="cart")
    mpc.step(REF[0], REF, [there], time=0.0)
    for k in range(1, 5):
        plan = mpc.step(REF[0], REF, [], time=0.2 * k)
        assert plan.s.shape == (1,)
        assert (mpc.obstacles[0].largest_std > there.largest_std).all()
    assert mpc.step(REF[0], REF, [], time=1.2).s.shape == (0,)


# 5. Programs that were not solved


@SOLVERS
@pytest.mark.parametrize(
    "settings",
    [{"max_iterations": 1}, {"deadline": 1e-6}, {"deadline": 1e-6, "multi_start": False}],
)
def test_05_hurried_plans_say_what_they_are(settings, solver):
    """Infeasible (an obstacle on the robot, a closed way) and non-convex ones among them."""
    case = problem(N, max_obstacles=2)
    for present in ([ON_TOP], WALL, [obstacle(N, (1.5, 0.0))], [obstacle(N, (2.0, 0.3))]):
        solve_and_hold(case, REF[0], REF, present, Settings(solver=solver, **settings))


@SOLVERS
@pytest.mark.parametrize("first", [True, False], ids=["at once", "later"])
def test_05_no_input_comes_from_a_program_without_a_solution(solver, first, monkeypatch):
    """All solvers give up, at the first step or after a good one."""
    case = problem(N)
    mpc = MPC(case, Settings(solver=solver))
    if not first:
        assert mpc.step(**good()).ok
    for backend in (OSQP, PIQP):
        monkeypatch.setattr(backend, "run", lambda *_: None)
    for _ in range(2 * N):
        plan = mpc.step(**good())
        hold(case, *good().values(), plan)
        assert not plan.status.certified
    monkeypatch.undo()
    assert mpc.step(**good()).ok


@pytest.mark.parametrize("iterations", range(1, 7))
@pytest.mark.parametrize("sides", [True, False])
def test_05_obstacles_far_from_the_first_plan_are_not_forgotten(iterations, sides):
    """The way round the large one leads into the small one, which was out of reach before."""
    N = 15
    case = problem(N, max_obstacles=2)
    present = [
        ObstaclePrediction(np.tile(at, (N + 1, 1)), 1e-4 * np.eye(2), radius)
        for at, radius in (([5.0, 0.1], 2.5), ([5.0, -3.6], 0.5))
    ]
    settings = Settings(max_iterations=iterations, multi_start=sides)
    x0, goal = np.array([0.0, 2.0, 0.0, 0.0]), np.array([8.0, 0.0, 0.0, 0.0])
    solve_and_hold(case, x0, goal, present, settings)


@SOLVERS
@pytest.mark.parametrize("garbage", [NAN, INF, 2143289344.0, 1e300, -1e300])
def test_05_a_solver_that_returns_garbage_is_not_believed(garbage, solver, monkeypatch):
    case, asked = problem(N), []

    def lying(run):
        def lie(self, effort):
            asked.append(effort)
            point = run(self, effort)
            return None if point is None else tuple(np.full_like(p, garbage) for p in point)

        return lie

    for backend in (OSQP, PIQP):
        monkeypatch.setattr(backend, "run", lying(backend.run))
    with np.errstate(all="ignore"):
        plan = SCP(case, Settings(solver=solver)).solve(*good().values())
    assert asked
    hold(case, *good().values(), plan)


# 6. Deadlines


class Slow:
    """Makes every run of OSQP take a while."""

    def __init__(self, monkeypatch, seconds):
        self.calls = 0
        run = OSQP.run

        def slow(solver, effort):
            self.calls += 1
            time.sleep(seconds)
            return run(solver, effort)

        monkeypatch.setattr(OSQP, "run", slow)


def test_06_a_slow_solver_is_stopped_at_the_deadline(monkeypatch):
    """Ten times slower than usual; what has begun ends, nothing more is begun."""
    case = problem(20, s_min=0.5)
    ref = straight_reference(20)
    blocking = [obstacle(20, (3.0, 0.1), (0.5, 0.0))]
    slow = Slow(monkeypatch, 0.02)
    patient = SCP(case).solve(ref[0], ref, blocking)
    assert patient.timing.total > 0.1
    asked = slow.calls
    solver = SCP(case, Settings(deadline=0.05))  # makes first calls of its own
    slow.calls = 0
    hurried = solver.solve(ref[0], ref, blocking)
    hold(case, ref[0], ref, blocking, hurried)
    assert slow.calls < asked


def test_06_overruns_are_counted(monkeypatch):
    mpc = MPC(problem(N), Settings(deadline=0.1))
    for _ in range(5):
        mpc.step(REF[0], REF)
    quick = mpc.overruns
    Slow(monkeypatch, 0.3)
    for _ in range(3):
        mpc.step(REF[0], REF, [obstacle(N, (1.5, 0.1))])
    # The first one is late; then it is known that a program takes too long, and none is begun.
    assert quick + 1 <= mpc.overruns <= quick + 2
    mpc.reset()
    assert mpc.overruns == 0


# 7. Limits


@SOLVERS
@pytest.mark.parametrize(
    ("low", "high"), [(-3.0, 3.0), (-0.1, 2.0), (0.3, 0.9), ([-2, 1], [-1, 1]), (0.0, 0.0)]
)
def test_07_inputs_are_within_limits_whatever_the_status(low, high, solver):
    case = problem(N, u_min=low, u_max=high, max_obstacles=2)
    for settings in (Settings(solver=solver), Settings(solver=solver, max_iterations=1)):
        mpc = MPC(case, settings)
        for k, present in enumerate(([ON_TOP], WALL, [], WALL)):
            plan = mpc.step(REF[0], REF, present)
            hold(case, REF[0], REF, present, plan)
            if k == 1:  # the robot is carried off
                plan = mpc.step(REF[0] + 50.0, REF, present)
                hold(case, REF[0] + 50.0, REF, present, plan)
