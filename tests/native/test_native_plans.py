"""Plans of the native core are the loop's, and whatever is around them, too.

Both engines at a tolerance at which they agree to 1e-7; large random runs are elsewhere.
"""

import copy
import pickle
import re
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from instances import problem
from native import is_stale, needs_core

from scp_mpc import (
    MPC,
    SCP,
    ConcurrentUseError,
    DoubleIntegrator,
    FunctionModel,
    InvalidArgumentError,
    JointRisk,
    KinematicBicycle,
    LinearModel,
    Margin,
    MissingCoreError,
    ObstaclePrediction,
    ObstaclePredictions,
    PlanarQuadrotor,
    Polytope,
    Settings,
    StageRisk,
    StalenessPolicy,
    Status,
    Unicycle,
)
from scp_mpc.arrays import SampledArray
from scp_mpc.control import backup
from scp_mpc.native import constants, core, library
from scp_mpc.scp.native import _STATUSES, NativePlan
from scp_mpc.trajectory import rollout

N = 10
OSQP = Settings(deadline=None, tolerance=1e-9)
NATIVE = replace(OSQP, solver="native")
BOX = Polytope.box([0.6, 0.4], angle=0.3)
ROUND = Polytope(0.3 * np.stack([np.cos(ANGLES := np.linspace(0, 6, 20)), np.sin(ANGLES)], axis=1))
ROOT = Path(__file__).parents[2]
HEADER = (ROOT / "scp_mpc" / "native" / "scp_mpc.h").read_text()


def spring(x, u):
    """A point on a spring that stiffens, with drag."""
    return np.array([x[2], x[3], u[0] - 0.1 * x[0] ** 3, u[1] - 0.2 * x[3]])


USERS = FunctionModel(spring, nx=4, nu=2, dt=0.2, position=[0, 1], velocity=[2, 3])
BALLOON = LinearModel(
    np.kron([[1.0, 0.2], [0.0, 1.0]], np.eye(3)),
    np.kron([[0.02], [0.2]], np.eye(3)),
    dt=0.2,
    position=[0, 1, 2],
    velocity=[3, 4, 5],
)


def case(model, **changes):
    weights = {"Q": np.full(model.nx, 0.5), "R": np.full(model.nu, 0.1)}
    return problem(N, model=model, margin=None, **weights, **changes)


def ahead(robot, count=1, shape=None, dim=2):
    """Obstacles near the straight way from the origin, where the robot is, to 4 m along an axis."""
    means = np.zeros((count, N + 1, dim))
    means[..., 0] = 2.0 + 0.7 * np.arange(count)[:, None] - 0.05 * np.arange(N + 1)
    means[..., 1] = 0.1 * (-1.0) ** np.arange(count)[:, None]
    covariances = np.broadcast_to(0.01 * np.eye(dim), (count, N + 1, dim, dim))
    shapes = None if shape is None else (shape,) * count
    goal = robot.model.state(4.0 * np.eye(dim)[0], np.zeros(dim))
    start = np.zeros(robot.model.nx)
    return start, goal, ObstaclePredictions(means, covariances, 0.2, shapes=shapes)


LINEAR = DoubleIntegrator(dt=0.2)
CASES = {
    "samples": (case(LINEAR), 1),
    "axes": (case(LINEAR, inflation="axes"), 1),
    "between": (case(LINEAR, nodes_per_interval=4, max_obstacles=2), 2),
    "size moves": (replace(case(LINEAR), margin=Margin(lower=0.5)), 1),
    "growth": (case(LINEAR, growth_time=0.8), 1),
    "bounds": (case(LINEAR, speed_max=1.2, x_max=[9, 9, 0.05, 9], du_min=-1.0, du_max=1.0), 1),
    "soft": (case(LINEAR, x_max=[0.5, 9, 9, 9], x_soft=True), 0),
    "stage risk": (replace(case(LINEAR, nodes_per_interval=2), margin=StageRisk(0.05)), 1),
    "joint risk": (replace(case(LINEAR), margin=JointRisk(0.05, "iterative")), 1),
    "unicycle": (case(Unicycle(0.2)), 1),
    "discs": (case(KinematicBicycle(0.2, 0.5), discs=[-0.2, 0.2], nodes_per_interval=2), 1),
    "3-D": (case(BALLOON, nodes_per_interval=2), 1),
    "quadrotor": (case(PlanarQuadrotor(0.2)), 0),
    "user's": (case(USERS, nodes_per_interval=2), 1),
}


