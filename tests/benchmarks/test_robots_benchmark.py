"""The benchmark of all robots: worlds, clearances and a tiny run."""

import numpy as np
import pytest

from benchmarks import robots
from benchmarks.circuits import CIRCLING, Circuit


@pytest.mark.parametrize("robot", CIRCLING)
def test_references_move_as_their_velocities_say(robot):
    circuit = Circuit(robot, 8, 3)
    model, x = circuit.problem.model, circuit.x_ref(4 * circuit.problem.model.dt)
    p = x[:, model.position]
    np.testing.assert_allclose(np.linalg.norm(p, axis=1), 8.0)
    np.testing.assert_allclose(x[1:], Circuit(robot, 8, 3).x_ref(5 * model.dt)[:-1], atol=1e-12)
    chords = np.diff(p, axis=0) / model.dt
    drift = (
        model.advance(x, np.tile(model.equilibrium_input, (9, 1)), 1e-4)[:, model.position] - p
    ) / (1e-4 * model.dt)
    np.testing.assert_allclose((drift[1:] + drift[:-1]) / 2, chords, atol=0.05)


def test_obstacles_are_seeded_and_predicted_as_they_move():
    first, again = (Circuit("double integrator 3-D", 30, 12) for _ in range(2))
    other = Circuit("double integrator 3-D", 30, 12, seed=1)
    here, later = first.predictions(0.0, 0.2, 30), again.predictions(0.4, 0.2, 30)
    assert len(here) == 12
    np.testing.assert_allclose(here[3].means[2:], later[3].means[:-2])
    assert not np.allclose(other.predictions(0.0, 0.2, 30)[3].means, here[3].means)
    assert (np.linalg.eigvalsh(here[3].covariances) > 0.004).all()


def test_clearance_is_between_surfaces():
    course = robots.Course("unicycle", Circuit("unicycle", 30, 5))
    body = course.world.bodies[0]
    at = np.array([body.at(t) for t in 0.2 * (3 + np.linspace(0.0, 1.0, 5))])
    assert course.clearance(3, at) == pytest.approx(-0.35)
    assert course.clearance(3, at + [0.0, 0.5]) == pytest.approx(0.15)


def test_a_tiny_run_is_counted_and_drawn():
    courses = [robots.COURSES[0], robots.Course("unicycle", Circuit("unicycle", 8, 2), 4)]
    table = robots.rows(3, courses)
    assert [row["multi_start"] for row in table] == [True, False] * 2
    assert table[0]["thread_median_ratio"] == table[0]["wall_p99_ratio"] == 1.0
    for row in table:
        assert sum(row["statuses"].values()) == row["steps"] == 3
        assert 0 < row["wall"]["median"] <= row["wall"]["p99"] <= row["wall"]["max"]
        assert row["clearance"] > 0
    assert robots.markdown(table).count("\n") == 1 + len(table)
    assert len(robots.figure(table).axes) == 1
