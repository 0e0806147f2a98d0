"""The benchmark of users' models: one robot, whoever gives it, and a tiny run."""

import numpy as np
import pytest

from benchmarks import user_models
from benchmarks.circuits import Circuit


@pytest.mark.parametrize("way", user_models.WAYS)
def test_all_ways_give_the_same_robot(way):
    model, own = user_models.WAYS[way](), user_models.WAYS["built in"]()
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=(5, 4)), 0.5 * rng.normal(size=(5, 2))
    found, expected = model.linearise(x, u), own.linearise(x, u)
    for part in ("after", "A", "B"):
        np.testing.assert_allclose(getattr(found, part), getattr(expected, part), atol=1e-5)


def test_a_tiny_run_is_relative_to_the_built_in_robot():
    worlds = {"near": Circuit("unicycle", 8, 2)}
    ways = dict(list(user_models.WAYS.items())[:3])
    found = user_models.rows(3, worlds, ways)
    assert [row["way"] for row in found] == list(ways)
    assert found[0]["median_ratio"] == found[0]["cost_ratio"] == 1.0
    for row in found:
        assert row["cost_ratio"] == pytest.approx(1.0, rel=1e-3)
        assert row["median_ratio"] == row["thread"]["median"] / found[0]["thread"]["median"]
    assert user_models.markdown(found).count("\n") == 1 + len(found)
