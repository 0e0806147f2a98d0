"""The subproblem: fixed pattern, values through index maps, against a slow dense rebuild."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from instances import S_REF, instance, obstacle, problem, straight_reference
from nonlinear_cases import MODELS, machine_problem, ride, straight
from rebuilt import SLOTS, couplings_of, rebuilt
from solving import solution

from scp_mpc import SCP, DoubleIntegrator, Margin, ObstaclePrediction, Settings, Status, Trajectory
from scp_mpc.deadline import Clock
from scp_mpc.obstacles import Polytope
from scp_mpc.qp.sparse_blocks import SparseBlocks
from scp_mpc.scp.pairs import Pairs
from scp_mpc.scp.step import Step
from scp_mpc.scp.transcription import Relaxation, Transcription
from scp_mpc.trajectory import rollout

N = 5
BOUNDED = {"du_min": -0.5, "du_max": [0.6, np.inf], "x_max": [np.inf, 2.0, 0.8, np.inf]}
BOTH = pytest.mark.parametrize("elastic", [False, True])


def linear(dim=2, **changes):
    """A linear robot's problem, and two obstacles near to all of its nodes."""
    rng = np.random.default_rng(dim)
    values = {"max_obstacles": 2, "Qf": [3.0, 0.4] * dim, "u_min": [-1.0, -2.0, -3.0][:dim]}
    values |= {"inflation": "exact", "s_min": 0.5}
    if dim == 3:
        values |= {"model": DoubleIntegrator(0.1, 3), "Q": rng.uniform(0, 1, 6), "R": np.ones(3)}
    this = problem(N, **(values | changes))
    things = [
        ObstaclePrediction(0.3 * rng.normal(size=(N + 1, dim)), 0.04 * np.eye(dim), 0.2)
        for _ in range(2)
    ]
    x_ref = 0.2 * rng.normal(size=(N + 1, 2 * dim))
    return this, 0.2 * rng.normal(size=2 * dim), x_ref, things


def nonlinear(name, **changes):
    """A nonlinear robot's problem, and two obstacles near to all of its nodes."""
    rng = np.random.default_rng(1)
    this = machine_problem(name, N, max_obstacles=2, **changes)
    model = this.model
    things = [
        ObstaclePrediction(0.3 * rng.normal(size=(N + 1, model.dim)), 0.01 * np.eye(model.dim), 0.2)
        for _ in range(2)
    ]
    x_ref = straight(model, N)
    return this, x_ref[0] + 0.1 * rng.normal(size=model.nx), x_ref, things


CASES = {
    "plane": linear,
    "space": lambda **changes: linear(3, **changes),
    "axes": lambda **changes: linear(inflation="axes", **changes),
    "bounds": lambda **changes: linear(**BOUNDED, x_soft=True, **changes),
    "fixed size": lambda **changes: linear(margin=Margin.fixed(2.0), **changes),
    "discs": lambda **changes: nonlinear("unicycle", discs=[-0.2, 0.1, 0.4], **changes),
    "free size": lambda **changes: nonlinear("bicycle", margin=Margin(2.0, 0.5, 3.0), **changes),
    **{name: lambda name=name, **changes: nonlinear(name, **changes) for name in MODELS},
}


def about(this, x0, seed=0):
    """Inputs that leave room to their bounds, and the plan to which they lead."""
    rng, half = np.random.default_rng(seed), (this.u_max - this.u_min) / 2
    inputs = (this.u_max + this.u_min) / 2 + 0.2 * half * rng.uniform(-1, 1, (N, this.model.nu))
    inputs = this.limited(inputs, np.zeros(this.model.nu))
    return Trajectory(rollout(this.model.step, x0, inputs).states, inputs)


def equal(program, expected, tolerance=1e-7):
    """Compare all values of a program with the rebuild."""
    found = program.P.toarray(), program.q, program.A.toarray(), program.lower, program.upper
    for name, mine in zip(("P", "q", "A", "lower", "upper"), found, strict=True):
        theirs = getattr(expected, name)
        np.testing.assert_allclose(mine, theirs, rtol=tolerance, atol=tolerance, err_msg=name)


@BOTH
@pytest.mark.parametrize("nodes_per_interval", [1, 3])
@pytest.mark.parametrize("case", CASES)
def test_equals_the_dense_rebuild(case, nodes_per_interval, elastic):
    this, x0, x_ref, things = CASES[case](nodes_per_interval=nodes_per_interval)
    plan, last = about(this, x0), np.zeros(this.model.nu) if this.limits_rates else None
    given = x0, x_ref, things
    program = SCP(this).subproblem(*given, guess=plan, elastic=elastic, u_last=last)
    assert (program.P.toarray() == program.P.toarray().T).all()
    couplings = couplings_of(program, this) if elastic else None
    if elastic:
        assert min(couplings[0].min(initial=1.0), couplings[1]) > 0
    equal(program, rebuilt(this, *given, plan.inputs, elastic, last, couplings))


