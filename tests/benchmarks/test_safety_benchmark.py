"""The benchmark of safety: its worlds, its judge and its search, against what is known by hand."""

import json
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.safety import broken, episode, judged, main, summarise
from benchmarks.safety_drive import Drive, Way, drive
from benchmarks.safety_search import is_reachable
from benchmarks.safety_worlds import ROBOTS, SHARES, Thing, World
from scp_mpc import MPC, SCP, Settings, Status

SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
STILL = np.zeros(2)


class Blind:
    """Sees nothing, and drives straight on."""

    def __init__(self, problem):
        self._mpc = MPC(problem, Settings(deadline=None))

    def step(self, x0, x_ref, _obstacles):
        return self._mpc.step(x0, x_ref, [])


def box(x, y, half, velocity=(0.0, 0.0)):
    return Thing(np.array([x, y]), np.array(velocity), SQUARE * half, 0.0, np.zeros(1))


def world(things, robot="double integrator"):
    """One with these things in it, 5 m to go at 2 m/s."""
    found = next(
        w
        for w in map(World, range(99))
        if w.robot == robot and w.dt == 0.2 and len(w.things) >= len(things)
    )
    known = np.zeros(found.horizon + 1)
    found.things = [replace(thing, variances=known) for thing in things]
    found.radius, found.goal, found.speed_max = 0.3, np.array([5.0, 0]), None
    return found


def test_a_seed_is_a_world():
    told = [World(5, moving=True).predictions(0.3) for _ in range(2)]
    for one, other in zip(*told, strict=True):
        np.testing.assert_array_equal(one.means, other.means)
        np.testing.assert_array_equal(one.covariances, other.covariances)
    assert {World(seed).robot for seed in range(20)} == set(ROBOTS)
    assert not any(thing.velocity.any() for thing in World(5).things)
    worlds = [World(seed, moving=True) for seed in range(20)]
    moving = [thing.velocity.any() for w in worlds for thing in w.things]
    assert 0.5 < np.mean(moving) < 0.9


