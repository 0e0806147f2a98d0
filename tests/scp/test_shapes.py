"""Polytopes as obstacles: the same promises as for ellipsoids, and plans around walls."""

import numpy as np
import pytest
from hulls import clearance, distance, polished, way
from hypothesis import given, settings
from hypothesis import strategies as st
from instances import DT, S_REF, obstacle, problem, rotated, straight_reference
from scipy.stats import norm

from scp_mpc import (
    MPC,
    SCP,
    DoubleIntegrator,
    InvalidArgumentError,
    ObstaclePrediction,
    ShapeError,
    StageRisk,
    Status,
)
from scp_mpc.geometry import AxesInflation, ExactInflation, NoGoSets, risk_bound
from scp_mpc.obstacles import Polytope, propagated
from scp_mpc.scp.step import Step

N = 5
INFLATIONS = {"exact": ExactInflation(S_REF), "axes": AxesInflation(S_REF)}
both = pytest.mark.parametrize("inflation", INFLATIONS.values(), ids=INFLATIONS.keys())
seeds = st.integers(0, 2**32 - 1)
some = settings(max_examples=25)


def moving(rng, dim=2):
    """An uncertain polytope on its way."""
    corners = rng.normal(size=(dim + 1, dim)) * rng.uniform(0.3, 2.0)
    G = 0.3 * rng.normal(size=(N + 1, dim, dim))
    return ObstaclePrediction(
        rng.normal(size=dim) + np.arange(N + 1)[:, None] * 0.2 * rng.normal(size=dim),
        G @ np.swapaxes(G, 1, 2),
        rng.uniform(0.0, 0.4),
        shape=Polytope(corners - corners.mean(axis=0)),
    )


def scene(seed, dim=2):
    """Two polytopes with an ellipsoid in between, and an empty slot."""
    rng = np.random.default_rng(seed)
    G = rng.normal(size=(dim, dim))
    plain = ObstaclePrediction(rng.normal(size=(N + 1, dim)), G @ G.T, 0.2)
    predictions = [moving(rng, dim), plain, moving(rng, dim)]
    sets = NoGoSets.from_predictions(predictions, 0.15, 4, N, dim)
    p, s = 2 * rng.normal(size=(N, dim)), rng.uniform(0.5, 4.0, 4)
    return rng, predictions, sets, p, s, p[:1] - sets.means[:, 0]


@settings(max_examples=8)
@given(seed=seeds)
def test_the_constraint_is_the_distance_to_the_rounded_polytope(seed):
    _, predictions, sets, p, s, start = scene(seed)
    values = INFLATIONS["exact"].linearise(sets, p, s, start).value
    for j in (0, 2):
        o = predictions[j]
        for i in range(N):
            sigma = np.sqrt(np.linalg.eigvalsh(o.covariances[i + 1])[-1])
            expected = distance(o.shape.vertices, p[i] - o.means[i + 1])
            expected -= s[j] * sigma + o.radius + 0.15
            assert values[j, i] == pytest.approx(expected, abs=1e-6)
    assert np.isinf(values[3]).all()


@both
@some
@given(seed=seeds, dim=st.sampled_from([2, 3]))
def test_it_is_jointly_convex_and_its_tangent_is_below_it(inflation, seed, dim):
    rng, _, sets, p, s, start = scene(seed, dim)
    q, t = p + rng.normal(size=p.shape), rng.uniform(0.0, 5.0, 4)
    at_p, at_q, middle = (
        inflation.linearise(sets, *at, start) for at in ((p, s), (q, t), ((p + q) / 2, (s + t) / 2))
    )
    walls = [0, 2]
    assert (middle.value <= (at_p.value + at_q.value) / 2 + 1e-9)[walls].all()
    assert (at_p.residual(q, t) <= at_q.value + 1e-9)[walls].all()
    np.testing.assert_allclose(at_p.residual(p, s)[walls], at_p.value[walls], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(at_p.normal[walls], axis=2), 1.0)
    exact = at_p.value[walls] + (t - s)[walls, None] * at_p.slope[walls]
    np.testing.assert_allclose(inflation.linearise(sets, p, t, start).value[walls], exact)


