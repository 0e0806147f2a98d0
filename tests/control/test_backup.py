"""Backups: a plan that is ok is followed by one that is, where the world keeps its word."""

import time

import numpy as np
import pytest
from native import needs_core

from benchmarks.safety import episode
from scp_mpc import (
    MPC,
    DoubleIntegrator,
    ObstaclePrediction,
    Polytope,
    Problem,
    Settings,
    Status,
    Unicycle,
)
from scp_mpc.control import mpc as module
from scp_mpc.control.backup import Backup

BOX = Polytope.box([0.2, 6.0])
KNOWN = {
    "Q": [1, 0.1, 1, 0.1],
    "R": [0.05, 0.05],
    "u_min": -2.0,
    "u_max": 2.0,
    "robot_radius": 0.3,
}


def drive(problem, x, goal, obstacles, steps):
    """Statuses, and positions and speeds of a point mass."""
    mpc, plans, states = MPC(problem), [], [np.array(x, dtype=float)]
    for _ in range(steps):
        plans.append(mpc.step(states[-1], goal, obstacles))
        states.append(problem.model.step(states[-1], plans[-1].u0))
    return plans, np.array(states)


@pytest.mark.parametrize("nodes", [1, 4])
def test_a_gap_too_narrow_is_not_tried(nodes):
    """2 mm narrower than the robot: from the first ok step on every step is ok, and it stops."""
    problem = Problem(
        DoubleIntegrator(0.1), horizon=25, max_obstacles=2, nodes_per_interval=nodes, **KNOWN
    )
    walls = [ObstaclePrediction.static(25, [2.0, y], 0.0, shape=BOX) for y in (3.299, -3.299)]
    plans, states = drive(problem, [0, 0, 0.07, 0], [4.0, 0, 0, 0], walls, 50)
    assert all(plan.ok for plan in plans)
    assert states[:, 0].max() < 1.9
    assert np.abs(states[-1, [1, 3]]).max() < 1e-3


def test_driving_away_from_what_is_near_is_ok():
    problem = Problem(DoubleIntegrator(0.1), horizon=25, **KNOWN)
    pillar = [ObstaclePrediction.static(25, [0.801, 0.0], 0.5)]
    plans, states = drive(problem, np.zeros(4), [-6.0, 0, 0, 0], pillar, 10)
    assert all(plan.status is Status.CONVERGED for plan in plans)
    assert states[-1, 0] < -0.5


def test_a_wall_beyond_the_horizon_is_not_run_into(monkeypatch):
    """Half a second of horizon, 1.3 s to stop: without its backup it would hit the wall."""
    problem = Problem(DoubleIntegrator(0.1), horizon=5, **KNOWN)
    wall = [ObstaclePrediction.static(5, [5.0, 0.0], 0.0, shape=BOX)]
    given = problem, [0.0, 0, 0, 0], [9.0, 0, 0, 0], wall, 60
    plans, states = drive(*given)
    assert all(plan.ok for plan in plans)
    assert states[:, 0].max() < 4.9 - 0.3 + 1e-6
    assert np.abs(states[-1, 1]) < 1e-3
    assert states[-1, 0] > 3.5  # nor does it stay away
    monkeypatch.setattr(module.MPC, "_backed", lambda _self, plan, *_: (plan, None))
    plans, _ = drive(*given)
    assert not all(plan.ok for plan in plans)


def scene(seed):
    """A plan at speed among obstacles that move and grow."""
    rng = np.random.default_rng(seed)
    model = [DoubleIntegrator(0.1), Unicycle(0.1)][seed % 2]
    problem = Problem(model, horizon=8, max_obstacles=4, nodes_per_interval=2, **KNOWN)
    x = model.state(np.zeros(2), rng.uniform(-4, 4, 2))
    inputs = rng.uniform(-2, 2, (8, 2))
    states = [x]
    for u in inputs:
        states.append(model.step(states[-1], u))
    obstacles = []
    for j in range(4):
        line = rng.uniform(-6, 6, 2) + 0.1 * np.arange(9)[:, None] * rng.uniform(-1, 1, 2)
        Sigma = (0.01 + 0.005 * np.arange(9))[:, None, None] * np.diag(rng.uniform(0.2, 2, 2))
        shape = Polytope.box([0.4, 1.0]) if j == 0 else None
        obstacles.append(ObstaclePrediction(line, Sigma, rng.uniform(0.1, 0.5), shape=shape))
    return Backup(problem, 1e-6), np.array(states), inputs, obstacles


