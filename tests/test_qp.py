"""The guarded OSQP class: what it refuses, what it survives, what it forgets."""

import numpy as np
import pytest
from scipy import sparse

from scp_mpc.errors import BoundsError, InvalidArgumentError, NotFiniteError, ShapeError
from scp_mpc.settings import QPSettings
from scp_mpc.solver.oracle import Oracle
from scp_mpc.solver.program import QuadraticProgram
from scp_mpc.solver.qp import OSQPSolver, QPStatus
from scp_mpc.solver.rescue import RescueSolver
from scp_mpc.solver.trusted import TrustedSolver


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


def values(p):
    """A fresh set of arguments for `update`."""
    return {"q": p.q + 0, "A_data": p.A.data + 0, "lower": p.lower + 0, "upper": p.upper + 0}


def solved(solver):
    solution = solver.solve(np.zeros(12), np.zeros(20))
    assert solution.status is QPStatus.SOLVED
    return solution


@pytest.mark.parametrize("seed", range(5))
def test_osqp_the_rescue_and_the_oracle_agree(seed):
    p = program(seed)
    osqp = solved(OSQPSolver(p, QPSettings()))
    rescue = RescueSolver(p).solve()
    oracle = Oracle("clarabel").solve(p)
    assert (osqp.solver, rescue.solver, oracle.solver) == ("osqp", "piqp", "clarabel")
    for other in (rescue, oracle):
        np.testing.assert_allclose(osqp.x, other.x, atol=1e-6)
        np.testing.assert_allclose(osqp.y, other.y, atol=1e-5)
    assert p.residuals(osqp.x, osqp.y).worst < 1e-7
    assert p.residuals(rescue.x, rescue.y).worst < 1e-7


def test_the_rescue_reads_new_values_and_new_equations():
    p, other = program(0), program(1)
    rescue = RescueSolver(p)
    rescue.solve()
    for name in ("q", "lower", "upper"):
        getattr(p, name)[:] = getattr(other, name)
    p.A.data[:] = other.A.data
    p.lower[12] = p.upper[12]
    again, fresh = rescue.solve(), Oracle("clarabel").solve(p)
    np.testing.assert_allclose(again.x, fresh.x, atol=1e-6)
    p.lower[0], p.upper[0] = 2.0, 2.0
    p.A.data[p.A.indices == 0] = 0.0
    assert rescue.solve().status is QPStatus.INFEASIBLE


def test_unknown_oracle_is_refused_at_construction():
    with pytest.raises(InvalidArgumentError, match="nonsense"):
        Oracle("nonsense")


def test_updated_equals_freshly_built():
    first, second = program(0), program(1)
    solver = OSQPSolver(first, QPSettings())
    solved(solver)
    fresh = QuadraticProgram(first.P, second.q, second.A, second.lower, second.upper)
    solver.update(**values(second))
    np.testing.assert_allclose(
        solved(solver).x, solved(OSQPSolver(fresh, QPSettings())).x, atol=1e-8
    )


@pytest.mark.parametrize(
    ("name", "bad", "error"),
    [
        ("q", np.zeros(11), ShapeError),
        ("q", np.zeros(13), ShapeError),
        ("A_data", np.zeros(7), ShapeError),
        ("lower", np.zeros(3), ShapeError),
        ("upper", np.zeros((20, 1)), ShapeError),
        ("q", np.full(12, np.nan), NotFiniteError),
        ("q", np.full(12, np.inf), NotFiniteError),
        ("A_data", np.full(240, np.nan), NotFiniteError),
        ("lower", np.full(20, np.nan), NotFiniteError),
        ("upper", np.full(20, np.nan), NotFiniteError),
        ("lower", np.full(20, 1e3), BoundsError),
        ("upper", np.full(20, -1e3), BoundsError),
    ],
)
def test_bad_values_are_refused_and_leave_no_trace(name, bad, error, capfd):
    p = program()
    solver = OSQPSolver(p, QPSettings())
    before = solved(solver)
    with pytest.raises(error, match=name if error is not BoundsError else "lower"):
        solver.update(**{**values(p), name: bad})
    after = solved(solver)
    np.testing.assert_array_equal(before.x, after.x)
    assert capfd.readouterr().out == ""


def test_misspelled_keyword_is_refused():
    p = program()
    with pytest.raises(TypeError):
        OSQPSolver(p, QPSettings()).update(**values(p), lowre=p.lower)


@pytest.mark.parametrize("bad", [np.full(12, np.nan), np.zeros(5)])
def test_bad_warm_start_is_refused(bad):
    solver = OSQPSolver(program(), QPSettings())
    with pytest.raises(InvalidArgumentError):
        solver.warm_start(bad, np.zeros(20))
    solved(solver)


def test_views_and_other_types_mean_the_same_numbers():
    p = program()
    plain = OSQPSolver(p, QPSettings())
    plain.update(**values(p))
    reference = solved(plain)
    doubled = {name: np.repeat(v, 2)[::2] for name, v in values(p).items()}
    backwards = {name: v[::-1].copy()[::-1] for name, v in doubled.items()}
    other = OSQPSolver(QuadraticProgram(p.P, p.q * 0, p.A, p.lower, p.upper), QPSettings())
    for solver, arguments in ((other, doubled), (other, backwards)):
        solver.update(**arguments)
        np.testing.assert_allclose(solved(solver).x, reference.x, atol=1e-9)
    whole = np.arange(12)
    other.update(**{**values(p), "q": whole})
    mine = solved(other).x
    other.update(**{**values(p), "q": whole.astype(np.float32)})
    np.testing.assert_allclose(solved(other).x, mine, atol=1e-9)