@both
@some
@given(seed=seeds, dim=st.sampled_from([2, 3]))
def test_others_are_as_without_polytopes_beside_them(inflation, seed, dim):
    _, predictions, sets, p, s, start = scene(seed, dim)
    spaces = inflation.linearise(sets, p, s, start)
    alone = NoGoSets.from_predictions(predictions[1:2], 0.15, 1, N, dim)
    assert alone.shapes is None
    expected = inflation.linearise(alone, p, s[1:2], start[1:2])
    for name in ("normal", "slope", "offset", "value"):
        np.testing.assert_array_equal(getattr(spaces, name)[1], getattr(expected, name)[0])
    bend = inflation.curvature_factor(sets, s, spaces)
    np.testing.assert_array_equal(bend[1], inflation.curvature_factor(alone, s[1:2], expected)[0])
    assert not bend[[0, 2], :, -1].any()
    np.testing.assert_array_equal(bend[[0, 2], :, :dim], spaces.curvature[[0, 2]])
    y = p - sets.means
    for j in (0, 2):
        near = sets.shapes.taken(np.array([j])).nearest(y[[j]])
        np.testing.assert_array_equal(spaces.curvature[j], near.curvature[0])
    room = inflation.clearance(sets, p)
    np.testing.assert_array_equal(room[1], inflation.clearance(alone, p)[0])
    expected = inflation.linearise(sets, p, np.full(4, S_REF), start).value
    np.testing.assert_allclose(room[[0, 2]], expected[[0, 2]], atol=1e-12)


@some
@given(seed=seeds)
def test_who_is_near_is_found(seed):
    """`within` leaves out nobody whose no-go set is nearer, and takes in whom its bound says.

    The bound is the distance along the line to an ellipsoid's middle, and of a polytope its own,
    less the largest standard deviation in any direction.
    """
    rng, predictions, _, _, _, _ = scene(seed)
    case = problem(N, max_obstacles=4)
    step = Step.read(case, np.zeros(4), np.zeros(4), predictions, 0.01 * np.eye(2))
    path, s = 2 * rng.normal(size=(N + 1, 2)), rng.uniform(0.5, 4.0, 4)
    for gap in (0.0, 0.5, 2.0):
        near = step.within(path, s, gap)
        near = np.zeros((3, N), dtype=bool) if near is None else near
        given = step.means[:, 1:], step.covariances[:, 1:], step.radii, step.count, step.shapes
        before = path[None, :-1] - step.means[:, :-1]
        g = case.no_go.linearise(NoGoSets.stacked(*given), path[1:], s[:3], before).value
        assert near[g <= gap - 1e-12].all()
        for j, i in np.ndindex(near.shape):
            y, Sigma = path[i + 1] - step.means[j, i + 1], step.covariances[j, i + 1]
            away, width = np.linalg.norm(y), step.largest_stds[j, i + 1]
            if j == 1:  # the ellipsoid
                width = np.sqrt(y @ Sigma @ y) / away
            else:
                away = distance(predictions[j].shape.vertices, y)
            room = away - s[j] * width - step.radii[j, i] - gap
            assert abs(room) < 1e-6 or near[j, i] == (room < 0)
    known = rng.random((3, N)) < 0.5
    unknown = step.within(path, s, 0.5, known)
    assert unknown is None or not (unknown & known).any()
    np.testing.assert_array_equal(step.depths(path[1:], s) > 0, g < 0)
    np.testing.assert_allclose(step.depths(path[1:], s), np.maximum(0, -g), atol=1e-12)


@settings(max_examples=8)
@given(seed=seeds)
def test_the_risk_bound_holds_for_samples(seed):
    rng, predictions, sets, p, _, _ = scene(seed)
    bound = risk_bound(sets, p)
    samples = 4000
    for j in (0, 2):
        o, i = predictions[j], 2
        there = rng.multivariate_normal(o.means[i + 1], o.covariances[i + 1], samples)
        faces, offsets = o.shape.normals, o.shape.offsets
        # Beyond a face by the radii is clear for certain; the share of the others bounds contact.
        touching = ((p[i] - there) @ faces.T - offsets <= 0).all(axis=1).mean()
        assert touching <= bound[j, i] + 5 * np.sqrt(0.25 / samples)
    assert not bound[3].any()


def test_the_risk_of_a_wall_is_none_or_certain():
    wall = Polytope.box([1.0, 1.0]).static(2)
    sets = NoGoSets.from_predictions([wall], 0.2, 1, 2, 2)
    np.testing.assert_array_equal(risk_bound(sets, np.array([[0.71, 0.0], [0.69, 0.0]])), [[0, 1]])
    blurred = ObstaclePrediction(wall.means, np.diag([0.04, 0.01]), 0.0, shape=wall.shape)
    sets = NoGoSets.from_predictions([blurred], 0.2, 1, 2, 2)
    bound = risk_bound(sets, np.array([[1.1, 0.0], [0.0, 1.1]]))
    np.testing.assert_allclose(bound, [[norm.sf(2)] * 2], rtol=1e-12)


