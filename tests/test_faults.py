"""The fourteen faults that break controllers of this kind, one check or small group for each.

What a plan claims is judged by `judge.py`, which shares no code with the package. Any single step
is in `test_steps_property.py`, any sequence of steps (check 12) in `test_machine.py`.
"""

import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from driving import N, bits, drive, good, same
from instances import S_REF, instance, obstacle, problem, rotated, straight_reference
from judge import judge
from scipy import stats

from scp_mpc import (
    MPC,
    SCP,
    ConcurrentUseError,
    CovarianceError,
    DoubleIntegrator,
    Freshness,
    InvalidArgumentError,
    Margin,
    NotFiniteError,
    ObstaclePrediction,
    Settings,
    ShapeError,
    StaleDataError,
    Status,
    TooManyObstaclesError,
)
from scp_mpc.solver.active_set import ActiveSetSolver
from scp_mpc.solver.oracle import Oracle
from scp_mpc.solver.qp import QPStatus
from scp_mpc.solver.step_data import StepData
from scp_mpc.solver.subproblem import Subproblem
from scp_mpc.solver.trusted import TrustedSolver

NAN, INF = np.nan, np.inf
REF = straight_reference(N)
ON_TOP = ObstaclePrediction(REF[:, [0, 2]], 0.04 * np.eye(2), 0.2)
WALL = [ObstaclePrediction(np.tile([1.2, y], (N + 1, 1)), 0.3 * np.eye(2), 0.4) for y in (-1, 1)]


def hold(case, x0, x_ref, obstacles, plan):
    """What every plan must be, whatever happened."""
    assert np.isfinite(plan.U).all(), plan.status
    assert (plan.u0 >= case.u_min).all()
    assert (plan.u0 <= case.u_max).all()
    assert judge(case, x0, x_ref, obstacles, plan).complaints == []


def solve_and_hold(case, x0, x_ref, obstacles, settings=None):
    plan = SCP(case, settings).solve(x0, x_ref, obstacles)
    hold(case, x0, x_ref, obstacles, plan)
    return plan


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


def test_01_a_huge_covariance_does_not_spoil_a_thin_one():
    """The thin one is a line; what counts as zero must not be measured by its neighbour."""
    case = problem(4)
    ref = straight_reference(4)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        line = rotated((1.0, 0.0), rng.uniform(0.0, np.pi))
        covariances = np.tile((line + line.T) / 2, (5, 1, 1))
        covariances[3] = 10 ** rng.uniform(8, 12) * np.eye(2)
        mean = ref[2, [0, 2]] + 0.3 * rng.normal(size=2)
        thing = ObstaclePrediction(np.tile(mean, (5, 1)), covariances, 0.2)
        solve_and_hold(case, ref[0], ref, [thing])


def test_01_lines_in_space_may_go_through_the_robot():
    case = problem(
        4, model=DoubleIntegrator(0.2, 3), Q=[0.2, 0.05] * 3, R=[0.001] * 3, max_obstacles=1
    )
    for seed in range(48):
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
        for engine in (ActiveSetSolver, TrustedSolver):
            patch.setattr(engine, "solve", lambda *_: pytest.fail("the solver was asked"))
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
@pytest.mark.parametrize("condense", [True, False])
def test_03_an_obstacle_on_the_robot_and_coincident_obstacles(inflation, condense):
    case = problem(N, inflation, max_obstacles=3)
    settings = Settings(condense=condense)
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
    assert (mpc.obstacles[0].spread > there.spread).all()
    assert late.cost > fresh.cost
    stale = mpc.step(REF[0], REF, [replace(there, stamp=0.0)], time=5.2)
    assert stale.status is Status.STALE
    assert not stale.ok
    np.testing.assert_allclose(stale.u0, [-3.0, 0.0])
    refusing = MPC(case, Settings(freshness=Freshness(beyond="refuse")))
    with pytest.raises(StaleDataError, match="5"):
        refusing.step(REF[0], REF, [replace(there, stamp=0.0)], time=5.0)


def test_04_clocks_that_disagree_and_stamps_that_are_missing_are_refused():
    there = obstacle(N, (2.6, 0.05))
    mpc = MPC(problem(N), Settings(freshness=Freshness(stamps="required")))
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
        assert (mpc.obstacles[0].spread > there.spread).all()
    assert mpc.step(REF[0], REF, [], time=1.2).s.shape == (0,)


# 5. Programs that were not solved


