import json
import logging
import os
import sys

import numpy as np
import pytest

from benchmarks import horizon_timing
from benchmarks.attempts import Attempts, rows
from benchmarks.horizon_timing import main, measure
from benchmarks.peers import (
    Ipopt,
    Ours,
    PeerMissingError,
    PeerPlan,
    Slsqp,
    largest_violation,
)
from benchmarks.processes import in_one_thread
from benchmarks.recorded import record
from scp_mpc import (
    MPC,
    SCP,
    DoubleIntegrator,
    InvalidArgumentError,
    Margin,
    ObstaclePrediction,
    Problem,
    Settings,
)
from scp_mpc.simulation import SCENARIOS
from scp_mpc.trajectory import rollout

KEYS = {
    "solver",
    "horizon",
    "obstacles",
    "steps",
    "every",
    "median_ms",
    "p99_ms",
    "max_ms",
    "ratio",
    "max_cost_gap",
    "max_violation",
    "failures",
    "programs",
}
OTHERS = {"fatrop", "sqp-qrqp", "sqp-hpipm", "sqp-osqp"}
SOLVERS = [
    "scp_mpc",
    "scp_mpc, one start",
    "scp_mpc, piqp",
    "ipopt",
    "fatrop",
    "sqp-qrqp",
    "sqp-hpipm",
    "sqp-osqp",
    "slsqp",
]


def easy(inflation="exact", dim=2, horizon=6, **changes):
    """A robot that moves along x and grazes an obstacle that stands beside its path."""
    problem = Problem(
        model=DoubleIntegrator(dt=0.2, dim=dim),
        horizon=horizon,
        Q=[1.0, 0.1] * dim,
        Qf=[3.0, 0.5] * dim,
        R=[0.01] * dim,
        u_min=-3.0,
        u_max=3.0,
        robot_radius=0.15,
        inflation=inflation,
        max_obstacles=2,
        **{"nodes_per_interval": 1, **changes},
    )
    x_ref = np.zeros((horizon + 1, 2 * dim))
    x_ref[:, 0], x_ref[:, 1] = 0.4 * np.arange(horizon + 1), 2.0
    mean = np.zeros(dim)
    mean[:2] = 1.3, 0.6
    spread = 0.02 * np.eye(dim)
    spread[0, 1] = spread[1, 0] = 0.012
    obstacle = ObstaclePrediction(np.tile(mean, (horizon + 1, 1)), spread, radius=0.2)
    return problem, (x_ref[0], x_ref, [obstacle])


def solved(problem, step):
    """Our plan from the plan that ignores the obstacle, and that guess."""
    solver = SCP(problem, Settings(max_iterations=200, multi_start=False))
    free = solver.solve(*step[:2])
    plan = solver.solve(*step, guess=free.iterate)
    assert plan.ok
    assert plan.cost > 1.05 * free.cost  # the obstacle matters
    return plan, free.iterate


@pytest.mark.parametrize(("inflation", "dim"), [("exact", 2), ("axes", 2), ("axes", 3)])
def test_ipopt_agrees_and_is_silent(inflation, dim, capfd):
    problem, step = easy(inflation, dim)
    plan, guess = solved(problem, step)
    peer = Ipopt(problem).solve(*step, guess)
    assert peer.ok, peer.message
    assert peer.cost == pytest.approx(plan.cost, rel=1e-5)
    assert peer.violation < 1e-7
    assert peer.s.shape == (1,)
    np.testing.assert_allclose(peer.U, plan.U, atol=1e-3)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("inflation", ["exact", "axes"])
def test_slsqp_agrees(inflation):
    problem, step = easy(inflation)
    plan, guess = solved(problem, step)
    peer = Slsqp(problem).solve(*step, guess)
    assert peer.ok, peer.message
    assert peer.cost == pytest.approx(plan.cost, rel=1e-3)
    assert peer.violation < 1e-6


@pytest.mark.parametrize("peer", [Ipopt, Slsqp, Ours])
def test_peers_without_obstacles_find_the_free_plan(peer):
    problem, (x0, x_ref, _) = easy()
    free = SCP(problem).solve(x0, x_ref)
    away = rollout(problem.model.step, x0, np.ones((problem.horizon, 2)))
    plan = peer(problem).solve(x0, x_ref, [], away)
    assert plan.ok
    assert plan.cost == pytest.approx(free.cost, abs=1e-4)
    assert plan.s.shape == (0,)


@pytest.mark.parametrize("inflation", ["exact", "axes"])
def test_ipopt_sizes_the_margin(inflation):
    """A smaller s is worth its price where s_min allows it; ours and IPOPT's s agree."""
    margin = Margin(lower=0.5, weight=1e-3)
    problem, step = easy(inflation, margin=margin)
    plan, guess = solved(problem, step)
    peer = Ipopt(problem).solve(*step, guess)
    assert margin.lower + 0.1 < plan.s[0] < margin.reference - 0.1
    np.testing.assert_allclose(peer.s, plan.s, atol=1e-3)