def same(native, loop, tolerance=1e-7):
    assert isinstance(native, NativePlan)
    assert native.status is loop.status
    assert abs(native.cost - loop.cost) <= tolerance * max(1.0, loop.cost)
    for name in ("X", "U", "s", "slack", "x_slack"):
        found, wanted = getattr(native, name), getattr(loop, name)
        assert found.shape == wanted.shape
        np.testing.assert_allclose(found, wanted, atol=10 * tolerance, rtol=0)
        assert not found.flags.writeable
    assert (native.ok, native.contact) == (loop.ok, loop.contact)


def test_without_a_core_the_error_says_so_and_the_default_works(tmp_path, monkeypatch):
    monkeypatch.setattr(core, "library", lambda: library.loaded(tmp_path))
    for owner in (SCP, MPC):
        with pytest.raises(MissingCoreError, match=r"solver: 'native' is not there: .*C compiler"):
            owner(CASES["samples"][0], NATIVE)
        owner(CASES["samples"][0], OSQP)


def test_nobody_imports_the_core_who_does_not_ask_for_it():
    code = "import sys, scp_mpc; assert 'scp_mpc.native.library' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, cwd=ROOT)


def test_numbers_from_upstairs():
    assert constants.BACKUP_SECONDS == backup._SECONDS
    assert np.array_equal(constants.BACKUP_SPEEDS, backup._SPEEDS)
    names = re.findall(r"SCP_(\w+)", re.search(r"\{([^{}]*)\} scp_status", HEADER)[1])
    assert [status.name for status in _STATUSES] == names


@needs_core
def test_the_library_is_that_of_the_sources():
    assert not is_stale(), "make builds it again"


@needs_core
def test_members_have_their_names():
    names = [name for name, _ in library.ProblemStruct._fields_]
    assert [library.library().scp_name(k + 1).decode() for k in range(len(names))] == names


@needs_core
@pytest.mark.parametrize("name", CASES)
def test_plans_are_those_of_the_loop(name):
    this, count = CASES[name]
    x0, goal, obstacles = ahead(this, max(count, 1), dim=this.model.dim)
    loop, native = SCP(this, OSQP), SCP(this, NATIVE)
    given = x0, goal, obstacles[:count]
    first = loop.solve(*given)
    same(native.solve(*given), first)
    moved = x0 + 0.01, goal, obstacles[:count]  # from a guess with multipliers
    u_last = first.u0 if this.limits_rates else None
    plans = [solver.solve(*moved, first.iterate, u_last=u_last) for solver in (native, loop)]
    same(*plans)
    assert plans[0].iterate.touches == plans[1].iterate.touches
    if count:
        assert first.iterate.touches


@needs_core
def test_multipliers_residuals_and_risk_are_those_of_the_loop():
    this = CASES["between"][0]
    given, more = ahead(this, 2), {"max_programs": 2**32 + 200, "max_candidates": 2**40}
    native, loop = (SCP(this, replace(s, **more)).solve(*given) for s in (NATIVE, OSQP))
    for name, values in vars(loop.multipliers).items():
        found = getattr(native.multipliers, name)
        assert found.size == values.size
        np.testing.assert_allclose(found.ravel(), values.ravel(), atol=1e-5, err_msg=name)
    assert native.kkt.worst <= 1e-9
    assert abs(native.kkt.curvature - loop.kkt.curvature) < 1e-6
    # The loop's radii have a reserve for the motion between nodes, these are for the plan's own.
    assert 0.5 * loop.risk.joint < native.risk.joint <= loop.risk.joint * (1 + 1e-9)
    assert set(native.qps) <= {"kkt", "native", "ranked", "cut", "infeasible"}
    assert native.qps["native"] >= 1
    assert len(native.candidates) == len(loop.candidates)
    for found, wanted in zip(native.candidates, loop.candidates, strict=True):
        assert (found.obstacle, found.time) == (wanted.obstacle, wanted.time)
        np.testing.assert_allclose(found.side, wanted.side, atol=1e-9)


