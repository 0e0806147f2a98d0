"""Drives: determinism, clearances against a slow obvious computation, and their pictures."""

from dataclasses import replace

import numpy as np
import pytest
from hulls import distance

from scp_mpc import ObstaclePrediction, Settings
from scp_mpc.obstacles import Polytope
from scp_mpc.report import exhibits
from scp_mpc.simulation import Doorway, Flight, Overtaking, drive

SHORT = {
    "overtaking": Overtaking(steps=3, horizon=6),
    "flight": Flight(steps=3, horizon=6),
    "doorway": Doorway(steps=3, horizon=6),
}


@pytest.fixture(scope="module", params=list(SHORT))
def name(request):
    return request.param


@pytest.fixture(scope="module")
def run(name):
    return drive(SHORT[name], Settings(multi_start=False))


def test_the_same_seed_drives_the_same_way(name, run):
    again = drive(SHORT[name], Settings(multi_start=False))
    assert np.array_equal(again.states, run.states)
    assert np.array_equal(again.bodies[-1].means, run.bodies[-1].means)


def test_shapes_and_promises(run):
    assert run.states.shape == (4, run.problem.model.nx)
    assert run.clearances().shape == (len(run.bodies), 3)
    assert all(plan.ok for plan in run.plans)
    assert run.clearances().min() > 0


def test_clearances_are_those_of_bodies_and_discs(run):
    """At the ends of the intervals, one pair of disc and body after the other."""
    problem = run.problem
    found = run.clearances()
    for body, row in zip(run.bodies[:3], found, strict=False):
        for k in range(3):
            ends = []
            for i in (k, k + 1):
                x = run.states[i]
                heading = problem.model.heading
                for offset in problem.discs:
                    p = x[problem.model.position].copy()
                    if heading is not None:
                        p += offset * np.array([np.cos(x[heading]), np.sin(x[heading])])
                    gap = p - body.means[i]
                    shape = body.shape
                    away = np.linalg.norm(gap) if shape is None else distance(shape.vertices, gap)
                    ends.append(away - body.radius - problem.robot_radius)
            assert row[k] <= min(ends) + 1e-6
            assert row[k] >= min(ends) - 2.5  # less than it moves within an interval


def test_bodies_that_pass_between_two_samples_are_seen(run):
    """A body that jumps across the robot within the first interval touches it there."""
    d = run.problem.model.dim
    at, way = run.positions[0], np.eye(d)[0] * 20
    path = np.stack([at - way, at + way, at + way, at + way])
    ball = ObstaclePrediction(path, np.zeros((d, d)), 1.5)
    box = ObstaclePrediction(path, np.zeros((d, d)), 0.0, shape=Polytope.box(3 * np.ones(d)))
    clear = replace(run, bodies=[ball, box]).clearances()
    assert (clear[:, 0] < 0).all()
    assert (clear[:, 1:] > 10).all()


def test_an_exhibit_is_drawn(name, run, tmp_path):
    shown = replace(exhibits()[name], instants=(0, 2))
    figure = shown.figure(run)
    assert len(figure.axes) == 2 + len(shown.traces(run))
    written = shown.animate(run, tmp_path)
    assert written.stat().st_size > 1000
