"""Replay: the robot's way through a recorded crowd, and who it touched."""

from collections import Counter

import numpy as np
import pytest
from recordings import street

from scp_mpc import MPC, DoubleIntegrator, Problem, Status, Unicycle
from scp_mpc.errors import BoundsError, InvalidArgumentError
from scp_mpc.report import replay_figure, replay_table, summarise_replay
from scp_mpc.report.replay_picture import animated_steps
from scp_mpc.simulation.crossing import Crossing
from scp_mpc.simulation.events import find_contacts, find_meetings
from scp_mpc.simulation.recording import Recording
from scp_mpc.simulation.replay import control_steps, recorded_people, replay, replay_problem
from scp_mpc.simulation.scene import Scene
from scp_mpc.simulation.simulate import simulate
from scp_mpc.simulation.there_and_back import ThereAndBack, arrivals, time_alone


@pytest.fixture(scope="module")
def run():
    return replay(street(people=4, frames=40, seed=2), Crossing([0, -5], [0, 5]))


def test_the_robot_crosses_and_touches_nobody(run):
    assert run.steps == 78
    ends = arrivals(run)
    assert len(ends) >= 1
    for k, y in zip(ends, (5, -5, 5), strict=False):
        distances = np.linalg.norm(run.positions - [0, y], axis=1)
        assert distances[k] <= 0.3 < distances[k - 1]
        assert np.sign(np.array(run.references)[k:, -1, 2] - run.positions[k, 1])[0] == -np.sign(y)
    meetings = find_meetings(run)
    assert not any(meeting.touched for meeting in meetings)
    assert find_contacts(run) == []
    assert meetings[0].clearance == run.clearances.min() > 0
    statuses = Counter(plan.status for plan in run.plans)
    assert set(statuses) <= {Status.CONVERGED, Status.FEASIBLE, Status.STOPPING}
    assert statuses[Status.STOPPING] <= 0.05 * run.steps  # somebody came nearer than the room
    assert 6 < time_alone(run) < 12
    assert (np.abs(run.inputs) <= 3 + 1e-9).all()


def test_same_seed_same_run():
    recording = street(people=3, frames=10)
    one, again, other = (replay(recording, seed=seed) for seed in (3, 3, 4))
    assert np.array_equal(one.states, again.states)
    assert not np.array_equal(one.states, other.states)
    assert one.seed == 3


def test_people_are_where_they_were_recorded(run):
    """Bodies by name, straight between frames, on a clock that begins with the recording."""
    recording = street(people=4, frames=40, seed=2)
    late = Recording(recording.times + 7.3, recording.names, recording.positions)
    for people in (recorded_people(recording), recorded_people(late)):
        assert [body.name for body in people] == [0, 1, 2, 3]
        for k in range(0, 40, 3):
            places = dict(zip(recording.names[k].tolist(), recording.positions[k], strict=True))
            for body in people:
                wanted = places.get(body.name, [np.nan, np.nan])
                np.testing.assert_allclose(body.at(0.4 * k), wanted)
            if 2 * k <= run.steps:
                there = list(places)
                np.testing.assert_allclose(run.bodies[2 * k, there], recording.positions[k])
    crossing = Crossing([0, -5], [0, 5])
    np.testing.assert_allclose(replay(late, crossing, steps=20).states, run.states[:21], atol=1e-6)


def test_the_tracker_gets_noisy_measurements_as_they_come(run):
    """Predictions of a step know the frames up to it and no later ones."""
    k = 31
    for o in run.predictions[k]:
        assert o.stamp == pytest.approx(run.times[k])
        assert 0 < np.linalg.norm(o.means[0] - run.bodies[k, o.name]) < 0.4
        assert o.horizon == run.problem.horizon
    recording = street(people=4, frames=40, seed=2)
    seen = Recording(recording.times[:17], recording.names[:17], recording.positions[:17])
    new = replay(seen, Crossing([0, -5], [0, 5]))
    assert np.array_equal(new.states, run.states[:33])


def test_nobody_in_a_frame_is_no_silence():
    """Somebody leaves and somebody else comes 30 s later: nothing is told of in between."""
    times = np.concatenate([np.arange(0, 4, 0.4), np.arange(34, 36, 0.4)])
    who = np.where(times < 5, 1, 2)
    places = np.stack([1.2 * (times - 34 * (times > 5)) - 3.0, np.zeros(len(times))], axis=1)
    recording = Recording.from_rows(times, who, places)
    run = replay(recording, Crossing([0, -9], [0, -5]), replay_problem(horizon=5))
    told = np.array([len(there) for there in run.predictions])
    seconds = run.times[:-1]
    assert (told[(seconds > 3.6 + 1.5) & (seconds < 34)] == 0).all()
    assert (told[seconds <= 3.6 + 1.4] == 1).all()
    assert (told[seconds >= 34] == 1).all()


def test_all_are_told_of_and_who_is_left_out_is_counted():
    problem = replay_problem(horizon=5, max_obstacles=2)
    run = replay(street(people=5, frames=20), Crossing([0, -5], [0, 5]), problem)
    for told, plan, bodies in zip(run.predictions, run.plans, run.bodies, strict=False):
        there = np.flatnonzero(~np.isnan(bodies[:, 0]))
        assert {o.name for o in told} == set(there.tolist())
        assert plan.left_out == max(len(there) - 2, 0)
    numbers = summarise_replay(run)
    left_out = [plan.left_out for plan in run.plans]
    assert numbers["left_out_steps"] == np.count_nonzero(left_out) > 0
    assert numbers["most_left_out"] == max(left_out) == 3
    words = f"{np.count_nonzero(left_out)}; 3"
    assert dict(replay_table(numbers))["Steps with people left out; at most"] == words