def test_arguments_are_never_written_to():
    p = program()
    solver = OSQPSolver(p, QPSettings())
    arguments = values(program(1))
    before = {name: v.tobytes() for name, v in arguments.items()}
    pattern = p.A.indices.tobytes(), p.A.indptr.tobytes(), p.A.data.tobytes()
    solver.update(**arguments)
    solved(solver)
    assert before == {name: v.tobytes() for name, v in arguments.items()}
    assert pattern == (p.A.indices.tobytes(), p.A.indptr.tobytes(), p.A.data.tobytes())


def test_infeasible_is_a_status_and_the_next_good_program_is_unaffected():
    p = program()
    solver = OSQPSolver(p, QPSettings(max_iterations=20000))
    fresh = solved(solver)
    bad = values(p)
    # 0 x = 1 has no solution.
    bad |= {"A_data": np.zeros(240), "lower": np.ones(20), "upper": np.ones(20)}
    solver.update(**bad)
    outcome = solver.solve()
    assert outcome.status is QPStatus.INFEASIBLE
    assert np.isnan(outcome.x).all()  # not 2143289344.0
    solver.update(**values(p))
    np.testing.assert_allclose(solved(solver).x, fresh.x, atol=1e-9)


def test_running_out_of_iterations_is_a_status():
    solver = OSQPSolver(program(), QPSettings(max_iterations=1, check_interval=1, eps=1e-12))
    assert solver.solve(np.zeros(12), np.zeros(20)).status is QPStatus.UNFINISHED


def test_reset_restores_bit_identity():
    p = program()
    fresh = OSQPSolver(p, QPSettings()).solve()
    used = OSQPSolver(p, QPSettings())
    for seed in (1, 2, 3):
        used.update(**values(program(seed)))
        used.solve()
    used.reset()
    again = used.solve()
    assert again.iterations == fresh.iterations
    np.testing.assert_array_equal(again.x, fresh.x)


def test_warm_start_at_the_optimum_cuts_iterations():
    p = program()
    solver = OSQPSolver(p, QPSettings(eps=1e-7))
    cold = solved(solver)
    warm = solver.solve(cold.x, cold.y)
    assert cold.iterations > 30
    assert warm.iterations <= 10


def test_a_warm_start_replaces_what_the_last_program_left_behind():
    p, other = program(0), program(1)
    solver = OSQPSolver(p, QPSettings(eps=1e-7, max_iterations=20000))
    optimum = solved(solver)
    solver.update(**values(other))
    solved(solver)
    solver.update(**values(p))
    assert solver.solve(optimum.x, optimum.y).iterations <= 10
    solver.update(**values(other))
    solved(solver)
    solver.update(**values(p))
    assert solver.solve().iterations > 10  # from where the other program ended


def test_stdout_stays_clean_where_no_constraint_is_active(capfd):
    """OSQP's polish announces an empty active set on standard output, whatever it is told."""
    n = 4
    free = QuadraticProgram(
        sparse.csc_matrix(np.eye(n)),
        np.zeros(n),
        sparse.csc_matrix(np.eye(n)),
        -np.ones(n),
        np.ones(n),
    )
    solution = OSQPSolver(free, QPSettings()).solve(np.full(n, 0.1), np.zeros(n))
    np.testing.assert_allclose(solution.x, 0.0, atol=1e-3)
    assert capfd.readouterr().out == ""


def test_what_osqp_does_not_finish_goes_to_the_rescue():
    p = program()
    hurried = TrustedSolver(p, QPSettings(max_iterations=1, check_interval=1, accuracy=1e-8))
    patient = TrustedSolver(p, QPSettings(accuracy=1e-8))
    zero = np.zeros(12), np.zeros(20)
    rescued, plain = hurried.solve(*zero), patient.solve(*zero)
    assert rescued is not None
    assert plain is not None
    assert (rescued.solver, plain.solver) == ("piqp", "osqp")
    assert hurried.finished == {"piqp": 1}
    np.testing.assert_allclose(rescued.x, plain.x, atol=1e-6)


def test_a_bad_start_goes_to_the_rescue_first():
    """The KKT residual of the start decides."""
    p = program()
    solver = TrustedSolver(p, QPSettings(cold=0.5))
    for residual, expected in ((0.4, "osqp"), (0.6, "piqp"), (0.0, "osqp")):
        assert solver.solve(np.zeros(12), np.zeros(20), residual).solver == expected
    alone = TrustedSolver(p, QPSettings(cold=0.5, rescue=False))
    assert alone.solve(np.zeros(12), np.zeros(20), 9.9).solver == "osqp"


def test_without_a_rescue_nothing_inaccurate_comes_out():
    settings = QPSettings(max_iterations=1, check_interval=1, rescue=False)
    assert TrustedSolver(program(), settings).solve(np.zeros(12), np.zeros(20)) is None


def test_residuals_of_a_wrong_sign_are_seen():
    p = program()
    good = solved(OSQPSolver(p, QPSettings()))
    assert p.residuals(good.x, good.y).worst < 1e-7
    assert p.residuals(good.x, -good.y).stationarity > 1e-2
    assert p.residuals(good.x + 1.0, good.y).feasibility > 1e-2
    loose = QuadraticProgram(p.P, p.q, p.A, np.full(20, -np.inf), np.full(20, np.inf))
    for name, sign in (("upper", 1), ("lower", -1)):
        getattr(loose, name)[4] = (p.A @ good.x)[4] - sign * 0.3  # one bound, one side
        assert loose.residuals(good.x, good.y).feasibility == pytest.approx(0.3)
        getattr(loose, name)[4] = sign * np.inf
    slack = good.y.copy()
    slack[9] = 1.0  # a free row cannot push
    assert p.residuals(good.x, slack).complementarity > 0.05
    assert p.residuals(np.full(12, np.nan), good.y).worst == np.inf
