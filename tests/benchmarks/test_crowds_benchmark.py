"""The benchmark of crowds: its people, its sums and its limits, against what is known by hand."""

import json
from dataclasses import replace

import numpy as np
import pytest
from recordings import street, write_obsmat

from benchmarks.crowds import main, markdown, progress_of
from benchmarks.crowds_judge import interval, judged, moving, summed
from benchmarks.crowds_reacting import GOAL, ROBOTS, START, Square, problem, reacting
from benchmarks.crowds_recorded import PEOPLE, as_they_were, dense, thickened
from scp_mpc import MPC, DoubleIntegrator, Problem, Settings
from scp_mpc.simulation import Body, Recording, Scene, simulate


class Blind:
    """Sees nobody."""

    def __init__(self, problem):
        self.problem, self.settings = problem, Settings(deadline=None)
        self._mpc = MPC(problem, self.settings)

    def step(self, x0, x_ref, _obstacles):
        return self._mpc.step(x0, x_ref, [])


def met(speed, at):
    """A run of a blind robot at 0, which drives at a speed, and of a person who comes at 1 m/s."""
    task = Problem(
        DoubleIntegrator(0.2),
        horizon=5,
        Q=[0, 1, 0, 1],
        R=[0.1, 0.1],
        u_min=-2.0,
        u_max=2.0,
        robot_radius=0.3,
    )
    person = Body(lambda time: np.array([at - time, 0.0]), 0.3)
    scene = Scene([0.0, speed, 0.0, 0.0], [0.0, speed, 0.0, 0.0], [person])
    return simulate(Blind(task), scene, steps=20)


def test_contacts_by_hand():
    """The gap of 0.6 m closes at 1 m/s, or 3 m/s; who was there for less does not count."""
    rows = [
        {"seed": seed, **judged(met(speed, at))}
        for seed, (speed, at) in enumerate([(0.0, 2.6), (2.0, 5.1), (2.0, 1.2)])
    ]
    assert [row["contacts"][0]["kind"] for row in rows] == ["at rest", "at fault", "at fault"]
    np.testing.assert_allclose([r["contacts"][0]["time"] for r in rows], [2, 1.5, 0.2], atol=0.02)
    total = summed(rows)
    assert total["contacts"] == {"at rest": 1, "struck": 0, "at fault": 2}
    assert total["seen"] == {"at rest": 1, "struck": 0, "at fault": 1}
    assert (total["runs"], total["steps"], total["resting"]) == (3, 60, 1)
    assert total["fastest"] == pytest.approx(2.0)
    assert [(c["seed"], c["speed"]) for c in moving(rows)] == [(1, pytest.approx(2.0))]
    assert not judged(met(0.0, 2.6), steps=5)["contacts"]


def test_a_limit_that_is_broken_counts():
    run = met(2.0, 9.0)
    assert not summed([judged(run)])["runs_beyond"]
    for name, broken in [
        ("input", replace(run, inputs=run.inputs + 2.5)),
        ("speed", replace(run, problem=replace(run.problem, speed_max=1.5))),
        ("state", replace(run, problem=replace(run.problem, x_min=[-1.0, 2.5, -1.0, -1.0]))),
    ]:
        row = judged(broken)
        assert row["beyond"][name] == pytest.approx(0.5, abs=1e-6)
        assert summed([row])["runs_beyond"] == 1


@pytest.mark.parametrize("count", [1, 7, 500])
def test_intervals_of_all_and_of_none(count):
    """At either end the bound solves p^n = 2.5 %."""
    np.testing.assert_allclose(interval(count, count), [0.025 ** (1 / count), 1.0])
    np.testing.assert_allclose(interval(0, count), [0.0, 1 - 0.025 ** (1 / count)])
    assert interval(0, 0) == [0.0, 1.0]


def test_copies_of_somebody_walk_as_he_did():
    """One person who walks 20 m in 20 s, many times over, each time elsewhere on his way."""
    times = np.arange(0.0, 20.1, 0.4)
    one = Recording.from_rows(times, np.ones(51, dtype=int), np.stack([times, 0 * times], axis=1))
    bodies = thickened(one, 200, np.random.default_rng(0))
    ways = np.array([[body.at(0.2 * k) for k in range(201)] for body in bodies])
    here = ~np.isnan(ways[..., 0])
    assert PEOPLE <= here.sum(axis=0).mean() < PEOPLE + 3
    assert here.sum(axis=0).min() > PEOPLE - 3  # at all times
    steps = np.diff(ways, axis=1)
    steps = steps[~np.isnan(steps[..., 0])]
    assert len(steps) > 150 * PEOPLE
    np.testing.assert_allclose(steps, np.tile([0.2, 0.0], (len(steps), 1)), atol=1e-9)
    assert len(np.unique(ways[here[:, 0], 0, 0].round(6))) > PEOPLE / 2
    again = thickened(one, 200, np.random.default_rng(0))
    assert all(
        np.array_equal(a.at(3.0), b.at(3.0), True) for a, b in zip(bodies, again, strict=True)
    )


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return write_obsmat(street(people=6, frames=40), tmp_path_factory.mktemp("x") / "obsmat.txt")