def test_gaps_by_hand():
    square = box(2.0, 0.0, [1.0, 0.5], velocity=[0.0, 1.0])
    points = np.array([[0.0, 0.0], [2.0, 0.1], [4.0, 1.5], [2.0, 0.0]])
    times = np.array([0.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(square.gaps(points, times), [1.0, -0.4, np.sqrt(2), 0.5])
    disc = Thing(np.array([3.0, 4.0]), STILL, np.zeros((1, 2)), 1.0, np.zeros(1))
    np.testing.assert_allclose(disc.gaps(np.array([[0.0, 0.0], [3.0, 4.0]]), 7.0), [4.0, -1.0])


@pytest.mark.parametrize("robot", ROBOTS)
def test_the_judges_way_is_the_models(robot):
    rng, judge = np.random.default_rng(0), world([], robot)
    model = judge.problem.model
    states, inputs = rng.uniform(-0.6, 0.6, (30, model.nx)), rng.uniform(-2, 2, (30, 2))
    wanted = model.advance(states, inputs[None], SHARES[:, None])[..., model.position]
    atol = 1e-6 if robot == "bicycle" else 1e-12  # whose model is a Runge-Kutta method
    np.testing.assert_allclose(judge.path(states, inputs), wanted.swapaxes(0, 1), atol=atol)


def test_a_contact_between_two_samples_is_found():
    """0.4 m per interval, past something that is touched halfway."""
    peg = Thing(np.array([0.6, 0.33]), STILL, np.zeros((1, 2)), 0.04, np.zeros(1))
    states = np.array([[0.4 * k, 2.0, 0, 0] for k in range(4)])
    plan = SimpleNamespace(
        u0=np.zeros(2), ok=True, status=Status.CONVERGED, slack=np.zeros(1), x_slack=np.zeros(1)
    )
    run = Drive(world([peg]), states, [plan] * 3, np.zeros(3), arrived=False)
    assert (run.gaps()[:, [0, -1]] > 0.02).all()
    row = judged(run)
    assert row["gap"] == pytest.approx(-0.01)
    assert row["contact"]["step"] == 1
    assert row["contact"]["speed"] == pytest.approx(2.0)
    total = summarise([row | {"reachable": True, "seconds": 1.0}])
    assert (total["contacts_moving"], total["contacts_at_rest"]) == (1, 0)
    assert len(broken([row | {"reachable": False}])) == 1


def wall(opening):
    """Across the whole room, with a door of half an opening [m] in the way."""
    return [box(2.5, side * (opening + 6.0), [0.1, 6.0]) for side in (-1, 1)]


@pytest.mark.parametrize(
    ("things", "reachable"),
    [
        ([], True),
        (wall(0.0), False),
        (wall(0.35), False),  # 0.05 m to spare
        (wall(0.45), True),
        ([*wall(0.45), box(2.9, -7.0, [0.1, 6.0], [0.0, 1.0])], False),  # passes by for 12 s
        ([*wall(0.45), box(2.9, -2.0, [0.1, 1.0], [0.0, 1.0])], True),  # for 2 s
    ],
    ids=["free", "closed", "narrow", "door", "closed for ever", "closed for a while"],
)
def test_the_search_finds_doors(things, reachable):
    assert is_reachable(world(things)) == reachable


def test_a_blind_controller_is_caught():
    worlds = [World(seed) for seed in range(4)]
    rows = [judged(drive(w, Blind(w.problem), along=False)) for w in worlds]
    assert any(row["contact"] and row["contact"]["speed"] > 0.5 for row in rows)
    assert not any(row["not_ok"] for row in rows)


def test_a_path_leads_out_of_a_pocket(monkeypatch):
    """Where the goal alone leaves the robot standing."""
    monkeypatch.setattr("benchmarks.safety_drive.SECONDS", 8.0)
    pocket = [box(2.5, 0.0, [0.1, 1.2]), *(box(1.8, y, [0.7, 0.1]) for y in (-1.2, 1.2))]
    assert not drive(world(pocket), along=False).arrived
    assert drive(world(pocket)).arrived


@pytest.mark.parametrize(
    ("seed", "moving", "horizon"),
    [
        pytest.param(2, True, 16, id="what is rescued is judged by its own motion"),
        pytest.param(45, True, 17, id="programs are left to follow", marks=pytest.mark.slow),
        pytest.param(21, False, 45, id="a long horizon", marks=pytest.mark.slow),
    ],
)
def test_the_first_step_is_a_plan(seed, moving, horizon):
    """Not braking, as it was in these worlds for one reason each."""
    w = World(seed, moving)
    told = [replace(thing, variances=np.resize(thing.variances, horizon + 1)) for thing in w.things]
    told = [thing.prediction(0.0, w.dt) for thing in told]
    solver = SCP(replace(w.problem, horizon=horizon), Settings(deadline=None))
    plan = solver.solve(w.start, w.x_ref, told)
    assert plan.status is Status.CONVERGED
    assert np.linalg.norm(plan.X[-1] - w.start) > 1.0


def test_a_rescue_repairs_many():
    """From rest, a horizon of 45 and a bound on the speed: PIQP's own set is wrong by 22."""
    w = World(21)
    told = [replace(thing, variances=np.zeros(46)).prediction(0.0, w.dt) for thing in w.things]
    solver = SCP(replace(w.problem, horizon=45), Settings(deadline=None, multi_start=False))
    start = np.array([0.01, 0.0, 0.0, 0.0])
    guess = solver.brake(start, w.x_ref).iterate
    assert solver.solve(start, w.x_ref, told, guess).status is Status.CONVERGED


@pytest.mark.slow
def test_who_stands_too_long_plans_afresh():
    """Nose to a disc, with a way to the side: from standing the search ends in standing."""
    w = World(67)
    w.start = np.array([0.49, 0.09, 0.22, 0.0, 0.0])
    mpc, told = MPC(w.problem, Settings(deadline=None)), w.predictions(0.0)
    mpc.step(w.start, w.start, told)
    x_ref = Way(w).states(w.start, 0)
    away = [np.linalg.norm(mpc.step(w.start, x_ref, told).X[-1] - w.start) for _ in range(11)]
    assert max(away[:-1]) < 0.3
    assert away[-1] > 0.8


@pytest.mark.slow
def test_a_run_goes_on_where_it_ended(tmp_path):
    main("standing", tmp_path, episodes=1, alone=1)
    shown = []
    main("standing", tmp_path, episodes=2, alone=1, echo=shown.append)
    assert re.search(r"\| episodes, control steps \| 2, [0-9]+ \| 1, ", shown[0])
    lines = (tmp_path / "safety-standing.jsonl").read_text().split("\n")[1:]
    assert [json.loads(line)["seed"] for line in lines] == [0, 1]
    row = json.loads(lines[1])["row"]
    del row["milliseconds"], row["seconds"]
    assert row.items() <= episode(1, moving=False).items()
