"""One simulator: any scene, plant and sensor, reproducible, with its events in continuous time."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from scp_mpc import MPC, DoubleIntegrator, Problem, Unicycle
from scp_mpc.errors import BoundsError, InvalidArgumentError
from scp_mpc.obstacles import Polytope
from scp_mpc.simulation.disturbance import ConstantPush
from scp_mpc.simulation.episodes import run_episodes
from scp_mpc.simulation.events import find_contacts, find_meetings
from scp_mpc.simulation.plant import ModelPlant
from scp_mpc.simulation.scene import Body, Scene
from scp_mpc.simulation.sensor import TrackedSensor
from scp_mpc.simulation.simulate import simulate

POINT = Problem(
    DoubleIntegrator(0.1), horizon=10, Q=[1, 0.1, 1, 0.1], R=[0.05, 0.05], u_min=-2.0, u_max=2.0,
    robot_radius=0.3, max_obstacles=4,
)  # fmt: skip
CAR = Problem(
    Unicycle(0.1), horizon=10, Q=[1, 1, 0.01, 0.1], R=[0.05, 0.05], u_min=-2.0, u_max=2.0,
    robot_radius=0.2, discs=[-0.2, 0.2], max_obstacles=4,
)  # fmt: skip
BODIES = [
    Body([2.0, 1.2], 0.1, shape=Polytope.box([0.6, 0.6])),
    Body(lambda t: [5.0 - 0.6 * t, 0.1], 0.3, covariances=0.01 * np.eye(2), name="walker"),
    Body(lambda t: [np.nan, np.nan] if t < 0.95 else [3.0, 3.0 - 0.5 * t], 0.3),
]
SCENE = Scene(np.zeros(4), [5.0, 0, 0, 0], BODIES)


class Blind:
    """Drives with one input for ever, whatever is in the way."""

    def __init__(self, problem, u):
        self.mpc, self.u = MPC(problem), np.array(u, dtype=float)
        self.problem, self.settings = problem, self.mpc.settings

    def step(self, x0, x_ref, _obstacles):
        plan = self.mpc.step(x0, x_ref)
        return replace(plan, U=np.tile(self.u, (len(plan.U), 1)))


@pytest.mark.parametrize("problem", [POINT, CAR], ids=["point", "car"])
def test_clearances_are_those_of_a_slow_loop(problem):
    run = simulate(MPC(problem), SCENE, steps=12)
    model = problem.model
    for k in range(12):
        least = np.full(3, np.inf)
        for share in np.linspace(0, 1, 33):
            x = model.advance(run.states[k], run.inputs[k], share)
            for j, body in enumerate(BODIES):
                begin, end = body.at(0.1 * k), body.at(0.1 * (k + 1))
                at = begin + share * (end - begin)
                if np.isnan(at).any():
                    continue
                for disc in problem.discs:
                    p = x[model.position]
                    if model.heading is not None:
                        p = p + disc * np.array(
                            [np.cos(x[model.heading]), np.sin(x[model.heading])]
                        )
                    away = np.abs(p - at)
                    if body.shape is not None:
                        away = np.maximum(away - 0.3, 0)
                    gap = np.hypot(*away) - body.radius - problem.robot_radius
                    least[j] = min(least[j], gap)
        np.testing.assert_allclose(run.clearances[k], least, atol=1e-9)
    assert np.isinf(run.clearances[:9, 2]).all()
    assert np.isfinite(run.clearances[10:, 2]).all()


def test_same_seed_same_run_and_the_sensor_is_noisy():
    sensor = TrackedSensor(noise=0.05, state_std=0.01 * np.ones(4), miss=0.2, outage_rate=0.2)
    one, again, other = (
        simulate(MPC(POINT), SCENE, sensor=sensor, steps=25, seed=seed) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one.states, again.states)
    assert np.abs(one.states - other.states).max() > 1e-6
    assert 0 < np.abs(one.measured - one.states[:-1]).max() < 0.1
    last = {o.name: o.means[0] for o in one.predictions[-1]}
    truth = BODIES[1].at(2.4)
    assert 0 < np.linalg.norm(last[1] - truth) < 0.3
    assert one.version
    assert one.seed == 1


def test_walls_come_first_and_who_is_left_out_is_counted():
    problem = Problem(
        DoubleIntegrator(0.1), horizon=5, Q=np.ones(4), R=np.ones(2), u_min=-1, u_max=1,
        max_obstacles=2,
    )  # fmt: skip
    run = simulate(MPC(problem), SCENE, sensor=TrackedSensor(), steps=15)
    for told, plan in zip(run.predictions, run.plans, strict=True):
        assert [o.shape is not None for o in told] == [True, False, False][: len(told)]
        assert plan.left_out == len(told) - 2
        assert plan.step.count == 2


def test_an_outage_leaves_the_tracks_alone():
    blind = simulate(
        MPC(POINT), SCENE, sensor=TrackedSensor(outage_rate=10.0, outage_time=9.0), steps=5
    )
    assert all(len(told) == 1 for told in blind.predictions)  # the wall


def test_a_plant_that_is_pushed():
    scene = Scene(np.zeros(4), np.zeros(4))
    pushed = simulate(
        MPC(POINT), scene, plant=ModelPlant(POINT.model, ConstantPush((0.5, 0.0))), steps=30
    )
    assert pushed.states[-1, 0] > 0.01
    assert pushed.bodies.shape == (31, 0, 2)
    assert pushed.clearances.shape == (30, 0)
    assert find_meetings(pushed) == find_contacts(pushed) == []


@pytest.mark.parametrize(
    ("speed", "walker", "kind"),
    [(0.0, -1.0, "at rest"), (1.0, 0.0, "at fault"), (1.0, -1.5, "struck"), (0.25, 0.0, "struck")],
)
def test_contacts_by_who_runs_into_whom(speed, walker, kind):
    """Head-on along the first axis, 0.13 m apart at the start."""
    scene = Scene([0.0, speed, 0, 0], np.zeros(4), [Body(lambda t: [0.73 + walker * t, 0.0], 0.3)])
    run = simulate(Blind(POINT, [0.0, 0.0]), scene, steps=12)
    (contact,) = find_contacts(run)
    assert contact.kind == kind
    assert contact.closing == pytest.approx(speed, abs=1e-6)
    assert contact.body_closing == pytest.approx(-walker, abs=1e-6)
    assert contact.time == pytest.approx(0.13 / (speed - walker), abs=0.1 / 32 + 1e-9)
    assert contact.seen == pytest.approx(0.1 * int(contact.time / 0.1 + 1e-9))
    assert contact.depth > 0
    (meeting,) = find_meetings(run)
    assert meeting.touched
    assert meeting.clearance == pytest.approx(-contact.depth)


def test_a_wall_is_hit_at_its_corner():
    box = Body([1.0, 1.0], 0.0, shape=Polytope.box([0.4, 0.4]))
    scene = Scene([0.0, 1.0, 0.0, 1.0], np.zeros(4), [box])
    (contact,) = find_contacts(simulate(Blind(POINT, [0.0, 0.0]), scene, steps=8))
    assert contact.closing == pytest.approx(np.sqrt(2), abs=1e-6)
    assert contact.time == pytest.approx(0.8 - 0.3 / np.sqrt(2), abs=0.005)


def test_two_contacts_with_one_body_are_two():
    scene = Scene(
        np.zeros(4), np.zeros(4), [Body(lambda t: [0.0, 2.0 * np.cos(np.pi * t / 1.5)], 0.3)]
    )
    still = simulate(Blind(POINT, [0.0, 0.0]), scene, steps=30)
    assert [contact.kind for contact in find_contacts(still)] == ["at rest", "at rest"]


@pytest.mark.parametrize("steps", [5, 6, 9], ids=["run ends", "body leaves", "later"])
def test_a_contact_at_the_end_of_the_last_interval_counts(steps):
    """One that is reached at 0.5 s, when the body is seen for the last time."""
    body = Body(lambda t: [np.nan, np.nan] if t > 0.55 else [1.099 - t, 0.0], 0.3)
    scene = Scene(np.zeros(4), np.zeros(4), [body])
    run = simulate(Blind(POINT, [0.0, 0.0]), scene, sensor=TrackedSensor(), steps=steps)
    (contact,) = find_contacts(run)
    assert (contact.time, contact.seen) == (pytest.approx(0.5), pytest.approx(0.4))
    assert contact.depth == pytest.approx(0.001)
    assert (contact.kind, contact.body_closing) == ("at rest", pytest.approx(1.0))


def test_who_leaves_within_the_horizon_is_told_to_go_on():
    leaver = Body(lambda t: [2.0 - t, 1.0] if t < 0.75 else [np.nan, np.nan], 0.3)
    told = leaver.predicted(0.2, 0.1, 10)
    assert np.allclose(told.means[:, 0], 1.8 - 0.1 * np.arange(11))
    assert np.allclose(leaver.predicted(0.7, 0.1, 3).means, [1.3, 1.0])  # nothing is known of it


def test_bodies_check_themselves():
    with pytest.raises(BoundsError, match="radius"):
        Body([0.0, 0.0], -0.1)
    with pytest.raises(InvalidArgumentError):
        Body([0.0, 0.0, 0.0, 0.0], 0.1)


def _episode(seed):
    with Path(seeds_seen).open("a") as file:
        file.write(f"{seed}\n")
    if seed == 13:
        raise ValueError("unlucky")
    return {"square": seed * seed}


def test_episodes_go_on_where_they_stopped(tmp_path):
    global seeds_seen
    seeds_seen = tmp_path / "seen"
    file = tmp_path / "rows.jsonl"
    with pytest.raises(ValueError, match="unlucky"):
        run_episodes(_episode, [1, 2, 13], file=file, jobs=1)
    with file.open("a") as lines:
        lines.write('\n{"seed": 4, "ro')  # cut off
    ticks = []
    rows = run_episodes(_episode, [4, 2, 1], file=file, jobs=1, advance=lambda: ticks.append(1))
    assert rows == [{"square": 16}, {"square": 4}, {"square": 1}]
    assert seeds_seen.read_text().split() == ["1", "2", "13", "4"]
    assert len(ticks) == 3
    assert [json.loads(line)["seed"] for line in file.read_text().split("\n") if line[-1:] == "}"]
    with pytest.raises(InvalidArgumentError, match="twice"):
        run_episodes(_episode, [1, 1], jobs=1)