@BOTH
def test_equals_the_dense_rebuild_about_polytopes(elastic):
    this, x0, x_ref, things = linear()
    walls = [Polytope.box([0.4, 0.3], angle=0.3).static(N, [0.6, 0.5]), things[0]]
    plan = about(this, x0)
    program = SCP(this).subproblem(x0, x_ref, walls, guess=plan, elastic=elastic)
    couplings = couplings_of(program, this) if elastic else None
    equal(program, rebuilt(this, x0, x_ref, walls, plan.inputs, elastic, None, couplings))


@pytest.mark.parametrize("case", ["plane", "unicycle"])
def test_the_nearest_obstacles_get_the_slots_and_others_none(case):
    this, x0, x_ref, _ = CASES[case]()
    this, rng = replace(this, max_obstacles=5), np.random.default_rng(3)
    things = [ObstaclePrediction.static(N, 0.4 * rng.normal(size=2), 0.2) for _ in range(5)]
    plan, solver = about(this, x0), SCP(this)
    begin = rebuilt(this, x0, x_ref, [], plan.inputs).spaces.start
    for present in (things, things[:4], things[:2], [far_away(), *things[:1]]):
        program = solver.subproblem(x0, x_ref, present, guess=plan)
        near = [thing for thing in present if thing.means[0, 0] < 9.0]
        whole = rebuilt(this, x0, x_ref, near, plan.inputs)
        slots = min(len(near), SLOTS)
        mine, theirs = (
            A[begin:].reshape(N, -1, A.shape[1]) for A in (program.A.toarray(), whole.A)
        )
        assert mine.shape[1] == SLOTS
        # Sizes are numbered as the obstacles: those are one further where the far one comes first.
        columns = slice(0, N * (this.model.nx + this.model.nu))
        np.testing.assert_allclose(mine[:, :slots, columns], theirs[:, :slots, columns], atol=1e-7)
        assert not mine[:, slots:].any()
        lower = program.lower[begin:].reshape(N, SLOTS)
        expected = whole.lower[begin:].reshape(N, -1)
        np.testing.assert_allclose(lower[:, :slots], expected[:, :slots], atol=1e-7)
        assert (lower[:, slots:] == -np.inf).all()


def far_away():
    return ObstaclePrediction.static(N, [50.0, 50.0], 0.2)


def test_no_zero_is_stored_in_the_hessian():
    """With diagonal weights, one entry for each state, input and size; none for the slack."""
    M = 12
    ref = straight_reference(30)
    for s_min, sizes in ((0.5, M), (S_REF, 0)):
        this = problem(30, "exact", s_min, max_obstacles=M)
        for elastic in (False, True):
            P = SCP(this).subproblem(ref[0], ref, elastic=elastic).P
            assert P.nnz == 30 * 6 + sizes


@BOTH
@pytest.mark.parametrize("nodes_per_interval", [1, 3])
@pytest.mark.parametrize("case", ["plane", "bounds", "unicycle", "bicycle"])
def test_updated_equals_freshly_built_and_keeps_its_pattern(case, nodes_per_interval, elastic):
    this, x0, x_ref, things = CASES[case](nodes_per_interval=nodes_per_interval)
    last = np.zeros(this.model.nu)
    used, given = SCP(this), (x0, x_ref, things, about(this, x0))
    first = used.subproblem(*given, elastic=elastic, u_last=last)
    moved = x0 + 0.1
    for other in (True, False):  # another step, another kind, another number of obstacles
        used.subproblem(moved, 0 * x_ref, things[1:], about(this, moved, 5), elastic=other)
    used.solve(moved, x_ref, things[:1])
    again = used.subproblem(*given, elastic=elastic, u_last=last)
    fresh = SCP(this).subproblem(*given, elastic=elastic, u_last=last)
    for program in (again, fresh):
        for name in ("q", "lower", "upper"):
            np.testing.assert_array_equal(getattr(program, name), getattr(first, name))
        for name in ("P", "A"):
            mine, theirs = getattr(program, name), getattr(first, name)
            np.testing.assert_array_equal(mine.indices, theirs.indices)
            np.testing.assert_array_equal(mine.indptr, theirs.indptr)
            np.testing.assert_array_equal(mine.data, theirs.data)
    different = used.subproblem(moved, x_ref, things[:1], elastic=elastic)
    np.testing.assert_array_equal(different.A.indices, first.A.indices)
    np.testing.assert_array_equal(different.A.indptr, first.A.indptr)
    np.testing.assert_array_equal(different.P.indices, first.P.indices)