def test_a_robot_with_a_nose():
    problem = Problem(
        Unicycle(0.2), horizon=12, Q=[1, 1, 0.02, 0.1], R=[0.05, 0.05], u_min=-2, u_max=2,
        robot_radius=0.3, max_obstacles=4,
    )  # fmt: skip
    run = replay(street(people=4, frames=40, seed=2), Crossing([0, -3], [0, 3]), problem)
    assert np.allclose(run.states[0], [0, -3, np.pi / 2, 0])
    assert len(arrivals(run)) >= 2
    assert run.clearances.min() > 0


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
    assert np.linalg.norm(run.bodies[:, 0] - run.positions, axis=1).min() > 1.0
    assert meeting.speed == 0
    numbers = summarise_replay(run)
    assert numbers["people_touched"] == 1
    assert numbers["contacts"] == {"count": 1, "new": 1}
    assert numbers["contacts_by_kind"] == {
        "at rest": {"count": 1, "new": 1},
        "struck": {"count": 0, "new": 0},
        "at fault": {"count": 0, "new": 0},
    }
    table = dict(replay_table(numbers))
    assert table["Contacts; within 1 s of appearing"] == "1; 1"
    assert table["  the robot is at rest"] == "1; 1"
    assert table["  the robot runs into somebody"] == "0; 0"


def test_courses_follow_the_flow():
    recording = street(people=8)
    along, across = (Crossing.through(recording, way) for way in ("along", "across"))
    assert abs(along.direction[1]) > 0.99
    assert abs(across.direction[0]) > 0.99
    back = along.reversed()
    assert np.array_equal(back.start, along.goal)
    assert back.speed == along.speed


def test_the_reference_waits_for_the_robot_and_ends_at_the_goal():
    scene = ThereAndBack(Crossing([0, 0], [10, 0], speed=1.0), DoubleIntegrator(0.5), horizon=5)
    x_ref = scene.x_ref(0.0, np.array([8.0, 0, 3, 0]))
    assert np.allclose(x_ref[:, [0, 2]], [[x, 0] for x in (8, 8.5, 9, 9.5, 10, 10)])
    assert np.allclose(x_ref[:, [1, 3]], [[v, 0] for v in (1, 1, 1, 1, 0, 0)])
    x_ref = scene.x_ref(0.5, np.array([-3.0, 0, 1, 0]))
    assert np.allclose(x_ref[:3, [0, 2]], [[0, 0], [0.5, 0], [1, 0]])


def test_the_scene_turns_round_and_begins_anew():
    scene = ThereAndBack(Crossing([0, 0], [10, 0]), DoubleIntegrator(0.5), horizon=5)
    there, middle = np.array([9.8, 0, 0, 0]), np.array([5.0, 0, 0, 0])
    assert scene.x_ref(0, middle)[1, 1] == pytest.approx(1.3)
    scene.advance(0.5, there)
    assert scene.x_ref(0.5, middle)[1, 1] == pytest.approx(-1.3)
    scene.reset(np.random.default_rng())
    assert scene.x_ref(0, middle)[1, 1] == pytest.approx(1.3)


def test_summary_table_and_figure(run):
    numbers = summarise_replay(run)
    assert numbers["people"] == 4
    assert numbers["contacts"] == {"count": 0, "new": 0}
    assert sum(numbers["statuses"].values()) == numbers["steps"] == 78
    assert numbers["pass_mean_s"] >= numbers["pass_alone_s"] - 1.0
    ends = 0.2 * np.array([0, *arrivals(run)])
    assert numbers["passes"] == len(ends) - 1
    assert numbers["pass_max_s"] == pytest.approx(np.diff(ends).max())
    assert numbers["min_clearance_m"] == numbers["closest"][0]["clearance"]
    assert 0 < numbers["furthest_beside_m"] < 5
    assert all(value for _, value in replay_table(numbers))
    steps = animated_steps(run)
    assert len(steps) == 78
    assert steps.stop <= run.steps
    ways, clearance = replay_figure(run).axes
    numbered = [[text.get_text() for text in axes.texts] for axes in (ways, clearance)]
    assert numbered == [["1", "2", "3", "4"]] * 2
    drawn = clearance.lines[0].get_ydata()
    assert min(drawn) == numbers["min_clearance_m"]


def test_nobody_near_and_no_pass_done():
    recording = street(people=1, frames=6)
    run = replay(recording, Crossing([50, 0], [50, 10]))
    assert arrivals(run) == []
    table = dict(replay_table(summarise_replay(run)))
    assert table["Time of a pass, mean; longest [s]"] == "none; none"


def test_a_robot_that_cannot_move_has_no_time_of_its_own():
    problem = Problem(
        DoubleIntegrator(0.2), horizon=3, Q=[1, 1, 1, 1], R=[1, 1], u_min=0, u_max=0,
        max_obstacles=1,
    )  # fmt: skip
    run = replay(street(people=1, frames=6), Crossing([0, 0], [0, 1]), problem, steps=2)
    assert time_alone(run) is None
    assert dict(replay_table(summarise_replay(run)))["The same with nobody there [s]"] == "none"


def test_another_scene_has_no_passes():
    problem = replay_problem(horizon=3)
    elsewhere = simulate(MPC(problem), Scene(np.zeros(4), np.zeros(4)), steps=1)
    with pytest.raises(InvalidArgumentError, match="of a Scene, not there and back"):
        arrivals(elsewhere)


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