def test_a_table_of_recorded_people(file):
    rows = [dense(0, file, {"speed_max": 1.0}, seconds=0.6)]
    assert rows[0]["people"] >= PEOPLE
    assert rows[0]["fastest_plan"] <= 1.0 + 1e-6
    assert rows[0]["beyond"]["speed"] <= 1e-6
    found = {"group": ("street", "slow"), **summed(rows), **progress_of(rows)}
    text = markdown("dense", [found])
    assert "| street | slow | 1 | 4" in text
    assert len({line.count("|") for line in text.split("\n")}) == 1
    row = as_they_were(0, file, {"deadline": None}, steps=10)
    assert row["steps"] == 10
    assert row["people"] < 7


@pytest.mark.slow
def test_a_run_goes_on_where_it_ended(file, tmp_path):
    shown = []
    main("recorded", tmp_path, [file], runs=1)
    main("recorded", tmp_path, [file], runs=2, echo=shown.append)
    assert "| no deadline | 2 |" in shown[0]
    lines = next(tmp_path.glob("*no-deadline.jsonl")).read_text().split("\n")[1:]
    assert [json.loads(line)["seed"] for line in lines] == [0, 1]


@pytest.fixture
def square():
    pytest.importorskip("pyrvo", reason="RVO2 has no wheel for this machine")
    return Square(problem("omnidirectional", 12).model, 12)


def walked(square, x, steps, seed=0):
    """Places (steps+1, M, 2) of people around a robot that stands."""
    places = [square.reset(np.random.default_rng(seed))]
    places += [square.advance(0.1 * k, x) for k in range(1, steps + 1)]
    return np.array(places)


def test_people_walk_like_people(square):
    """No faster than 1.4 m/s, no harder than 2.5 m/s^2, and around each other and the robot."""
    x = np.array([6.0, 0.0, 6.0, 0.0])
    places = walked(square, x, 300)
    velocities = np.diff(places, axis=0) / 0.1
    assert np.linalg.norm(velocities, axis=-1).max() < 1.4 + 1e-6
    assert 0.7 < np.linalg.norm(velocities, axis=-1).mean() < 1.3
    assert np.linalg.norm(np.diff(velocities, axis=0), axis=-1).max() < 0.25 + 1e-6
    apart = np.linalg.norm(places[:, :, None] - places[:, None], axis=-1)
    apart = apart[:, *np.triu_indices(12, 1)]
    assert (apart < 0.6).mean() < 0.002  # chance alone: 12 * pi * 0.6^2 / 144 / 12 of pairs, 0.008
    assert (apart < 3.0).mean() > 0.05
    away = np.linalg.norm(places[20:] - [6.0, 6.0], axis=-1)
    assert away.min() > 0.5
    assert away.min() < 1.5


def test_a_seed_is_a_crowd_and_who_arrives_is_left_alone(square):
    x = square.start()
    np.testing.assert_array_equal(walked(square, x, 20), walked(square, x, 20))
    assert not np.array_equal(walked(square, x, 0), walked(square, x, 0, seed=1))
    assert np.linalg.norm(square.reset(np.random.default_rng(0)) - START, axis=1).min() > 1.5
    there = square.advance(0.1, np.array([GOAL[0] - 0.2, 0.0, GOAL[1], 0.0]))
    assert np.isnan(there).all()
    assert np.isnan(square.advance(0.2, x)).all()


@pytest.mark.parametrize("robot", [ROBOTS[1], pytest.param(ROBOTS[0], marks=pytest.mark.slow)])
def test_a_table_of_people_who_react(robot):
    pytest.importorskip("pyrvo", reason="RVO2 has no wheel for this machine")
    alone = reacting(0, robot, 0, seconds=16.0)
    assert 12.0 < alone["arrived"] < 16.0
    assert alone["ratio"] == pytest.approx(1.0, abs=0.01)
    short = reacting(0, robot, 3, seconds=1.0)
    assert short["arrived"] is short["ratio"] is None
    assert short["steps"] == 10
    assert short["fastest_plan"] <= 1 + 1e-6
    rows = [alone, short | {"seed": 1}]
    text = markdown("reacting", [{"group": (robot, "3"), **summed(rows), **progress_of(rows)}])
    assert f"| {robot} | 3 | 1 of 2 | 1.0" in text
    assert len({line.count("|") for line in text.split("\n")}) == 1