def test_what_is_handed_out_is_the_callers_own():
    this, x0, x_ref, things = linear()
    solver = SCP(this)
    expected = solver.solve(x0, x_ref, things)
    program = solver.subproblem(x0, x_ref, things)
    for values in (program.P.data, program.q, program.A.data, program.lower, program.upper):
        values[:] = np.nan
    np.testing.assert_array_equal(solver.solve(x0, x_ref, things).U, expected.U)


@cache
def converged(name, kind):
    """A step, its plan, and the program about it; None where no program has the plan's forces."""
    case = instance(kind, 8, "exact", 0.5, 1) if name == "linear" else ride(name, kind, 8, 1)
    scp = SCP(case.problem, Settings(tolerance=1e-9, max_iterations=200))
    given = case.x0, case.x_ref, case.obstacles
    plan = scp.solve(*given)
    if not plan.status.certified:
        assert plan.status is Status.STOPPING  # the plan with slack is faster than braking
        program = None
    elif not plan.ok and -plan.multipliers.obstacles.min() > case.problem.slack_weight:
        program = None  # states yielded while obstacles held, with more than an elastic one allows
    else:
        program = scp.subproblem(*given, guess=plan.iterate, elastic=not plan.ok)
    return case, plan, program


@pytest.mark.parametrize("solver", ["clarabel", "piqp"])
@pytest.mark.parametrize("kind", ["ahead", "beside", "crossing", "elongated"])
@pytest.mark.parametrize("name", ["linear", *MODELS])
def test_at_convergence_others_solve_it_with_the_plan(name, kind, solver):
    case, plan, program = converged(name, kind)
    if program is None:
        return
    z, y = solution(program, solver)
    e, u = np.split(z[: 8 * (case.problem.model.nx + plan.U.shape[1])], [8 * plan.X.shape[1]])
    np.testing.assert_allclose(u, plan.U.ravel(), atol=1e-5)
    np.testing.assert_allclose(e, (plan.X - case.x_ref)[1:].ravel(), atol=1e-5)
    if not plan.ok:
        return
    value = z @ (program.P @ z) / 2 + program.q @ z
    idle, size = case.problem.model.equilibrium_input, case.problem.size
    constant = 8 * idle @ case.problem.R @ idle
    if size.lower < size.reference:
        constant += size.weight * size.reference**2
    assert value + constant == pytest.approx(plan.cost, rel=1e-6)
    pushed = -plan.multipliers.obstacles.sum()
    assert -y[-8:].sum() == pytest.approx(pushed, rel=1e-3, abs=1e-4)


def test_at_convergence_an_elastic_one_is_solved_with_the_same_slack():
    this, ref = problem(8), straight_reference(8, -4.0)
    ref[0] = 0.0
    blocking = [obstacle(8, (1.2, 0.05), covariance=np.eye(2), growth=0.0)]
    scp = SCP(this, Settings(tolerance=1e-9))
    plan = scp.solve(ref[0], ref, blocking)
    assert plan.status is Status.SOFTENED
    program = scp.subproblem(ref[0], ref, blocking, guess=plan.iterate, elastic=True)
    coupling = couplings_of(program, this)[1]
    z, _ = solution(program, "clarabel")
    np.testing.assert_allclose(z[8 * 4 : 8 * 6], plan.U.ravel(), atol=1e-4)
    np.testing.assert_allclose(coupling * z[-8:], plan.slack[0], atol=1e-5)


def begun(case="bounds", **changes):
    """A transcription of a step, a plan in it with forces, and its written program."""
    this, x0, x_ref, things = CASES[case](**changes)
    at = Transcription(this, Settings(), SCP(this)._nodes)
    at.begin(Step.read(this, x0, x_ref, things, nodes=at.nodes, u_last=np.zeros(2)), Clock())
    rng, plan = np.random.default_rng(0), about(this, x0)
    y, rolled = at.rolled(plan.inputs, rng.uniform(0.5, 2.0, 2))
    everybody = np.ones(at.step.radii.shape, dtype=bool)
    pairs = Pairs(at.step, at.layout, everybody)
    reaction = rng.normal(size=at.layout.size - at.layout.boxed.start)
    force = rng.uniform(size=len(pairs.node))
    return at, at.nominal(y, rolled, reaction, pairs, force)


