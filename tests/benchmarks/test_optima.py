"""The benchmark of optima: its rows, its tables, and in the slow tier what it promises."""

import numpy as np
import pytest

from benchmarks.optima import _past as past
from benchmarks.optima import (
    goal,
    judged,
    markdown,
    robot,
    summarise_goals,
    summarise_plans,
    weights,
)
from scp_mpc import SCP
from scp_mpc.models import Unicycle


def test_tables_say_what_the_rows_say():
    row = goal(0)
    assert row["good"]
    lost = row | {"away": 2.0, "good": False}
    (total,) = summarise_goals([row, lost])
    assert (total["episodes"], total["good"], total["worst"]) == (2, 1, 2.0)
    assert "1 (50.0 %)" in markdown([total])
    row = weights(1, starts=2)
    assert row["good"]
    far = row | {"gap": 0.3, "good": False}
    (total,) = summarise_plans([row, far])
    assert (total["episodes"], total["good"], total["far"], total["worst"]) == (2, 1, 1, 0.3)
    assert "| 30.0% |" in markdown([total])


def test_a_plan_that_stands_for_ever_is_found_out(monkeypatch):
    """IPOPT's random starts turn the unicycle; a solver that starts from rest alone does not."""
    model = Unicycle(0.1)
    problem = past(model, 15, [1, 1, 0, 0.05], [0.02] * 2, [-2, -2], [2, 2], 1)
    x_ref = np.tile([-1.0, 0.0, 0.0, 0.0], (16, 1))
    given = problem, np.zeros(4), x_ref, []

    class Standing(SCP):
        """Never moves."""

        def solve(self, x0, x_ref, _):
            return self.brake(x0, x_ref)

    assert judged(*given, 4, np.random.default_rng(0))["good"]
    monkeypatch.setattr("benchmarks.optima.SCP", Standing)
    assert not judged(*given, 4, np.random.default_rng(0))["good"]


@pytest.mark.slow
def test_robots_arrive_and_plans_are_near_the_best_known():
    goals = [goal(seed) for seed in range(40)]
    assert sum(row["good"] for row in goals) >= 39
    for rows in ([robot(seed, 8) for seed in range(32)], [weights(seed, 8) for seed in range(20)]):
        assert sum(row["good"] for row in rows) >= 0.9 * len(rows)
        assert max(row["residual"] for row in rows) < 1e-5
