"""Who solves the programs: what they refuse, survive and forget, and who rescues whom."""

from collections import Counter

import numpy as np
import osqp
import piqp
import pytest
from driving import N, drive
from instances import S_REF, instance, obstacle, problem, straight_reference
from nonlinear_cases import machine_problem, ride
from scipy import sparse
from solving import solution

from scp_mpc import MPC, SCP, QPSettings, Settings, Status
from scp_mpc.deadline import Clock
from scp_mpc.errors import BoundsError, InvalidArgumentError, NotFiniteError
from scp_mpc.qp.active_set import CondensedQP
from scp_mpc.qp.backend import ProgramSolver, Rows, backend, require_solver
from scp_mpc.qp.osqp import OSQP
from scp_mpc.qp.others import PIQP, installed, known
from scp_mpc.qp.program import KKTResiduals, QuadraticProgram, bounded

EQUATIONS = np.arange(3)
LONG = QPSettings(iterations=(4000,), repairs=(0,), rho=(1.0,))
NAMES = ["osqp", "piqp", *installed()]


def program(seed=0, n=12, m=20):
    """A random feasible program with equations, one-sided, two-sided and free rows."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(n, n))
    A = sparse.csc_matrix(rng.normal(size=(m, n)))
    inside = A @ rng.normal(size=n)
    lower, upper = inside - rng.uniform(0, 1, m), inside + rng.uniform(0, 1, m)
    lower[:3] = upper[:3] = inside[:3]
    lower[3:6], upper[6:9] = -np.inf, np.inf
    lower[9], upper[9] = -np.inf, np.inf
    return QuadraticProgram(
        sparse.csc_matrix(root @ root.T + np.eye(n)), rng.normal(size=n), A, lower, upper
    )


def write(p, other):
    """Write another program's values into this one's."""
    p.P.data[:], p.A.data[:] = other.P.data, other.A.data
    p.q[:], p.lower[:], p.upper[:] = other.q, other.lower, other.upper


def start():
    return np.zeros(12), np.zeros(20)


def solved(solver, begin=None, effort=4000):
    solver.load(start() if begin is None else begin)
    point = solver.run(effort)
    assert point is not None
    return point


def made(name, p, settings=LONG):
    return backend(p, EQUATIONS, name, settings)


# All backends


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", range(5))
def test_all_agree_with_each_other(name, seed):
    p = program(seed)
    x, y = solved(made(name, p))
    expected = solution(p, "clarabel")
    np.testing.assert_allclose(x, expected[0], atol=1e-3)
    np.testing.assert_allclose(y, expected[1], atol=1e-2)
    if name in ("osqp", "piqp", "clarabel"):
        np.testing.assert_allclose(x, expected[0], atol=1e-6)
        assert p.residuals(x, y).worst < 1e-6


@pytest.mark.parametrize("name", ["osqp", "piqp", "clarabel"])
def test_rewritten_values_mean_what_fresh_ones_do(name):
    p = program(0)
    solver = made(name, p)
    solved(solver)
    for seed in (1, 2):
        write(p, program(seed))
        mine, fresh = solved(solver), solved(made(name, program(seed)))
        np.testing.assert_allclose(mine[0], fresh[0], atol=1e-7)
        np.testing.assert_allclose(mine[1], fresh[1], atol=1e-5)


@pytest.mark.parametrize("name", ["osqp", "piqp", "clarabel"])
def test_bounds_may_come_and_go(name):
    """A row that has none, then one, then the other, then both: whatever it was set up with."""
    p = program(0)
    for rows in (slice(3, 20), slice(9, 12)):
        begun = program(0)
        begun.lower[rows], begun.upper[rows] = -np.inf, np.inf
        solver = made(name, begun)
        for low, up in ((1, 1), (0, 1), (1, 0), (0, 0), (1, 1)):
            write(begun, p)
            if not low:
                begun.lower[rows] = -np.inf
            if not up:
                begun.upper[rows] = np.inf
            x, _ = solved(solver)
            np.testing.assert_allclose(x, solution(begun)[0], atol=1e-5)


@pytest.mark.parametrize("name", ["osqp", "piqp", "clarabel"])
def test_the_program_is_never_written_to(name):
    p = program()
    arrays = p.P.data, p.P.indices, p.q, p.A.data, p.A.indices, p.A.indptr, p.lower, p.upper
    before, begin = [a.tobytes() for a in arrays], start()
    solver = made(name, p)
    for _ in range(2):
        solved(solver, begin)
    assert before == [a.tobytes() for a in arrays]
    assert not begin[0].any()
    assert not begin[1].any()


@pytest.mark.parametrize("name", ["osqp", "piqp", "clarabel"])
def test_points_are_the_callers_own(name):
    p = program()
    solver = made(name, p)
    x, y = solved(solver)
    kept = x.copy(), y.copy()
    write(p, program(1))
    solved(solver)
    np.testing.assert_array_equal(x, kept[0])
    np.testing.assert_array_equal(y, kept[1])


@pytest.mark.parametrize("name", NAMES)
def test_what_has_no_solution_never_looks_like_one(name):
    p = program()
    solver = made(name, p)
    expected = solved(solver)
    p.A.data[:] = 0.0
    p.lower[:], p.upper[:] = 1.0, 1.0
    solver.load(start())
    point = solver.run(50)
    if point is not None:
        assert np.isfinite(point[0]).all()  # not 2143289344.0 either
        assert np.abs(point[0]).max() < 1e6
        assert p.residuals(*point).worst > 0.5
    write(p, program())
    np.testing.assert_allclose(solved(solver)[0], expected[0], atol=1e-6)


@pytest.mark.parametrize("name", ["osqp", "piqp", "clarabel"])
def test_nothing_is_printed(name, capfd):
    free = QuadraticProgram(
        sparse.csc_matrix(np.eye(12)),
        np.zeros(12),
        sparse.csc_matrix(np.ones((20, 12))),
        np.full(20, -np.inf),
        np.full(20, np.inf),
    )
    for p in (free, program()):
        solver = backend(p, np.arange(0), name, LONG)
        for _ in range(2):
            solved(solver)
        p.lower[:], p.upper[:] = 1e3, 1e3 + 1
        solver.load(start())
        solver.run(20)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("solver", ["osqp", "piqp"])
def test_driving_prints_nothing(solver, capfd):
    drive(MPC(problem(N), Settings(solver=solver)), 3)
    machine = machine_problem("unicycle", N)
    MPC(machine, Settings(solver=solver)).step(np.zeros(4), np.zeros(4))
    ref = straight_reference(8, 4.0)
    blocking = [obstacle(8, (1.2, 0.05), covariance=np.eye(2))]
    assert not SCP(problem(8), Settings(solver=solver)).solve(ref[0], ref, blocking).ok
    assert capfd.readouterr() == ("", "")


def test_solvers_are_known_by_name():
    assert {"clarabel", "osqp", "piqp"} <= {*NAMES}
    for name in NAMES:
        require_solver(name)
        assert made(name, program()).name == name
    missing = sorted(set(known()) - set(installed()))[0]
    for name in (missing, "nonsense", "", "OSQP", 3):
        with pytest.raises(InvalidArgumentError, match="solver"):
            made(name, program())


# OSQP


@pytest.mark.parametrize(
    ("name", "bad", "error"),
    [
        ("q", np.nan, NotFiniteError),
        ("q", np.inf, NotFiniteError),
        ("q", -np.inf, NotFiniteError),
        ("A", np.nan, NotFiniteError),
        ("A", np.inf, NotFiniteError),
        ("P", np.nan, NotFiniteError),
        ("P", np.inf, NotFiniteError),
        ("lower", np.nan, NotFiniteError),
        ("upper", np.nan, NotFiniteError),
        ("lower", 1e3, BoundsError),
        ("upper", -1e3, BoundsError),
    ],
)
@pytest.mark.parametrize("everywhere", [True, False])
def test_bad_values_are_refused_and_leave_no_trace(name, bad, error, everywhere, capfd):
    p, twin = program(), program()
    solver, other = made("osqp", p), made("osqp", twin)
    solved(solver)
    solved(other)
    array = {"q": p.q, "A": p.A.data, "P": p.P.data, "lower": p.lower, "upper": p.upper}[name]
    array[slice(None) if everywhere else 12 % len(array)] = bad
    with pytest.raises(error):
        solver.load(start())
    write(p, program())
    np.testing.assert_array_equal(solved(solver)[0], solved(other)[0])
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("part", [0, 1])
def test_a_bad_warm_start_is_refused_and_leaves_no_trace(part, bad):
    solver, begin = made("osqp", program()), start()
    expected = solved(solver)[0]
    begin[part][2] = bad
    with pytest.raises(NotFiniteError):
        solver.load(begin)
    np.testing.assert_array_equal(solved(solver)[0], expected)


@pytest.mark.parametrize("part", [0, 1])
def test_a_huge_warm_start_is_refused_or_survived(part):
    solver, begin = made("osqp", program()), start()
    expected = solved(solver)[0]
    begin[part][2] = 1e200
    try:
        solver.load(begin)
        solver.run(10)
    except NotFiniteError:
        pass
    np.testing.assert_array_equal(solved(solver)[0], expected)


def test_a_load_restores_bit_identity():
    """Whatever was solved before: the same values from the same start give the same bits."""
    p = program()
    fresh = [solved(made("osqp", program()), effort=k) for k in (10, 25)]
    used = made("osqp", p)
    for seed in (1, 2, 3):
        write(p, program(seed))
        used.load((np.ones(12), np.ones(20)))
        for effort in (10, 25, 50):
            used.run(effort)
    write(p, program())
    for effort, expected in zip((10, 25), fresh, strict=True):
        again = solved(used, effort=effort)
        np.testing.assert_allclose(again[0], expected[0], rtol=1e-9, atol=1e-12)


def named(y):
    """The active set that multipliers name, rounding aside."""
    return np.sign(np.where(np.abs(y) > 1e-9, y, 0.0))[3:]


def test_a_warm_start_at_the_optimum_cuts_iterations():
    """From the optimum the multipliers name the active set at once; from nothing much later."""
    count = Counter()
    for seed in range(5):
        p = program(seed)
        solver = made("osqp", p)
        optimum = solved(solver)
        right = named(optimum[1])
        for name, begin in (("warm", optimum), ("cold", start())):
            solver.load(begin)
            for _ in range(400):
                count[name] += 1
                if (named(solver.run(1)[1]) == right).all():
                    break
    assert count["warm"] == 5
    assert count["cold"] > 10 * count["warm"]


def test_a_start_replaces_what_the_last_program_left_behind():
    p = program(0)
    solver = made("osqp", p)
    optimum = solved(solver)
    for seed in (1, 0):
        write(p, program(seed))
        solver.load(optimum if seed == 0 else start())
        x, _ = solver.run(3)
    np.testing.assert_allclose(x, optimum[0], atol=1e-6)


def test_iterations_are_counted_from_the_last_load():
    solver = made("osqp", program())
    solver.load(start())
    for effort in (10, 25):
        solver.run(effort)
    assert solver.iterations == 35
    solver.load(start())
    assert solver.iterations == 0


# Set-ups


def counted(monkeypatch):
    """Counts set-ups of both solvers."""
    count = Counter()
    for owner, name in ((osqp.OSQP, "osqp"), (piqp.SparseSolver, "piqp")):
        inner = owner.setup

        def setup(self, *given, inner=inner, name=name, **options):
            count[name] += 1
            return inner(self, *given, **options)

        monkeypatch.setattr(owner, "setup", setup)
    return count


@pytest.mark.parametrize("name", ["linear", "unicycle"])
def test_solvers_are_set_up_once_and_never_again(name, monkeypatch):
    """Whatever comes: other horizons of obstacles, softened ones, bounds, other sides."""
    count = counted(monkeypatch)
    if name == "linear":
        case = instance("elongated", 20, "exact", S_REF, 0)
        hard = problem(20, max_obstacles=2, x_max=[np.inf, 2.1, 0.6, 1.0], du_max=0.8, du_min=-0.8)
    else:
        case = ride("unicycle", "elongated", 20, 0)
        hard = machine_problem("unicycle", 20, max_obstacles=2, x_max=[np.inf] * 3 + [1.6])
    mpc = MPC(hard)
    before = dict(count)
    assert before["osqp"] == 2  # the hard program and the elastic one
    for present in (case.obstacles, [], case.obstacles * 2, case.obstacles):
        plan = mpc.step(case.x0, case.x_ref, present)
    plan = mpc.step(case.x0, case.x_ref, [obstacle(20, (0.3, 0.0))])
    assert not plan.ok
    mpc.reset()
    mpc.step(case.x0, case.x_ref, case.obstacles)
    assert dict(count) == before


# Programs, condensed and sparse


def pair(seed=0, n=10, K=6):
    """A condensed program, the same as a sparse one, and which row is which."""
    rng = np.random.default_rng(seed)
    F, A = rng.normal(size=(n, n)) / np.sqrt(n), rng.normal(size=(K, n)) / np.sqrt(n)
    inside = rng.normal(size=n) * 0.5
    lower = np.minimum(F @ inside, 0.0) - rng.uniform(0, 0.3, n)
    upper = np.maximum(F @ inside, 0.0) + rng.uniform(0, 0.3, n)
    b = A @ inside - rng.uniform(0, 0.1, K)
    qp = CondensedQP(F, lower, upper, A, b, np.linalg.inv(F))
    rows, matrix = np.arange(n + K), sparse.csc_matrix(np.vstack([F, A]))
    sparse_qp = QuadraticProgram(
        sparse.csc_matrix(np.eye(n)), np.zeros(n), matrix,
        np.concatenate([lower, b]), np.concatenate([upper, np.full(K, np.inf)]),
    )  # fmt: skip
    return qp, sparse_qp, Rows(rows)


def asked(seed, name="osqp", settings=None):
    qp, p, rows = pair(seed)
    solver = ProgramSolver(p, np.arange(0), name, QPSettings() if settings is None else settings)
    end = solver.solve(qp, rows, (np.zeros(10), np.zeros(16)), Clock())
    return solver, end.solution, p


@pytest.mark.parametrize("name", ["osqp", "piqp", "clarabel"])
@pytest.mark.parametrize("seed", range(8))
def test_solutions_are_exact_whoever_was_asked(seed, name):
    solver, end, p = asked(seed, name)
    x, _ = solution(p)
    np.testing.assert_allclose(end.v, x, atol=1e-5)
    y = -end.force
    assert p.residuals(end.v, y).worst < 1e-8
    assert sum(solver.finished.values()) == 1
    assert set(solver.finished) <= {name, "repaired", "piqp"}


def test_what_osqp_does_not_finish_goes_to_piqp_and_else_to_nobody(monkeypatch):
    monkeypatch.setattr(OSQP, "run", lambda *_: None)
    solver, end, p = asked(0)
    assert solver.finished == {"piqp": 1}
    np.testing.assert_allclose(end.v, solution(p)[0], atol=1e-5)
    alone, nothing, _ = asked(0, settings=QPSettings(rescue=False))
    assert nothing is None
    assert sum(alone.finished.values()) == 0
    qp, p, rows = pair(0)
    solver = ProgramSolver(p, np.arange(0), "osqp", QPSettings())
    end = solver.solve(qp, rows, (np.zeros(10), np.zeros(16)), Clock(deadline=1e-9))
    assert end.late
    assert end.solution is None


def test_nothing_inaccurate_comes_out(monkeypatch):
    """A point near the solution that names another active set is not handed out as it is."""
    for seed in range(8):
        qp, p, rows = pair(seed)
        x, y = solution(p)
        wrong = np.where(np.arange(16) % 3 == 0, -np.sign(y) - (y == 0), y)
        for backend_ in (OSQP, PIQP):
            monkeypatch.setattr(backend_, "run", lambda *_, x=x, wrong=wrong: (x, wrong))
        solver = ProgramSolver(p, np.arange(0), "osqp", QPSettings())
        end = solver.solve(qp, rows, (np.zeros(10), np.zeros(16)), Clock()).solution
        assert end is None or p.residuals(end.v, -end.force).worst < 1e-8
        monkeypatch.undo()


def test_what_has_no_solution_is_proved_to_have_none_and_piqp_not_asked(monkeypatch):
    qp, p, rows = pair(0)
    p.lower[-2:], qp.b[-2:] = 5.0, 5.0
    p.A[[-1]] = -p.A[[-2]]
    qp.A[-1] = -qp.A[-2]
    monkeypatch.setattr(PIQP, "run", lambda *_: pytest.fail("PIQP was asked"))
    solver = ProgramSolver(p, np.arange(0), "osqp", QPSettings())
    end = solver.solve(qp, rows, (np.zeros(10), np.zeros(16)), Clock())
    assert end.infeasible
    assert end.solution is None
    assert solver.finished == {"infeasible": 1}


@pytest.mark.parametrize("seed", range(8))
def test_ranks_are_lower_bounds_and_cut_what_is_beyond_the_limit(seed):
    qp, p, rows = pair(seed)
    optimum = qp.merit(solution(p)[0])
    solver, begin = (
        ProgramSolver(p, np.arange(0), "osqp", QPSettings()),
        (np.zeros(10), np.zeros(16)),
    )
    bound, (x, y) = solver.rank(qp, rows, begin, np.inf)
    assert 0 <= bound <= optimum * (1 + 1e-9)
    assert x.shape == (10,)
    assert y.shape == (16,)
    assert solver.finished == {"ranked": 1}
    if bound > 1e-6:
        cut, _ = solver.rank(qp, rows, begin, bound / 2)
        assert cut == np.inf
        assert solver.finished == {"ranked": 1, "cut": 1}


def test_rows_without_a_slot_push_nobody():
    rows = Rows(np.array([2, -1, 0]))
    y = np.array([-3.0, 5.0, 2.0])
    np.testing.assert_array_equal(rows.forces(y), [-2.0, 0.0, 3.0])
    active, relaxed = rows.active(y, 0.0)
    np.testing.assert_array_equal(active, [1, 0, -1])
    assert not relaxed.any()
    np.testing.assert_array_equal(rows.active(y, 0.5)[0], [0, 0, -1])


def test_a_row_yields_where_its_slack_is_not_pinned():
    place, below = np.array([0, 1]), np.array([2, 3])
    rows = Rows(place, below, np.array([-1, -1]))
    active, relaxed = rows.active(np.array([-1.0, -1.0, 0.0, -0.5]), 0.0)
    np.testing.assert_array_equal(active, [-1, -1])
    np.testing.assert_array_equal(relaxed, [True, False])


# The whole solver with each of them


@pytest.mark.parametrize("kind", ["ahead", "crossing", "elongated"])
@pytest.mark.parametrize("name", ["linear", "unicycle", "bicycle"])
def test_plans_do_not_depend_on_who_solves_the_programs(name, kind):
    case = instance(kind, 12, "exact", 0.5, 0) if name == "linear" else ride(name, kind, 12, 0)
    plans = {
        solver: SCP(case.problem, Settings(solver=solver, multi_start=False, tolerance=1e-8)).solve(
            case.x0, case.x_ref, case.obstacles
        )
        for solver in ("osqp", "piqp", "clarabel")
    }
    first = plans["osqp"]
    for solver, plan in plans.items():
        assert plan.status is first.status is Status.CONVERGED
        assert set(plan.qps) <= {solver, "repaired", "piqp", "kkt", "infeasible"}
        assert plan.cost == pytest.approx(first.cost, rel=1e-8)
        np.testing.assert_allclose(plan.U, first.U, atol=1e-5)
        forces = plan.multipliers.obstacles, first.multipliers.obstacles
        np.testing.assert_allclose(*forces, atol=1e-4)


def test_osqp_settles_most_programs_at_once():
    """Its first run and one linear system: a wrong scale would leave results right, and be slow."""
    case, count = problem(30), Counter()
    mpc, x = MPC(case), np.array([0.0, 2.0, 0.05, 0.0])
    for k in range(40):
        ref = straight_reference(30) + [0.4 * k, 0, 0, 0]
        thing = obstacle(30, (5.0 + 0.06 * k, 0.0), (0.3, 0.0))
        plan = mpc.step(x, ref, [thing])
        count += Counter(plan.qps)
        x = case.model.step(x, plan.u0)
    solved_by = {name: count[name] for name in ("osqp", "repaired", "piqp")}
    whole = sum(solved_by.values())
    assert whole > 20
    assert solved_by["osqp"] >= 0.75 * whole
    assert solved_by["piqp"] <= 0.02 * whole


# Residuals


def test_residuals_of_a_wrong_sign_are_seen():
    p = program()
    x, y = solution(p)
    assert p.residuals(x, y).worst < 1e-7
    assert p.residuals(x, -y).stationarity > 1e-2
    assert p.residuals(x + 1.0, y).feasibility > 1e-2
    loose = QuadraticProgram(p.P, p.q, p.A, np.full(20, -np.inf), np.full(20, np.inf))
    for name, sign in (("upper", 1), ("lower", -1)):
        getattr(loose, name)[4] = (p.A @ x)[4] - sign * 0.3  # one bound, one side
        assert loose.residuals(x, y).feasibility == pytest.approx(0.3)
        getattr(loose, name)[4] = sign * np.inf
    slack = y.copy()
    slack[9] = 1.0  # a free row cannot push
    assert p.residuals(x, slack).complementarity > 0.05
    assert p.residuals(np.full(12, np.nan), y).worst == np.inf


def test_the_worst_residual_is_of_the_first_order_and_knows_nan():
    assert KKTResiduals(1.0, 3.0, 2.0).worst == 3.0
    assert KKTResiduals(1.0, 3.0, 2.0, -9.0).worst == 3.0
    for which in range(3):
        values = [0.0] * 3
        values[which] = np.nan
        assert KKTResiduals(*values).worst == np.inf


def test_bounds_that_are_none_become_finite_ones_far_from_the_other_side():
    inf = np.inf
    lower, upper = bounded(np.array([-inf, 1.0, -inf, 2.0]), np.array([5.0, inf, inf, 3.0]), 100.0)
    np.testing.assert_array_equal(lower, [-95.0, 1.0, -100.0, 2.0])
    np.testing.assert_array_equal(upper, [5.0, 101.0, 100.0, 3.0])


def test_a_copy_has_arrays_of_its_own():
    p = program()
    copy = p.copy()
    for array in (copy.P.data, copy.q, copy.A.data, copy.lower, copy.upper):
        array[:] = 7.0
    twin = program()
    for name in ("q", "lower", "upper"):
        np.testing.assert_array_equal(getattr(p, name), getattr(twin, name))
    np.testing.assert_array_equal(p.A.data, twin.A.data)
    np.testing.assert_array_equal(p.P.data, twin.P.data)