@pytest.mark.parametrize("relaxation", list(Relaxation))
@pytest.mark.parametrize("case", ["plane", "bounds", "bicycle"])
def test_a_start_and_what_is_read_from_it_are_inverse(case, relaxation):
    at, nominal = begun(case)
    program = at.write(nominal, at.linearise(nominal), nominal.planes, relaxation)
    rows, (z, y) = program.rows, at.start(program, nominal)
    nx, nu = at.problem.model.nx, at.problem.model.nu
    deviations, inputs, rest = np.split(z, [N * nx, N * (nx + nu)])
    np.testing.assert_array_equal(inputs.reshape(N, nu), nominal.rollout.inputs)
    np.testing.assert_array_equal(deviations.reshape(N, nx), nominal.rollout.deviations)
    moving = at.layout.moving
    np.testing.assert_array_equal(rest[:moving], nominal.y[at.layout.s][:moving])
    boxed = nominal.y[at.layout.boxed][: moving + N * nu]
    np.testing.assert_array_equal(program.subproblem.box(z), boxed)
    forces = np.concatenate([nominal.reaction, nominal.force])
    np.testing.assert_array_equal(rows.forces(y), forces)
    np.testing.assert_array_equal(y[: nominal.costates.size].reshape(N, -1), nominal.costates)
    active, _ = rows.active(y, 0.0)
    np.testing.assert_array_equal(active, -np.sign(forces))


def test_what_rounding_lets_through_is_clipped():
    at, _ = begun("plane")
    this, high = at.problem, np.full((N, 2), 99.0)
    for inputs, bound in ((high, this.u_max), (-high, this.u_min)):
        y, rolled = at.rolled(inputs, np.full(2, 99.0 * np.sign(inputs[0, 0])))
        assert (rolled.inputs == bound).all()
        assert (y[at.layout.u].reshape(N, 2) == bound).all()
        size = this.size
        assert (y[at.layout.s] == (size.upper if inputs is high else size.lower)).all()


def test_inputs_are_moved_into_their_rates():
    this = problem(N, du_min=-0.3, du_max=0.2)
    at = Transcription(this, Settings(), SCP(this)._nodes)
    last, rng = np.array([1.0, -1.0]), np.random.default_rng(0)
    at.begin(Step.read(this, np.zeros(4), np.zeros(4), [], nodes=at.nodes, u_last=last), Clock())
    _, rolled = at.rolled(rng.normal(scale=3.0, size=(N, 2)), np.full(1, S_REF))
    change = np.diff(np.vstack([last, rolled.inputs]), axis=0)
    assert (change >= -0.3 - 1e-9).all()
    assert (change <= 0.2 + 1e-9).all()


@pytest.mark.parametrize("case", ["plane", "fixed size", "quadrotor", "bicycle"])
def test_the_objective_is_the_problems_cost(case):
    this, x0, x_ref, things = CASES[case]()
    plan = about(this, x0, 3)
    program = SCP(this).subproblem(x0, x_ref, things, guess=plan)
    size, nu = this.size, this.model.nu
    s = np.random.default_rng(0).uniform(0.5, 3.0, 2)
    moving = size.lower < size.reference
    s = s if moving else np.full(2, size.reference)
    z = np.concatenate([(plan.states - x_ref)[1:].ravel(), plan.inputs.ravel(), s[: 2 * moving]])
    constant = N * this.model.equilibrium_input @ this.R @ this.model.equilibrium_input
    constant += 2 * moving * size.weight * size.reference**2
    value = z @ (program.P @ z) / 2 + program.q @ z + constant
    assert len(z) == len(program.q) == N * (this.model.nx + nu) + 2 * moving
    cost = this.cost(plan.states, plan.inputs, s, x_ref)
    assert value == pytest.approx(cost, rel=1e-9)


def test_blocks_refuse_to_overlap():
    blocks = SparseBlocks()
    blocks.add("one", [0, 1], [0, 1], 1.0)
    blocks.add("two", [1], [1], 2.0)
    with pytest.raises(ValueError, match="same entry"):
        blocks.build((2, 2))


def test_blocks_keep_zeros_in_the_pattern():
    blocks = SparseBlocks()
    blocks.add("values", [[2, 0], [1, 0]], [[0, 1], [1, 0]], [[0.0, 3.0], [4.0, 5.0]])
    matrix, places = blocks.build((3, 2))
    assert matrix.nnz == 4
    matrix.data[places["values"]] = [1.0, 2.0, 3.0, 4.0]
    np.testing.assert_array_equal(matrix.toarray(), [[4, 2], [0, 3], [1, 0]])


@pytest.mark.parametrize("case", ["plane", "unicycle"])
def test_an_elastic_program_holds_a_crowd(case):
    """With fewer half-spaces at each node than it takes, programs with slack are not solved."""
    this, x0, x_ref, _ = CASES[case]()
    this, rng = replace(this, max_obstacles=6), np.random.default_rng(4)
    crowd = [ObstaclePrediction.static(N, 0.4 * rng.normal(size=2), 0.2) for _ in range(6)]
    plan = about(this, x0)
    program = SCP(this).subproblem(x0, x_ref, crowd, guess=plan, elastic=True)
    couplings = couplings_of(program, this)
    equal(program, rebuilt(this, x0, x_ref, crowd, plan.inputs, True, None, couplings))