@pytest.mark.parametrize("condense", [True, False])
@pytest.mark.parametrize(
    "settings", [{"max_iterations": 1}, {"deadline": 1e-6}, {"deadline": 1e-6, "sides": False}]
)
def test_05_hurried_plans_say_what_they_are(settings, condense):
    """Infeasible (an obstacle on the robot, a closed way) and non-convex ones among them."""
    case = problem(N, max_obstacles=2)
    for present in ([ON_TOP], WALL, [obstacle(N, (1.5, 0.0))], [obstacle(N, (2.0, 0.3))]):
        solve_and_hold(case, REF[0], REF, present, Settings(condense=condense, **settings))


@pytest.mark.parametrize("condense", [True, False])
@pytest.mark.parametrize("first", [True, False], ids=["at once", "later"])
def test_05_no_input_comes_from_a_program_without_a_solution(condense, first, monkeypatch):
    """All solvers give up, at the first step or after a good one."""
    case = problem(N)
    mpc = MPC(case, Settings(condense=condense))
    if not first:
        assert mpc.step(**good()).ok
    monkeypatch.setattr(ActiveSetSolver, "_search", lambda *_: None)
    monkeypatch.setattr(TrustedSolver, "solve", lambda *_, **__: None)
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
    settings = Settings(max_iterations=iterations, sides=sides)
    x0, goal = np.array([0.0, 2.0, 0.0, 0.0]), np.array([8.0, 0.0, 0.0, 0.0])
    solve_and_hold(case, x0, goal, present, settings)


@pytest.mark.parametrize("garbage", [NAN, INF, 2143289344.0, 1e300])
def test_05_a_solver_that_returns_garbage_is_not_believed(garbage, monkeypatch):
    case = problem(N)
    search = ActiveSetSolver._search

    def lying(self, *given):
        end = search(self, *given)
        return None if end is None else (np.full_like(end[0], garbage), 0 * end[1] + garbage)

    monkeypatch.setattr(ActiveSetSolver, "_search", lying)
    with np.errstate(all="ignore"):
        plan = SCP(case).solve(*good().values())
    hold(case, *good().values(), plan)


# 6. Deadlines


class Slow:
    """Makes every dense program take a while."""

    def __init__(self, monkeypatch, seconds):
        self.calls = 0
        search = ActiveSetSolver._search

        def slow(solver, *given):
            self.calls += 1
            time.sleep(seconds)
            return search(solver, *given)

        monkeypatch.setattr(ActiveSetSolver, "_search", slow)


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


@pytest.mark.parametrize("condense", [True, False])
@pytest.mark.parametrize(
    ("low", "high"), [(-3.0, 3.0), (-0.1, 2.0), (0.3, 0.9), ([-2, 1], [-1, 1]), (0.0, 0.0)]
)
def test_07_inputs_are_within_limits_whatever_the_status(low, high, condense):
    case = problem(N, u_min=low, u_max=high, max_obstacles=2)
    for settings in (Settings(condense=condense), Settings(condense=condense, max_iterations=1)):
        mpc = MPC(case, settings)
        for k, present in enumerate(([ON_TOP], WALL, [], WALL)):
            plan = mpc.step(REF[0], REF, present)
            hold(case, REF[0], REF, present, plan)
            if k == 1:  # the robot is carried off
                plan = mpc.step(REF[0] + 50.0, REF, present)
                hold(case, REF[0] + 50.0, REF, present, plan)


# 8. Determinism

BITS = """
import sys
sys.path.insert(0, sys.argv[1])
from driving import N, bits, drive
from instances import problem
from scp_mpc import MPC
print(bits(drive(MPC(problem(N)), 12)))
"""


