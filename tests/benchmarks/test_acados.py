"""acados as a peer: the same plans as IPOPT and as our own loop; none of it where it is missing."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.circuits import Circuit
from benchmarks.peers import Ipopt, Ours, PeerMissingError
from benchmarks.peers.acados import HOME, Acados, Installation, install
from benchmarks.recorded import record
from scp_mpc import InvalidArgumentError, Margin, Settings
from scp_mpc.simulation import SCENARIOS, Crowd
from scp_mpc.trajectory import Trajectory

SCENARIO = SCENARIOS["scenario-2"]


@pytest.fixture(scope="module")
def home(tmp_path_factory):
    """Where acados is, or is put for these tests."""
    try:
        Installation.find()
    except PeerMissingError:
        folder = tmp_path_factory.mktemp("acados")
        try:
            install(folder)
        except PeerMissingError as error:
            pytest.skip(str(error))
        return folder
    return HOME


@pytest.mark.slow
@pytest.mark.parametrize(
    ("inflation", "margin"),
    [("axes", None), ("exact", None), ("exact", Margin(lower=0.5, weight=1e-3))],
)
def test_acados_agrees_with_ipopt(home, inflation, margin):
    """Ellipses that are not round, with sizes that may give way, too."""
    problem = SCENARIO.problem(inflation, margin)
    acados, ipopt = Acados(problem, home=home), Ipopt(problem)
    shaped = 0
    for step in record(SCENARIO, 8, problem=problem):
        given = step.x0, step.x_ref, step.obstacles, step.guess
        mine, theirs = acados.solve(*given), ipopt.solve(*given)
        assert mine.ok, mine.message
        assert theirs.ok, theirs.message
        assert mine.violation < 1e-6
        assert mine.cost == pytest.approx(theirs.cost, rel=1e-5)
        np.testing.assert_allclose(mine.U, theirs.U, atol=1e-3)
        np.testing.assert_allclose(mine.s, theirs.s, atol=1e-3)
        shaped += mine.cost > 0.1
    assert shaped > 2


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["unicycle", "bicycle"])
def test_our_loop_stays_at_acados_plans_for_robots_that_turn(home, robot):
    world = Circuit(robot, 12, 2)
    problem = replace(world.problem, nodes_per_interval=1)
    acados, ours = Acados(problem, home=home), Ours(problem, Settings(multi_start=False))
    x, costs = world.start(), []
    guess = Trajectory(world.x_ref(0.0), np.zeros((12, 2)))
    for k in range(12):
        given = x, world.x_ref(0.2 * k), world.predictions(0.2 * k, 0.2, 12)
        mine = acados.solve(*given, guess)
        guess = Trajectory(mine.X, mine.U)
        theirs = ours.solve(*given, guess)
        assert mine.ok, mine.message
        assert mine.violation < 1e-6
        assert mine.cost == pytest.approx(theirs.cost, rel=1e-5, abs=1e-7)
        np.testing.assert_allclose(mine.U, theirs.U, atol=1e-3)
        x = problem.model.step(x, mine.U[0])
        costs.append(mine.cost)
    assert max(costs) > 0.1  # an obstacle matters


@pytest.mark.slow
def test_the_lean_way_shifts_the_last_plan(home):
    """`step` is `solve` from the last plan shifted, and starts anew after `reset`."""
    world = Crowd(8, 2)
    problem = world.problem("axes")
    lean, plain = Acados(problem, home=home), Acados(problem, home=home)
    x, guess = world.start(), Trajectory(world.x_ref(0.0), np.zeros((8, 2)))
    first = None
    for k in range(5):
        told, x_ref = world.predictions(0.2 * k, 0.2, 8), world.x_ref(0.2 * k)
        arrays = (
            np.array([one.means for one in told]),
            np.array([one.covariances for one in told]),
            np.array([one.radius for one in told]),
        )
        assert lean.step(x, x_ref, *arrays) == 0
        plan = plain.solve(x, x_ref, told, guess)
        np.testing.assert_allclose(lean.U, plan.U, atol=1e-9)
        np.testing.assert_allclose(lean.X, plan.X, atol=1e-9)
        first = (x, x_ref, arrays, lean.U.copy()) if first is None else first
        end = problem.model.step(plan.X[-1], plan.U[-1])
        guess = Trajectory(np.vstack([plan.X[1:], end]), np.vstack([plan.U[1:], plan.U[-1:]]))
        x = problem.model.step(x, plan.U[0])
    lean.reset()
    x, x_ref, arrays, U = first
    lean.step(x, x_ref, *arrays)
    np.testing.assert_array_equal(lean.U, U)


def test_missing_acados_says_how_to_get_it(monkeypatch, tmp_path):
    monkeypatch.delenv("ACADOS_SOURCE_DIR", raising=False)
    with pytest.raises(PeerMissingError, match=r"python -m benchmarks\.peers\.acados"):
        Acados(SCENARIO.problem("axes"), home=tmp_path)


@pytest.mark.parametrize(
    ("change", "name"),
    [
        ({"nodes_per_interval": 4}, "nodes_per_interval"),
        ({"speed_max": 3.0}, "speed_max"),
        ({"du_max": 1.0}, "du_max"),
        ({"x_min": -9.0, "x_soft": True}, "x_soft"),
    ],
)
def test_what_acados_is_not_told_of_is_refused(change, name):
    with pytest.raises(InvalidArgumentError, match=f"problem.{name}"):
        Acados(replace(SCENARIO.problem("axes"), **change))