@needs_core
@pytest.mark.parametrize("shape", [BOX, ROUND], ids=["box", "more corners than there is room for"])
def test_polygons(shape):
    this = case(LINEAR)
    x0, goal, obstacles = ahead(this, shape=shape)
    loop, native = SCP(this, OSQP), SCP(this, NATIVE)
    for given in (obstacles, [], ahead(this)[2], obstacles):
        same(native.solve(x0, goal, given), loop.solve(x0, goal, given))


@needs_core
def test_what_else_a_step_may_bring():
    this = case(LINEAR, du_min=-0.5, du_max=0.5)
    loop, native = SCP(this, OSQP), SCP(this, NATIVE)
    x0, goal, obstacles = ahead(this)
    straight = rollout(this.model.step, x0, np.zeros((N, 2)))
    for more in (
        {"u_last": [-1.0, 0.3]},
        {"robot_covariance": 0.02 * np.eye(2)},
        {"guess": straight},
        {"multi_start": False},
        {},
    ):
        plans = [solver.solve(x0, goal, obstacles, **more) for solver in (native, loop)]
        same(*plans)
        same(native.solve(list(x0), goal.tolist(), list(obstacles), **more), plans[1])


def drive(mpc, steps, x=None, first=0, **given):
    """Plans of a closed loop among three obstacles that come along."""
    x, plans = np.zeros(4) if x is None else x, []
    goal = np.array([6.0, 0.0, 0.0, 0.0])
    for k in range(first, first + steps):
        means = np.array([[2.0, 0.05], [3.0, -0.4], [4.0, 0.6]])[:, None]
        way = 0.2 * (k + np.arange(N + 1)[:, None])
        means = means + way * [[[-0.2, 0.0]], [[0.0, 0.1]], [[0.0, 0.0]]]
        obstacles = ObstaclePredictions(means, 0.01 * np.eye(2), 0.2)
        plans.append(mpc.step(x, goal, obstacles, **given))
        x = mpc.problem.model.step(x, plans[-1].u0)
    return plans, x


@needs_core
@pytest.mark.parametrize("slots", [3, 2])
def test_controllers_do_the_same(slots):
    this = case(LINEAR, max_obstacles=slots, du_min=-2.0, du_max=2.0, nodes_per_interval=2)
    controllers = [MPC(this, settings) for settings in (NATIVE, OSQP)]
    runs = [drive(mpc, 12)[0] for mpc in controllers]
    for native, loop in zip(*runs, strict=True):
        same(native, loop, 1e-6)
        assert native.left_out == loop.left_out == 3 - slots
    native, loop = controllers
    assert native.counts == loop.counts
    assert len(native.obstacles) == len(loop.obstacles) == slots
    np.testing.assert_allclose(native.nominal().states, loop.nominal().states, atol=1e-5)
    assert any(plan.iterate.touches for plan in runs[1])


def bits(plans):
    return [(plan.status, plan.cost, plan.X.tobytes(), plan.slack.tobytes()) for plan in plans]


@needs_core
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda mpc: pickle.loads(pickle.dumps(mpc))])
def test_a_copy_goes_on_from_the_same_plan_and_a_reset_one_from_nothing(copied):
    this = case(LINEAR, max_obstacles=3)
    mpc = MPC(this, NATIVE)
    before, x = drive(mpc, 4)
    other = copied(mpc)
    ahead_, _ = drive(mpc, 4, x, first=4)
    assert bits(drive(other, 4, x, first=4)[0]) == bits(ahead_)
    assert other.counts == mpc.counts
    mpc.reset()
    assert mpc.nominal() is None
    assert bits(drive(mpc, 4)[0]) == bits(before)


@needs_core
def test_room_for_larger_shapes_is_made_without_forgetting():
    this = case(LINEAR)
    controllers = [MPC(this, settings) for settings in (NATIVE, OSQP)]
    x, goal, obstacles = ahead(this, shape=BOX)
    for shape in (BOX, BOX, ROUND, BOX):
        given = ObstaclePredictions(obstacles.means, 0.01 * np.eye(2), 0.1, shapes=[shape])
        native, loop = (mpc.step(x, goal, given) for mpc in controllers)
        same(native, loop, 1e-6)
        x = this.model.step(x, loop.u0)


