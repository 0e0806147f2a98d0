"""Plans among boxes against the optimum of the mixed-integer program, which SCIP proves."""

import numpy as np
import pytest
from instances import DT, problem, straight_reference

from scp_mpc import SCP, Settings, Status
from scp_mpc.obstacles import Polytope

pytest.importorskip("pyscipopt", reason="SCIP has no wheel for this machine")

from mixed_integer import bounds

SEEDS = range(8)
QUICK = [0, 1, 2, 4, 5, 6]  # proofs of optimality take SCIP a second or two for the others
CLOSE = 1e-3  # relative: the lead that a rival needs to be preferred


def world(seed):
    """A robot that is a point, at about 2 m/s, and one to three boxes in its way."""
    rng = np.random.default_rng([7, seed])
    horizon, count = int(rng.integers(5, 8)), int(rng.integers(1, 4))
    x0 = np.array([0, rng.uniform(1.5, 2.2), rng.uniform(-0.1, 0.1), rng.uniform(-0.3, 0.3)])
    boxes = []
    while len(boxes) < count:
        box = Polytope.box(rng.uniform(0.3, 1.2, 2), angle=rng.uniform(0, np.pi))
        at = np.array([rng.uniform(0.9, 2 * DT * horizon + 0.3), rng.uniform(-0.6, 0.6)])
        if (box.normals @ (x0[[0, 2]] - at) - box.offsets).max() > 0.25:
            boxes.append(box.static(horizon, at))
    case = problem(horizon, max_obstacles=count, robot_radius=0.0)
    return case, x0, straight_reference(horizon), boxes


@pytest.fixture(
    scope="module",
    params=[QUICK, pytest.param(SEEDS, marks=pytest.mark.slow)],
    ids=["quick", "all"],
)
def gaps(request):
    """How much more our plans cost than the least that SCIP allows for, relative."""
    found = []
    for seed in request.param:
        step = world(seed)
        plan = SCP(step[0]).solve(*step[1:])
        assert plan.status is Status.CONVERGED
        # Only plans that are better by more than `CLOSE` are looked for: that is quick.
        least = plan.cost * (1 - CLOSE)
        best, bound = bounds(*step, below=least)
        found.append(plan.cost / min(best, bound, least) - 1 if bound < least else 0.0)
    return np.array(found)


def test_most_plans_are_optimal(gaps):
    assert np.median(gaps) == 0.0
    assert (gaps <= CLOSE).mean() >= 0.9
    assert gaps.max() < 0.2


@pytest.mark.parametrize("seed", [2, 4, 6, pytest.param(0, marks=pytest.mark.slow)])
def test_no_plan_is_better_than_the_optimum(seed):
    step = world(seed)
    plan = SCP(step[0]).solve(*step[1:])
    best, bound = bounds(*step)
    assert plan.cost >= bound * (1 - 1e-6)
    assert best >= bound * (1 - 1e-6)


def test_it_is_the_other_sides_that_find_it():
    """Without candidates some plans stay on the wrong side of a box."""
    steps = [world(seed) for seed in SEEDS]
    alone = [SCP(case, Settings(multi_start=False)).solve(*step) for case, *step in steps]
    both = [SCP(case).solve(*step) for case, *step in steps]
    worse = [a.cost > b.cost * 1.01 or not a.ok for a, b in zip(alone, both, strict=True)]
    assert np.mean(worse) >= 0.25
