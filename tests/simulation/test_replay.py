"""Replay: the robot's way through a recorded crowd, and who it touched."""

import numpy as np
import pytest
from recordings import street

from scp_mpc import DoubleIntegrator, Problem, Status
from scp_mpc.errors import BoundsError, InvalidArgumentError
from scp_mpc.report import replay_table, summarise_replay
from scp_mpc.report.replay_animation import animated_steps
from scp_mpc.report.replay_figure import nearest_clearance
from scp_mpc.simulation import (
    Crossing,
    Recording,
    control_steps,
    find_meetings,
    replay,
    replay_problem,
    robot_path,
)


@pytest.fixture(scope="module")
def run():
    return replay(street(people=4, frames=40, seed=2), Crossing([0, -5], [0, 5]))


def test_the_robot_crosses_and_touches_nobody(run):
    assert run.steps == 78
    done = [o for o in run.passes if o.reached]
    assert len(done) >= 1
    for one, after in zip(run.passes, run.passes[1:], strict=False):
        assert one.last == after.first
        assert np.linalg.norm(run.positions[one.last] - one.crossing.goal) <= 0.3
        assert np.array_equal(after.crossing.start, one.crossing.goal)
    assert run.passes[-1].last == run.steps
    meetings = find_meetings(run)
    assert not any(meeting.touched for meeting in meetings)
    assert meetings[0].clearance > 0
    assert set(run.statuses) <= {Status.CONVERGED, Status.FEASIBLE, Status.SOFTENED}
    assert 6 < run.alone < 12
    assert (np.abs(run.inputs) <= 3 + 1e-9).all()


def test_same_seed_same_run():
    recording = street(people=3, frames=10)
    one, again, other = (replay(recording, seed=seed) for seed in (3, 3, 4))
    assert np.array_equal(one.states, again.states)
    assert not np.array_equal(one.states, other.states)


def test_the_tracker_gets_noisy_measurements_as_they_come(run):
    """Predictions of a step know the frames up to it and no later ones."""
    people = run.people()
    k = 31
    for o in run.predictions[k]:
        assert o.stamp == pytest.approx(run.times[k])
        assert 0 < np.linalg.norm(o.means[0] - people[o.name][k]) < 0.4
        assert o.horizon == run.problem.horizon
    new = replay(street(people=4, frames=40, seed=2), Crossing([0, -5], [0, 5]), steps=32)
    assert np.array_equal(new.states, run.states[:33])


def test_meetings_are_those_of_a_fine_loop(run):
    path = robot_path(run.problem.model, run.states, run.inputs)
    people = run.people()
    for meeting in find_meetings(run):
        places, nearest = people[meeting.name], np.inf
        for k in range(run.steps):
            for fraction in np.linspace(0, 1, 33):
                person = (1 - fraction) * places[k] + fraction * places[k + 1]
                distance = np.linalg.norm(path[k, round(32 * fraction)] - person)
                if distance < nearest:  # never for NaN
                    nearest, at = distance, k
        assert meeting.clearance == pytest.approx(nearest - 0.6)
        assert meeting.step == at
    assert np.nanmin(nearest_clearance(run)) >= find_meetings(run)[0].clearance - 1e-9


def test_somebody_fast_is_touched_between_samples():
    """A runner who is on either side of the waiting robot at the samples, and through it."""
    times = np.arange(0, 2.1, 0.2)
    places = np.stack([20 * (times - 1.1), np.full(len(times), 0.05)], axis=1)
    recording = Recording.from_rows(times, np.zeros(len(times), np.intp), places)
    still = Problem(
        DoubleIntegrator(0.2), horizon=5, Q=[1, 1, 1, 1], R=[1, 1], u_min=0, u_max=0,
        robot_radius=0.1, max_obstacles=1, nodes_per_interval=1,
    )  # fmt: skip
    run = replay(recording, Crossing([0, 0], [0, 0.2]), still, radius=0.1)
    (meeting,) = find_meetings(run)
    assert meeting.touched
    assert meeting.clearance == pytest.approx(0.05 - 0.2)
    assert np.nanmin(nearest_clearance(run)) > 1.0
    assert meeting.speed == 0
    numbers = summarise_replay(run, [meeting])
    assert (numbers["contacts"], numbers["contacts_robot_slow"]) == (1, 1)


def test_courses_follow_the_flow():
    recording = street(people=8)
    along, across = (Crossing.through(recording, way) for way in ("along", "across"))
    assert abs(along.direction[1]) > 0.99
    assert abs(across.direction[0]) > 0.99
    back = along.reversed()
    assert np.array_equal(back.start, along.goal)
    assert back.speed == along.speed


def test_the_reference_waits_for_the_robot_and_ends_at_the_goal():
    crossing = Crossing([0, 0], [10, 0], speed=1.0)
    positions, velocities = crossing.reference(np.array([8.0, 3.0]), 5, 0.5)
    assert np.allclose(positions, [[x, 0] for x in (8, 8.5, 9, 9.5, 10, 10)])
    assert np.allclose(velocities, [[v, 0] for v in (1, 1, 1, 1, 0, 0)])
    positions, _ = crossing.reference(np.array([-3.0, 1.0]), 2, 0.5)
    assert np.allclose(positions, [[0, 0], [0.5, 0], [1, 0]])


def test_summary_and_table(run):
    meetings = find_meetings(run)
    numbers = summarise_replay(run, meetings)
    assert numbers["people"] == 4
    assert numbers["contacts"] == 0
    assert sum(numbers["statuses"].values()) == numbers["steps"] == 78
    assert numbers["pass_mean_s"] >= numbers["pass_alone_s"] - 1.0
    assert numbers["min_clearance_m"] == meetings[0].clearance
    assert 0 < numbers["furthest_beside_m"] < 5
    assert all(value for _, value in replay_table(numbers))
    steps = animated_steps(run)
    assert len(steps) == 78
    assert steps.stop <= run.steps


def test_nobody_near_and_no_pass_done():
    recording = street(people=1, frames=6)
    run = replay(recording, Crossing([50, 0], [50, 10]))
    assert [o.reached for o in run.passes] == [False]
    table = dict(replay_table(summarise_replay(run, find_meetings(run))))
    assert table["Time of a pass, mean; longest [s]"] == "none; none"


def test_bad_arguments_are_refused():
    recording = street(people=2, frames=6)
    spatial = Problem(
        DoubleIntegrator(0.2, 3), horizon=5, Q=np.ones(6), R=np.ones(3), u_min=-1, u_max=1
    )
    for values, error in (
        ({"noise": -1.0}, BoundsError),
        ({"seed": -1}, BoundsError),
        ({"steps": 0}, BoundsError),
        ({"radius": -1.0}, BoundsError),
        ({"problem": spatial}, InvalidArgumentError),
    ):
        with pytest.raises(error):
            replay(recording, **values)
    with pytest.raises(InvalidArgumentError, match="is where the robot starts"):
        Crossing([1, 1], [1, 1])
    with pytest.raises(BoundsError, match="speed"):
        Crossing([1, 1], [2, 1], speed=0)
    with pytest.raises(InvalidArgumentError, match="neither 'along' nor 'across'"):
        Crossing.through(recording, "round")
    one = Recording.from_rows(np.zeros(1), np.zeros(1, np.intp), np.zeros((1, 2)))
    with pytest.raises(InvalidArgumentError, match="nobody moves"):
        Crossing.through(one, "along")
    with pytest.raises(InvalidArgumentError, match="lasts less"):
        control_steps(one)
    assert replay_problem(horizon=7).horizon == 7