@needs_core
def test_predictions_that_are_too_old():
    this = case(LINEAR)
    settings = {"staleness": StalenessPolicy(stop_after=0.3)}
    controllers = [MPC(this, replace(s, **settings)) for s in (NATIVE, OSQP)]
    x, goal, obstacles = np.array([0.0, 1.0, 0.0, 0.0]), *ahead(this)[1:]
    for k, stamp in enumerate((0.0, 0.2, 0.2, 0.2, 0.8, 1.0)):
        means = np.concatenate([obstacles.means, obstacles.means + 3.0])  # one too many
        given = ObstaclePredictions(means, 0.01 * np.eye(2), 0.2, stamp=stamp)
        native, loop = (mpc.step(x, goal, given, time=0.2 * k) for mpc in controllers)
        same(native, loop, 1e-6)
        assert native.left_out == loop.left_out == 1
        x = this.model.step(x, loop.u0)
    assert controllers[0].counts == controllers[1].counts
    assert controllers[0].counts[Status.STALE] == 1


@needs_core
@pytest.mark.parametrize(
    "change",
    [
        {"x0": [0.0, np.nan, 0.0, 0.0]},
        {"x0": np.zeros(3)},
        {"x0": [0.0, 1e16, 0.0, 0.0]},
        {"x0": "here"},
        {"x_ref": np.zeros((N, 4))},
        {"x_ref": np.full((N + 1, 4), np.inf)},
        {"x_ref": SampledArray.of(np.zeros((N + 1, 4)), 0.1)},
        {"obstacles": ObstaclePredictions(np.zeros((1, N + 1, 2)), np.eye(2), 0.1, dt=0.1)},
        {"obstacles": [None]},
        {"obstacles": ObstaclePrediction.static(N, [9, 9], 0.1)},
        {"obstacles": [ObstaclePrediction.static(N, [9, 9], 0.1)] * 2},
        {"obstacles": [ObstaclePrediction.static(N + 1, [9, 9], 0.1)]},
        {"obstacles": [ObstaclePrediction.static(N, [9, 9, 9], 0.1)]},
        {"u_last": [np.inf, 0.0]},
        {"u_last": [0.0]},
        {"robot_covariance": -np.eye(2)},
        {"robot_covariance": np.eye(3)},
        {"robot_covariance": [[1.0, 0.5], [0.0, 1.0]]},
    ],
)
def test_what_is_refused_is_refused_as_by_the_loop_and_leaves_no_trace(change):
    this = case(LINEAR)
    given = dict(zip(("x0", "x_ref", "obstacles"), ahead(this), strict=True))
    messages = []
    for settings in (NATIVE, OSQP):
        with pytest.raises(InvalidArgumentError) as refused:
            SCP(this, settings).solve(**(given | change))
        messages.append((refused.type, str(refused.value)))
    assert messages[0] == messages[1]
    mpc, twin = MPC(this, NATIVE), MPC(this, NATIVE)
    for controller in (mpc, twin):
        controller.step(**given)
    if not isinstance(change.get("obstacles"), list) or len(change["obstacles"]) != 2:
        with pytest.raises(InvalidArgumentError):
            mpc.step(**(given | change))
    assert bits([mpc.step(**given)]) == bits([twin.step(**given)])


@needs_core
def test_history_is_not_kept():
    with pytest.raises(InvalidArgumentError, match="history: is not kept by solver = 'native'"):
        SCP(CASES["samples"][0], replace(NATIVE, history=True))


@needs_core
def test_arguments_are_not_written_to_and_plans_do_not_change():
    this = CASES["between"][0]
    x0, goal, obstacles = ahead(this, 2)
    solver, given = SCP(this, NATIVE), (x0.copy(), goal.copy())
    plan = solver.solve(*given, obstacles)
    assert np.array_equal(given[0], x0)
    assert np.array_equal(given[1], goal)
    for array in given:
        array += 1.0  # the caller's buffers are the caller's
    solver.solve(*given, [])
    other = SCP(this, NATIVE).solve(x0, goal, obstacles)
    assert bits([plan]) == bits([other])
    assert np.array_equal(plan.step.x0, x0)
    assert plan.risk.joint == other.risk.joint