def test_a_shape_belongs_to_its_prediction():
    box = Polytope.box([1.0, 2.0])
    wall = box.static(N, at=(1.0, 2.0), radius=0.1, name="wall")
    np.testing.assert_array_equal(wall.means, [[1.0, 2.0]] * (N + 1))
    assert not wall.covariances.any()
    assert (wall.shape, wall.name, wall.radius, wall.stamp) == (box, "wall", 0.1, None)
    late = propagated(wall, 0.3, DT, 0.5)
    assert late.shape is box
    np.testing.assert_allclose(late.covariances, [0.15 * np.eye(2)] * (N + 1))
    pillar = ObstaclePrediction.static(N, (0.0, 1.0, 2.0), 0.3)
    assert (pillar.dim, pillar.shape, pillar.largest_std.max()) == (3, None, 0.0)
    with pytest.raises(ShapeError, match="shape"):
        ObstaclePrediction(np.zeros((3, 3)), np.eye(3), 0.1, shape=box)
    with pytest.raises(InvalidArgumentError, match="shape"):
        ObstaclePrediction(np.zeros((3, 2)), np.eye(2), 0.1, shape=[[0, 0], [1, 0], [0, 1]])


def certified(case, x0, x_ref, obstacles):
    plan = SCP(case).solve(x0, x_ref, obstacles)
    assert plan.status is Status.CONVERGED
    assert plan.kkt.worst <= 1e-6
    return plan


HORIZON = 20
REF = straight_reference(HORIZON)
WALL = Polytope.box([0.4, 3.0])
CURVATURE_TOLERANCE = Polytope.box([0.8, 2.6], angle=0.3)
TRIANGLE = Polytope([[-0.6, -0.5], [0.7, -0.3], [0.1, 0.8]])
WORLDS = {
    "box": [Polytope.box([1.0, 0.8], angle=0.4).static(HORIZON, (4.0, 0.1))],
    "rounded": [TRIANGLE.static(HORIZON, (4.0, -0.2), radius=0.3)],
    "slalom": [WALL.static(HORIZON, (2.5, -1.3)), CURVATURE_TOLERANCE.static(HORIZON, (5.5, 1.3))],
    "door": [WALL.static(HORIZON, (4.0, -1.4)), WALL.static(HORIZON, (4.0, 2.4))],
}


@pytest.mark.parametrize("world", WORLDS)
@both
def test_plans_are_certified_and_clear_between_the_samples(inflation, world):
    kind = "exact" if inflation is INFLATIONS["exact"] else "axes"
    case = problem(HORIZON, kind, max_obstacles=2, nodes_per_interval=4)
    plan = certified(case, REF[0], REF, WORLDS[world])
    assert -1e-6 < clearance(case, plan, WORLDS[world]) < 0.1
    assert plan.risk.joint == 0.0


@pytest.mark.parametrize("world", WORLDS)
def test_ipopt_does_not_improve_them(world):
    case = problem(HORIZON, max_obstacles=2)
    plan = certified(case, REF[0], REF, WORLDS[world])
    assert polished(case, REF[0], REF, WORLDS[world], plan) >= plan.cost * (1 - 1e-5)


def test_ipopt_does_not_improve_a_plan_around_an_uncertain_one():
    case, rng = problem(12, max_obstacles=1), np.random.default_rng(3)
    ref = straight_reference(12)
    for _ in range(3):
        means = np.array([3.0, rng.uniform(-0.3, 0.3)]) - np.arange(13)[:, None] * [0.1, 0.0]
        Sigma = rotated((0.2, 0.1), rng.uniform(0, 3))
        thing = ObstaclePrediction(means, Sigma, 0.1, shape=TRIANGLE)
        plan = certified(case, ref[0], ref, [thing])
        assert plan.iterate.touches
        assert polished(case, ref[0], ref, [thing], plan) >= plan.cost * (1 - 1e-5)


