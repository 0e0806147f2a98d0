"""What is far ahead is planned again: covariances that count up to some time ahead only."""

import numpy as np
import pytest
from instances import problem, straight_reference

from scp_mpc import (
    SCP,
    BoundsError,
    Containment,
    InvalidArgumentError,
    JointRisk,
    ObstaclePrediction,
    StageRisk,
    Status,
)

N, DT = 20, 0.2


def person(at=(3.0, 0.3), growth=0.04, seed=0):
    """Known to 4 cm now, to some 0.9 m at the horizon, in two directions of its own."""
    rng = np.random.default_rng(seed)
    R = np.linalg.qr(rng.normal(size=(2, 2)))[0]
    Sigma = [R @ np.diag([0.0016 + growth * i, 0.0016 + 0.5 * growth * i]) @ R.T for i in range(21)]
    return ObstaclePrediction(np.tile(at, (N + 1, 1)), Sigma, 0.2)


def capped(o, last):
    rows = np.minimum(np.arange(N + 1), last)
    return ObstaclePrediction(o.means, o.covariances[rows], o.radius)


@pytest.mark.parametrize("nodes", [1, 3])
@pytest.mark.parametrize("seed", range(1, 3))
def test_the_plan_is_that_of_predictions_that_stop_growing(seed, nodes):
    given = {"max_obstacles": 2, "margin": Containment(0.95), "nodes_per_interval": nodes}
    things = [person(seed=seed), person((1.5, -0.9), 0.02, seed + 9)]
    ref = straight_reference(N, 1.0)
    plan = SCP(problem(N, growth_time=1.2, **given)).solve(ref[0], ref, things)
    slow = SCP(problem(N, **given)).solve(ref[0], ref, [capped(o, 6) for o in things])
    assert plan.status is slow.status is Status.CONVERGED
    np.testing.assert_allclose(plan.U, slow.U, atol=1e-9)
    whole = SCP(problem(N, **given)).solve(ref[0], ref, things)
    assert plan.cost < whole.cost


def test_a_prediction_that_shrinks_keeps_what_it_knows():
    Sigma = [(0.5 - 0.02 * i) * np.eye(2) for i in range(N + 1)]
    known = ObstaclePrediction(np.tile([3.0, 0.3], (N + 1, 1)), Sigma, 0.2)
    ref = straight_reference(N, 1.0)
    plans = [
        SCP(problem(N, margin=Containment(0.95), growth_time=t)).solve(ref[0], ref, [known])
        for t in (None, 0.6)
    ]
    np.testing.assert_array_equal(plans[0].U, plans[1].U)


def test_the_risk_that_a_plan_tells_is_that_of_the_whole_prediction():
    ref = straight_reference(N, 1.0)
    calm = SCP(problem(N, margin=Containment(0.95), growth_time=0.6)).solve(ref[0], ref, [person()])
    told = SCP(problem(N, margin=Containment(0.95)))
    judged = told.follow(ref[0], ref, [person()], calm.U)
    np.testing.assert_allclose(calm.risk.stages, judged.risk.stages, rtol=1e-9)
    assert calm.risk.joint > 0.05


def test_bad_times_are_refused_and_so_is_breaking_a_promise():
    for time, error in ((0.0, BoundsError), (-1.0, BoundsError), ("long", InvalidArgumentError)):
        with pytest.raises(error, match="growth_time"):
            problem(N, growth_time=time)
    for margin in (StageRisk(0.05), JointRisk(0.05)):
        with pytest.raises(InvalidArgumentError, match="would break"):
            problem(N, margin=margin, growth_time=1.0)