def test_ipopt_survives_a_certain_obstacle():
    """Sigma = 0 leaves a disc, where the root of n'Sigma n has no derivative."""
    problem, (x0, x_ref, (obstacle,)) = easy()
    disc = ObstaclePrediction(obstacle.means, np.zeros((2, 2)), radius=0.6)
    plan, guess = solved(problem, (x0, x_ref, [disc]))
    peer = Ipopt(problem).solve(x0, x_ref, [disc], guess)
    assert peer.ok, peer.message
    assert peer.cost == pytest.approx(plan.cost, rel=1e-5)


@pytest.mark.parametrize("peer", [Ipopt, Slsqp])
def test_peers_own_up_to_failure(peer):
    """A robot at the obstacle's centre is inside at stage 1, whatever it does."""
    problem, (x0, x_ref, _) = easy(horizon=5)
    on_top = ObstaclePrediction(x_ref[:, ::2], np.eye(2), radius=0.2)
    guess = SCP(problem).solve(x0, x_ref).iterate
    plan = peer(problem).solve(x0, x_ref, [on_top], guess)
    assert not plan.ok
    assert plan.violation > 0.1


def test_exact_in_space_is_refused():
    with pytest.raises(InvalidArgumentError, match="planar"):
        Ipopt(easy("exact", dim=3)[0])


def test_missing_casadi_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "casadi", None)
    with pytest.raises(PeerMissingError, match=r"casadi .* extra 'peers'"):
        Ipopt(easy()[0])


class TestViolation:
    def test_none(self):
        problem, step = easy()
        plan, _ = solved(problem, step)
        x0, _, obstacles = step
        assert largest_violation(problem, x0, obstacles, plan.X, plan.U, plan.s) < 1e-7

    def test_defect_and_wrong_start(self):
        problem, (x0, _, _) = easy()
        U = np.zeros((problem.horizon, 2))
        X = rollout(problem.model.step, x0, U).states
        bent = X.copy()
        bent[3, 1] += 0.01
        no_pairs = np.zeros(0)
        assert largest_violation(problem, x0, [], X, U, no_pairs) == 0
        assert largest_violation(problem, x0, [], bent, U, no_pairs) == pytest.approx(0.01)
        assert largest_violation(problem, x0 + 0.3, [], X, U, no_pairs) == pytest.approx(0.3)

    @pytest.mark.parametrize("sign", [1, -1])
    def test_input_bound(self, sign):
        problem, (x0, _, _) = easy()
        U = np.zeros((problem.horizon, 2))
        U[2, 1] = 3.5 * sign
        X = rollout(problem.model.step, x0, U).states
        assert largest_violation(problem, x0, [], X, U, np.zeros(0)) == pytest.approx(0.5)

    @pytest.mark.parametrize(("s", "expected"), [(10.25, 0.25), (5.991**0.5 - 0.1, 0.1)])
    def test_size_bound(self, s, expected):
        problem, (x0, _, _) = easy()
        U = np.zeros((problem.horizon, 2))
        X = rollout(problem.model.step, x0, U).states
        far = ObstaclePrediction(np.full((problem.horizon + 1, 2), 99.0), np.eye(2), radius=0.2)
        found = largest_violation(problem, x0, [far], X, U, np.array([s]))
        assert found == pytest.approx(expected)

    def test_point_inside(self):
        problem, (x0, _, _) = easy()
        U = np.zeros((problem.horizon, 2))
        X = rollout(problem.model.step, x0, U).states
        means = np.full((problem.horizon + 1, 2), 50.0)
        means[4] = X[4, ::2]  # at one stage only, and dead on the centre
        obstacle = ObstaclePrediction(means, 0.09 * np.eye(2), radius=0.2)
        found = largest_violation(problem, x0, [obstacle], X, U, np.array([3.0]))
        assert found == pytest.approx(3.0 * 0.3 + 0.35)

    def test_nan(self):
        problem, (x0, _, _) = easy()
        X, U = np.zeros((problem.horizon + 1, 4)), np.zeros((problem.horizon, 2))
        U[1, 0] = np.nan
        assert largest_violation(problem, x0, [], X, U, np.zeros(0)) == np.inf


def test_recorded_sequence_depends_on_the_seed_alone():
    scenario = SCENARIOS["scenario-3"]
    first, again, other = (record(scenario, 4, seed) for seed in (7, 7, 8))
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.x0, b.x0)
        np.testing.assert_array_equal(a.guess.states, b.guess.states)
        np.testing.assert_array_equal(a.obstacles[0].means, b.obstacles[0].means)
    assert not np.array_equal(first[-1].x0, other[-1].x0)