@needs_core
def test_plans_are_copied_and_changed_like_any():
    this = CASES["between"][0]
    plan = SCP(this, NATIVE).solve(*ahead(this, 2))
    for other in (pickle.loads(pickle.dumps(plan)), copy.copy(plan), replace(plan, left_out=3)):
        assert bits([other]) == bits([plan])
        assert other.contact == ()
        assert other.step.count == 2
        assert other.kkt.worst == plan.kkt.worst
    assert replace(plan, left_out=3).left_out == 3
    with pytest.raises(AttributeError):
        plan.U = plan.X
    with pytest.raises(AttributeError):
        _ = plan.anything


@needs_core
def test_a_contact_is_named():
    this = case(LINEAR, max_obstacles=2)
    there = [ObstaclePrediction.static(N, at, 0.2) for at in ([3.0, 3.0], [0.1, 0.0])]
    plan = SCP(this, NATIVE).solve(np.zeros(4), np.zeros(4), there)
    assert plan.contact == (1,)
    assert not plan.ok


@needs_core
def test_the_rest_of_the_solver_goes_on_to_work():
    this = CASES["samples"][0]
    given = ahead(this)
    native, loop = SCP(this, NATIVE), SCP(this, OSQP)
    for name in ("P", "A"):
        ours, theirs = (getattr(s.subproblem(*given), name).toarray() for s in (native, loop))
        assert np.array_equal(ours, theirs)
    assert np.array_equal(native.brake(*given[:2]).U, loop.brake(*given[:2]).U)
    inputs = 0.1 * np.ones((N, 2))
    assert native.follow(*given, inputs).status is loop.follow(*given, inputs).status


class BrokenError(Exception):
    pass


class Breakable(Unicycle):
    """A unicycle in Python that may break down."""

    fails: list[type[Exception]] = []  # noqa: RUF012

    def linearise(self, states, inputs, fraction=1.0):
        if self.fails:
            raise self.fails[0]
        return super().linearise(states, inputs, fraction)


@needs_core
def test_what_a_users_model_raises_comes_out_and_leaves_no_trace():
    this = case(Breakable(0.2))
    given = ahead(this)
    mpc, twin = MPC(this, NATIVE), MPC(this, NATIVE)
    for controller in (mpc, twin):
        controller.step(*given)
    Breakable.fails.append(BrokenError)
    try:
        with pytest.raises(BrokenError):
            mpc.step(*given)
    finally:
        Breakable.fails.clear()
    assert bits([mpc.step(*given)]) == bits([twin.step(*given)])
    Breakable.fails.append(ZeroDivisionError)  # no value there: what needs no program is left
    try:
        plan = mpc.step(*given)
    finally:
        Breakable.fails.clear()
    assert plan.status in (Status.PREVIOUS, Status.BRAKING, Status.STOPPING, Status.FALLBACK)
    assert np.isfinite(plan.U).all()


@needs_core
def test_a_timer_tells_the_time():
    now = [0.0]

    def timer():
        now[0] += 1.0
        return now[0]

    this = CASES["samples"][0]
    given = ahead(this)
    plan = MPC(this, replace(NATIVE, deadline=0.1), timer).step(*given)
    assert plan.status in (Status.BRAKING, Status.STOPPING, Status.FALLBACK)
    assert MPC(this, replace(NATIVE, deadline=1e6), timer).step(*given).status is Status.CONVERGED
    assert MPC(this, replace(NATIVE, deadline=60.0)).step(*given).status is Status.CONVERGED

    def broken():
        raise BrokenError

    with pytest.raises(BrokenError):
        MPC(this, replace(NATIVE, deadline=0.1), broken).step(*given)


@needs_core
def test_one_thread_at_a_time():
    this = CASES["between"][0]
    solver = SCP(this, NATIVE)
    with solver._busy, pytest.raises(ConcurrentUseError):
        solver.solve(*ahead(this, 2))
    alone, found = bits(drive(MPC(this, NATIVE), 6)[0]), {}
    threads = [
        threading.Thread(target=lambda k=k: found.update({k: bits(drive(MPC(this, NATIVE), 6)[0])}))
        for k in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == {0: alone, 1: alone}