def test_who_is_far_or_not_near_is_never_met():
    """The quick answers err on the safe side of the full check."""
    far = near = blocked = 0
    for seed in range(60):
        backup, states, _, obstacles = scene(seed)
        stop, path = backup.stopping(states[-1])
        full = Backup(backup._problem, 1e-6)
        full._near = lambda _path, given, _stage: list(range(len(given)))
        clear = full.is_clear(path, stop, obstacles, 8)
        assert backup.is_clear(path, stop, obstacles, 8) == clear
        is_far = backup._is_far(states[-2:, backup._problem.model.position], obstacles)
        assert clear or not is_far
        far, near, blocked = far + is_far, near + clear, blocked + (not clear)
    assert min(far, near, blocked) >= 3


def test_a_backup_is_the_plan_or_a_head_of_it():
    lengths = set()
    for seed in range(60):
        backup, states, inputs, obstacles = scene(seed)
        known = backup.of(states, inputs, obstacles)
        if known is not None:
            np.testing.assert_array_equal(known, inputs[1 : 1 + len(known)])
        lengths.add(None if known is None else len(known))
    assert {None, 7} < lengths <= {None, 0, 1, 3, 7}


def test_its_time_counts(monkeypatch):
    """In `plan.timing.total`, from which `overruns` are counted."""
    problem = Problem(DoubleIntegrator(0.1), horizon=8, max_obstacles=1, **KNOWN)
    walls = [ObstaclePrediction.static(8, [3.0, 0.0], 0.0, shape=BOX)]
    monkeypatch.setattr(Backup, "of", lambda *_: time.sleep(0.05))
    assert MPC(problem).step(np.zeros(4), np.zeros(4), walls).timing.total >= 0.05


@pytest.mark.parametrize("moving", [False, True], ids=["standing", "moving"])
@pytest.mark.parametrize("seed", [1, 2])
def test_ok_never_turns_into_not_ok(seed, moving):
    _keeps_its_promise(seed, moving)


@pytest.mark.slow
@pytest.mark.parametrize("moving", [False, True], ids=["standing", "moving"])
def test_ok_never_turns_into_not_ok_in_many_worlds(moving):
    for seed in range(10, 30):
        _keeps_its_promise(seed, moving)


def _keeps_its_promise(seed, moving):
    row = episode(seed, moving)
    assert row["first_ok"] is not None, seed
    assert not row["not_ok"], seed
    assert row["contact"] is None, seed


@pytest.mark.parametrize("solver", ["osqp", pytest.param("native", marks=needs_core)])
@pytest.mark.parametrize("limit", ["wall", "wall and speed"])
@pytest.mark.parametrize("model", [DoubleIntegrator(0.1), Unicycle(0.1)], ids=["point", "car"])
def test_a_robot_stops_at_the_end_of_its_room(model, limit, solver):
    """Its horizon is shorter than what braking takes, and nothing else is there."""
    speed = 1.5 if limit != "wall" else None
    room = {"x_max": [3.0, np.inf, np.inf, np.inf], "speed_max": speed}
    problem = Problem(model, horizon=8, **{**KNOWN, **room})
    mpc, x = MPC(problem, Settings(deadline=None, solver=solver)), np.zeros(4)
    for _ in range(60):
        plan = mpc.step(x, model.state(np.array([9.0, 0.0]), np.zeros(2)))
        assert plan.ok
        x = model.step(x, plan.u0)
        assert x[0] <= 3.0 + 1e-6
    assert x[0] > 2.9