def test_a_corridor_with_somebody_in_it():
    """Two walls 2.4 m apart; who comes towards the robot leaves room on one side only."""
    side = Polytope.box([12.0, 0.2])
    walls = [side.static(HORIZON, (4.0, y)) for y in (-1.3, 1.3)]
    person = obstacle(HORIZON, (6.0, 0.35), (-1.0, 0.0), 0.01 * np.eye(2))
    case = problem(HORIZON, max_obstacles=3, nodes_per_interval=4)
    plan = certified(case, REF[0], REF, [*walls, person])
    assert clearance(case, plan, walls) > -1e-6
    apart = plan.X[1:, [0, 2]] - person.means[1:]
    assert plan.X[np.linalg.norm(apart, axis=1).argmin() + 1, 2] < 0
    assert np.linalg.norm(apart, axis=1).min() > 0.35 + 0.1 * S_REF


def test_a_polyhedron_in_space():
    dim = 3
    case = problem(
        HORIZON,
        model=DoubleIntegrator(DT, dim=dim),
        Q=[0.2, 0.05] * dim,
        R=[0.001] * dim,
        margin=None,
        nodes_per_interval=4,
    )
    ref = np.pad(REF, ((0, 0), (0, 2)))
    points = np.random.default_rng(2).normal(size=(12, 3))
    thing = Polytope(0.8 * points / np.linalg.norm(points, axis=1, keepdims=True))
    still = thing.static(HORIZON, (4.0, 0.1, -0.1), radius=0.05)
    plan = certified(case, ref[0], ref, [still])
    assert plan.iterate.touches
    assert -1e-6 < clearance(case, plan, [still], pieces=4) < 0.1
    flat = problem(HORIZON, model=case.model, Q=case.Q, R=case.R, margin=None)
    plan = certified(flat, ref[0], ref, [still])
    assert polished(flat, ref[0], ref, [still], plan) >= plan.cost * (1 - 1e-5)


def test_a_disc_is_a_polygon_with_many_corners():
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    disc = Polytope(0.5 * np.stack([np.cos(angle), np.sin(angle)], axis=1))
    case = problem(HORIZON)
    round_one = ObstaclePrediction.static(HORIZON, (4.0, 0.1), 0.5)
    expected = certified(case, REF[0], REF, [round_one])
    plan = certified(case, REF[0], REF, [disc.static(HORIZON, (4.0, 0.1))])
    assert plan.cost == pytest.approx(expected.cost, rel=2e-3)


def test_the_robots_own_uncertainty_keeps_it_off_the_wall():
    walls, case = WORLDS["box"], problem(HORIZON, margin=StageRisk(0.01))
    near = SCP(case).solve(REF[0], REF, walls)
    far = SCP(case).solve(REF[0], REF, walls, robot_covariance=np.diag([0.04, 0.01]))
    assert far.status is Status.CONVERGED
    gap = 0.2 * norm.isf(0.01)
    rooms = [
        min(distance(walls[0].shape.vertices, p - [4, 0.1]) for p in plan.X[:, [0, 2]])
        for plan in (near, far)
    ]
    np.testing.assert_allclose(rooms, [0.15, 0.15 + gap], atol=1e-6)
    assert far.risk.stages.max() == pytest.approx(0.01, rel=1e-6)


def test_a_robot_drives_through_doors():
    """In closed loop, with the last plan as a guess, without touching."""
    case = problem(HORIZON, max_obstacles=3, nodes_per_interval=4)
    walls = [*WORLDS["door"], WALL.static(HORIZON, (7.5, 0.8), name="third")]
    mpc, x = MPC(case), REF[0].copy()
    for k in range(12):
        ref = REF.copy()
        ref[:, 0] += 2 * DT * k
        plan = mpc.step(x, ref, walls)
        assert plan.ok
        path = way(case, plan)[:9]
        for wall in walls:
            assert min(distance(wall.shape.vertices, p - wall.means[0]) for p in path) > 0.15 - 1e-6
        x = plan.X[1]
    assert x[0] > 4.5


def test_peers_refuse_polytopes():
    pytest.importorskip("casadi")
    from benchmarks.peers.ipopt import Ipopt
    from benchmarks.peers.slsqp import Slsqp

    case, walls = problem(HORIZON, max_obstacles=2), WORLDS["slalom"]
    guess = SCP(case).solve(REF[0], REF).iterate
    for peer in (Ipopt(case), Slsqp(case)):
        with pytest.raises(InvalidArgumentError, match=r"obstacles\[0\]\.shape"):
            peer.solve(REF[0], REF, walls, guess)
