"""The benchmarks beyond the horizon: staged peers, crowds, scaling, optimality, QP solvers."""

import json

import numpy as np
import pytest

from benchmarks import optimality, programs, run, scaling
from benchmarks.peers import Ipopt, Staged
from benchmarks.recorded import record
from scp_mpc import MPC, InvalidArgumentError
from scp_mpc.simulation import SCENARIOS, Crowd


@pytest.mark.parametrize("solver", ["fatrop", "sqp-qrqp"])
def test_staged_solvers_agree_with_ipopt_on_the_same_side(solver):
    problem = SCENARIOS["scenario-2"].problem("axes")
    staged, referee = Staged(problem, solver), Ipopt(problem)
    for step in record(SCENARIOS["scenario-2"], 4, problem=problem):
        given = (step.x0, step.x_ref, step.obstacles, step.guess)
        mine, theirs = staged.solve(*given), referee.solve(*given)
        assert mine.violation < 1e-5
        assert mine.cost == pytest.approx(theirs.cost, rel=1e-5)
        np.testing.assert_array_equal(mine.X[0], step.x0)


def test_staged_solvers_refuse_what_they_cannot_solve():
    with pytest.raises(InvalidArgumentError, match="axes"):
        Staged(SCENARIOS["scenario-2"].problem("exact"), "fatrop")
    with pytest.raises(InvalidArgumentError, match="none of"):
        Staged(SCENARIOS["scenario-2"].problem("axes"), "simplex")


def test_crowds_go_both_ways_with_a_size_each():
    crowd = Crowd(30, 12)
    predictions = crowd.predictions(0.6, 0.2, 30)
    assert len(predictions) == 12
    speeds = np.sign([o.angular_velocity for o in crowd.obstacles])
    assert set(speeds) == {-1.0, 1.0}
    spread = predictions[0].largest_std
    assert (np.diff(spread) > 0).all()
    plan = MPC(crowd.problem()).step(crowd.start(), crowd.x_ref(0.0), predictions)
    assert plan.s.shape == (12,)
    long = Crowd(200, 2).predictions(0.0, 0.2, 200)[0]
    np.testing.assert_allclose(long.means[200], Crowd(200, 2).obstacles[0].position(40.0))


def test_scaling_counts_and_fits():
    table = scaling.rows(4, horizons=(30, 60), obstacles=(1, 2))
    assert len(table) == 2 * (2 + 4)
    for row in table:
        assert sum(row["statuses"].values()) == row["steps"] == 4
        assert 0 < row["median_ms"] <= row["p99_ms"] <= row["max_ms"]
    made_up = [
        {
            "world": "crowd",
            "multi_start": False,
            "horizon": N,
            "obstacles": M,
            "median_ms": N**1.5 * M**2,
        }
        for N in (8, 30, 60, 120)
        for M in (1, 5)
    ]
    assert scaling.exponents(made_up) == pytest.approx({"a": 1.5, "b": 2.0})
    assert scaling.markdown(table).count("\n") == 1 + len(table)
    figure = scaling.figure(table, scaling.exponents(table))
    assert len(figure.axes) == 2


def test_optimality_of_a_tiny_run():
    row = optimality.measure(SCENARIOS["scenario-2"], None, steps=8, starts=3, seed=0)
    assert row["active"] == row["within"] > 0
    assert row["worst"] < 1e-4
    assert "| 8 | 2.45 |" in optimality.markdown([row])


def test_programs_of_a_tiny_run():
    table = {row["solver"]: row for row in programs.rows(4)}
    assert tuple(table) == programs.SOLVERS
    osqp, piqp, clarabel = (table[name] for name in ("osqp", "piqp", "clarabel"))
    assert piqp["solved"] + piqp["none"] == piqp["programs"] == 8
    assert osqp["solved"] == piqp["solved"] > 2
    assert piqp["none"] == clarabel["none"]
    assert piqp["residual"] < programs.ACCURACY
    assert programs.markdown([piqp]).splitlines()[2].startswith("| piqp | 8 |")
    missing = [row for row in table.values() if row["ms"] is None]
    assert all("not installed" in programs.markdown([row]) for row in missing)


def test_the_runner_writes_what_it_shows(monkeypatch, tmp_path):
    monkeypatch.setattr(run, "in_one_thread", lambda task, *given: task(*given))
    monkeypatch.setattr(scaling, "HORIZONS", (8,))
    monkeypatch.setattr(programs, "recorded", lambda steps: programs_of(steps))
    shown = []
    run.run("programs", tmp_path, 2, 0, shown.append)
    assert (tmp_path / "programs.md").read_text().rstrip("\n") == shown[0]
    numbers = json.loads((tmp_path / "programs.json").read_text())
    assert {"rows", "provenance"} <= set(numbers)


recorded = programs.recorded


def programs_of(steps):
    return recorded(steps)[:1] * 5