def test_08_same_bits_in_every_run_process_and_after_reset():
    mpc = MPC(problem(N))
    here = bits(drive(mpc, 12))
    drive(mpc, 3)
    mpc.reset()
    assert bits(drive(mpc, 12)) == here
    command = [sys.executable, "-c", BITS, str(Path(__file__).parent)]
    for seed in ("1", "2"):  # of Python's hashes
        done = subprocess.run(
            command,
            env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout.strip() == here


# 9. Memory


def resident():
    """Bytes in memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE")


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc on this system")
def test_09_memory_is_flat_over_ten_thousand_steps():
    case = problem(4, max_obstacles=2)
    ref = straight_reference(4)
    near, far = obstacle(4, (0.9, 0.3)), obstacle(4, (30.0, 0.0))
    worlds = [[far], [], [far, far], [near]]
    mpc = MPC(case, Settings(sides=False))

    def run(steps):
        for k in range(steps):
            mpc.step(ref[0], ref, worlds[3 if k % 200 == 0 else k % 3])

    run(1000)
    before = resident()
    run(10_000)
    assert resident() - before < 5e6


# 10. Threads


def test_10_two_controllers_in_two_threads_equal_serial():
    def run(seed):
        start = drive(MPC(problem(N)), 4 + seed)
        return bits(start)

    serial = [run(seed) for seed in range(4)]
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(run, range(4))) == serial


def test_10_two_threads_in_one_controller_raise_and_leave_no_trace():
    """The second comes while the first waits inside its step."""
    mpc = MPC(problem(N))

    def waiting(pool):
        other = pool.submit(mpc.step, REF[0], REF)
        with pytest.raises(ConcurrentUseError):
            other.result()
        yield obstacle(N, (1.5, 0.1))

    with ThreadPoolExecutor(1) as pool:
        disturbed = mpc.step(REF[0], REF, waiting(pool))
    alone = MPC(problem(N)).step(REF[0], REF, [obstacle(N, (1.5, 0.1))])
    assert same([disturbed], [alone])


# 11. Arguments


def test_11_arguments_stay_as_they_are_and_may_come_in_any_form():
    """Exactly representable numbers, so that every type holds the same ones."""
    x0 = np.array([0.0, 2.0, 0.25, 0.0])
    x_ref = np.round(REF * 8) / 8
    means = np.tile([1.5, 0.125], (N + 1, 1))
    covariances = np.tile([[0.0625, 0.03125], [0.03125, 0.125]], (N + 1, 1, 1))
    arrays = (x0, x_ref, means, covariances)
    before = [a.tobytes() for a in arrays]

    def solved(x0, x_ref, means, covariances):
        mpc = MPC(problem(N))
        thing = [ObstaclePrediction(means, covariances, 0.25)]
        return [mpc.step(x0, x_ref, thing) for _ in range(2)]

    plain = solved(*arrays)
    forms = [
        lambda a: a.tolist(),
        lambda a: np.repeat(a, 2, axis=0)[::2],
        lambda a: a[::-1].copy()[::-1],
        np.asfortranarray,
        lambda a: a.astype(np.float32),
        lambda a: tuple(a),
    ]
    for form in forms:
        assert same(plain, solved(*map(form, arrays)))
    whole = [np.round(a) for a in (x0, x_ref, means, covariances)]
    assert same(solved(*whole), solved(*(a.astype(np.int64) for a in whole)))
    assert before == [a.tobytes() for a in arrays]


# 12. Mixed calls, a short one; any sequence of them is in test_machine.py


def test_12_bad_calls_among_good_ones_leave_no_trace():
    mpc, twin = MPC(problem(N)), MPC(problem(N))
    bad = [
        ({"x0": [NAN] * 4}, NotFiniteError),
        ({"x_ref": REF[:-1]}, ShapeError),
        ({"obstacles": [ON_TOP] * 2}, TooManyObstaclesError),
        ({"obstacles": 3}, InvalidArgumentError),
    ]
    for change, error in bad:
        with pytest.raises(error):
            mpc.step(**(good() | change))
        assert same([mpc.step(**good())], [twin.step(**good())])
        if error is ShapeError:
            mpc.reset()
            twin.reset()


# 13. A second opinion


@pytest.mark.parametrize("inflation", ["exact", "axes"])
@pytest.mark.parametrize("kind", ["ahead", "beside", "crossing", "elongated"])
def test_13_another_solver_finds_the_same_program_solved(kind, inflation):
    """The program about a converged plan, written anew from the caller's data, is solved by it."""
    case = instance(kind, 8, inflation, S_REF, 1)
    plan = SCP(case.problem).solve(case.x0, case.x_ref, case.obstacles)
    hold(case.problem, case.x0, case.x_ref, case.obstacles, plan)
    if not plan.ok:
        return
    step = StepOf(case)
    solution = Oracle("clarabel").solve(step.program_about(plan))
    assert solution.status is QPStatus.SOLVED
    theirs = step.subproblem.unpack(solution.x, solution.y)
    np.testing.assert_allclose(theirs.inputs, plan.U, atol=1e-3)
    mine, other = (step.cost(v) for v in (plan.U, theirs.inputs))
    assert mine == pytest.approx(other, rel=1e-5)


class StepOf:
    """The sparse program of a control step."""

    def __init__(self, case):
        self.case = case
        self.step = StepData.read(case.problem, case.x0, case.x_ref, case.obstacles)
        self.subproblem = Subproblem(case.problem)
        self.subproblem.write_step(self.step.x0, self.step.x_ref)

    def program_about(self, plan):
        spaces = self.step.half_spaces(plan.X, plan.iterate.s)
        self.subproblem.write_half_spaces(spaces)
        return self.subproblem.program

    def cost(self, U):
        """Of inputs alone, by a plain loop."""
        problem, x, total = self.case.problem, self.case.x0, 0.0
        for u, ref in zip(U, self.case.x_ref[1:], strict=True):
            x = problem.model.A @ x + problem.model.B @ u
            total += (x - ref) @ problem.Q @ (x - ref) + u @ problem.R @ u
        return total


@pytest.mark.parametrize("condense", [True, False])
def test_13_kkt_conditions_hold_in_terms_of_the_callers_data(condense):
    """A swallowed update would leave the certificate of another program.

    With the obstacles' forces from the plan's own multipliers, the gradient with respect to the
    inputs is made anew by a plain adjoint loop; it must vanish where an input is between its
    limits and push outwards where it is not.
    """
    case = instance("ahead", 8, "exact", S_REF, 2)
    problem_ = case.problem
    mpc = MPC(problem_, Settings(condense=condense))
    mpc.step(case.x0 + 0.3, case.x_ref, [obstacle(8, (1.0, 0.4))])
    plan = mpc.step(case.x0, case.x_ref, case.obstacles)
    assert plan.status.certified
    A, B, position = problem_.model.A, problem_.model.B, problem_.model.position
    force = plan.multipliers.obstacles[0]
    assert (force <= 0).all()
    assert force.min() < -1e-3
    reach = problem_.robot_radius + case.obstacles[0].radius
    costate, gradient = np.zeros(4), np.zeros_like(plan.U)
    for i in range(8, 0, -1):
        mu, Sigma = case.obstacles[0].means[i], case.obstacles[0].covariances[i]
        pull = np.zeros(4)
        if force[i - 1] < 0:
            n, distance = nearest(plan.X[i, position] - mu, Sigma, plan.s[0])
            pull[position] = force[i - 1] * n
            assert abs(force[i - 1] * (distance - reach)) < 1e-5
        Q = problem_.Qf if i == 8 else problem_.Q
        costate = A.T @ costate + 2 * Q @ (plan.X[i] - case.x_ref[i]) + pull
        gradient[i - 1] = B.T @ costate + 2 * problem_.R @ plan.U[i - 1]
    low, high = problem_.u_min + 1e-9 >= plan.U, problem_.u_max - 1e-9 <= plan.U
    assert np.abs(gradient[~low & ~high]).max(initial=0.0) < 1e-5
    assert (gradient[low] > -1e-5).all()
    assert (gradient[high] < 1e-5).all()


def nearest(y, Sigma, s):
    """Outward normal and signed distance, by a fan of directions and bisection."""
    low, high = -np.pi, np.pi
    for _ in range(14):
        t = np.linspace(low, high, 721)
        n = np.stack([np.cos(t), np.sin(t)], axis=1)
        values = n @ y - s * np.sqrt(np.einsum("ki,ij,kj->k", n, Sigma, n))
        best = values.argmax()
        low, high = t[max(best - 1, 0)], t[min(best + 1, 720)]
    return n[best], values[best]


# 14. Measured risk


@pytest.mark.parametrize("delta", [0.1, 0.05])
def test_14_collisions_are_as_rare_as_promised(delta):
    """Per stage, with the exact no-go set; the upper end of the 95 % interval decides."""
    s = float(stats.norm.isf(delta))
    case = problem(N, margin=Margin(reference=s, lower=s))
    thing = obstacle(N, (1.6, 0.1), covariance=rotated((0.45, 0.15), 0.6))
    plan = solve_and_hold(case, REF[0], REF, [thing])
    assert plan.ok
    rng, samples = np.random.default_rng(0), 5_000
    worst = 0.0
    for i in range(1, N + 1):
        centres = rng.multivariate_normal(thing.means[i], thing.covariances[i], samples)
        gaps = np.linalg.norm(centres - plan.X[i, [0, 2]], axis=1)
        hits = int((gaps < case.robot_radius + thing.radius).sum())
        interval = stats.binomtest(hits, samples).proportion_ci(0.95, method="exact")
        worst = max(worst, interval.high)
    assert worst <= delta
    assert worst > delta / 100  # the obstacle was in the way