def test_recorded_guess_is_the_controllers_nominal():
    scenario = SCENARIOS["scenario-2"]
    mpc = MPC(scenario.problem())
    for k, step in enumerate(record(scenario, 3)):
        if k:
            np.testing.assert_array_equal(step.guess.states, mpc.nominal().states)
        mpc.step(step.x0, step.x_ref, step.obstacles)


def made_up(cost, violation=0.0, ok=True, seconds=0.01):
    nothing = np.zeros(0)
    return PeerPlan(nothing, nothing, nothing, cost, violation, seconds, ok, "")


def test_rows_by_hand():
    """Cheap plans that are infeasible or disowned set no standard."""
    a = Attempts("a", 8, 1, 3, {0: made_up(2.0), 1: made_up(1.0, violation=1e-4), 2: made_up(3.0)})
    b = Attempts("b", 8, 1, 2, {0: made_up(2.5, seconds=0.03), 2: made_up(0.1, ok=False)})
    first, second = rows([a, b])
    assert (first["failures"], second["failures"]) == (1, 1)
    assert first["max_cost_gap"] == 0
    assert second["max_cost_gap"] == pytest.approx(0.25)
    assert first["max_violation"] == 1e-4
    assert (second["median_ms"], second["max_ms"]) == (pytest.approx(20), pytest.approx(30))


def test_rows_of_a_tiny_run():
    table = rows(measure(SCENARIOS["scenario-2"], steps=3))
    assert [row["solver"] for row in table] == SOLVERS
    for row in table:
        assert row.keys() == KEYS
        assert (row["horizon"], row["obstacles"], row["steps"]) == (8, 1, 3)
        if row["solver"] not in OTHERS:  # not ours to promise
            assert row["failures"] == 0
        assert 0 < row["median_ms"] <= row["p99_ms"] <= row["max_ms"]
        if row["solver"] not in OTHERS:
            assert 0 <= row["max_cost_gap"] < 0.01
            assert row["max_violation"] < 1e-6


def test_slsqp_skips_steps_at_long_horizons(monkeypatch):
    monkeypatch.setattr(horizon_timing, "_SHORT", 7)
    contest = measure(SCENARIOS["scenario-2"], steps=4, slow_steps=2)
    seen = {a.solver: list(a.plans) for a in contest}
    assert seen["slsqp"] == [0, 2]
    assert seen["ipopt"] == seen["scp_mpc"] == seen["fatrop"] == [0, 1, 2, 3]
    assert {row["solver"]: row["steps"] for row in rows(contest)}["slsqp"] == 2


def test_missing_casadi_keeps_its_row(monkeypatch, tmp_path, caplog):
    monkeypatch.setitem(sys.modules, "casadi", None)
    monkeypatch.setattr(horizon_timing, "_SCENARIOS", (SCENARIOS["scenario-2"],))
    # A new process would not know that casadi is gone.
    monkeypatch.setattr(horizon_timing, "in_one_thread", lambda task, *given: task(*given))
    echoed = []
    with caplog.at_level(logging.WARNING):
        main(tmp_path / "deep" / "out", 2, 0, echo=echoed.append)
    assert "casadi is not installed" in caplog.text
    assert "ipopt is not installed: N = 8 is empty" in caplog.text
    content = json.loads((tmp_path / "deep" / "out" / "horizon_timing.json").read_text())
    table = {row["solver"]: row for row in content["rows"]}
    ours, ipopt = table["scp_mpc"], table["ipopt"]
    assert ipopt == dict.fromkeys(KEYS) | {
        "solver": "ipopt",
        "horizon": 8,
        "obstacles": 1,
        "steps": 2,
        "every": 1,
        "failures": 2,
    }
    assert ours["failures"] == 0
    assert {"machine", "cores", "python", "numpy", "osqp", "casadi", "commit", "date"} <= set(
        content["provenance"]
    )
    assert echoed == [(tmp_path / "deep" / "out" / "horizon_timing.md").read_text().rstrip("\n")]
    assert "| ipopt | 8 | 1 | 2 | n/a |" in echoed[0]
    assert (tmp_path / "deep" / "out" / "horizon_timing.png").read_bytes().startswith(b"\x89PNG")


def test_library_prints_nothing(monkeypatch, capfd, tmp_path):
    monkeypatch.setattr(horizon_timing, "_SCENARIOS", (SCENARIOS["scenario-2"],))
    echoed = []
    main(tmp_path, steps=1, seed=0, echo=echoed.append)
    assert len(echoed) == 1
    assert "| ipopt | 8 | 1 | 1 |" in echoed[0]
    assert capfd.readouterr() == ("", "")


def test_one_thread_leaves_the_environment_as_it_was(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    assert in_one_thread(os.getenv, "OMP_NUM_THREADS") == "1"
    assert in_one_thread(os.getenv, "MKL_NUM_THREADS") == "1"
    assert os.getenv("OMP_NUM_THREADS") == "3"
    assert os.getenv("MKL_NUM_THREADS") is None
