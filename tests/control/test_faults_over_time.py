"""The fourteen faults, 8 to 14: over many steps, in threads and processes, against second opinions.

See `test_faults.py`.
"""

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from driving import N, bits, drive, good, same
from holding import NAN, REF, hold, solve_and_hold
from instances import S_REF, instance, obstacle, problem, rotated, straight_reference
from qpsolvers import solve_qp
from scipy import sparse, stats

from scp_mpc import (
    MPC,
    SCP,
    ConcurrentUseError,
    InvalidArgumentError,
    Margin,
    NotFiniteError,
    ObstaclePrediction,
    Settings,
    ShapeError,
)

# 8. Determinism

BITS = """
import sys
sys.path.insert(0, sys.argv[1])
from driving import N, bits, drive
from instances import problem
from scp_mpc import MPC
print(bits(drive(MPC(problem(N)), 12)))
"""


@pytest.mark.parametrize("seed", ["1", pytest.param("2", marks=pytest.mark.slow)])
def test_08_same_bits_in_every_run_process_and_after_reset(seed):
    """The seed is that of Python's hashes."""
    mpc = MPC(problem(N))
    here = bits(drive(mpc, 12))
    drive(mpc, 3)
    mpc.reset()
    assert bits(drive(mpc, 12)) == here
    command = [sys.executable, "-c", BITS, str(Path(__file__).parents[1] / "support")]
    done = subprocess.run(
        command,
        env=os.environ | {"PYTHONHASHSEED": seed},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == here


# 9. Memory


def resident():
    """Bytes in memory."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGESIZE")


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="no /proc on this system")
@pytest.mark.parametrize("steps", [3_000, pytest.param(10_000, marks=pytest.mark.slow)])
def test_09_memory_is_flat_over_thousands_of_steps(steps):
    case = problem(4, max_obstacles=2)
    ref = straight_reference(4)
    near, far = obstacle(4, (0.9, 0.3)), obstacle(4, (30.0, 0.0))
    worlds = [[far], [], [far, far], [near]]
    mpc = MPC(case, Settings(multi_start=False))

    def run(steps):
        for k in range(steps):
            mpc.step(ref[0], ref, worlds[3 if k % 200 == 0 else k % 3])

    run(1000)
    before = resident()
    run(steps)
    assert resident() - before < 500 * steps


# 10. Threads


def test_10_two_controllers_in_two_threads_equal_serial():
    def run(seed):
        start = drive(MPC(problem(N)), 4 + seed)
        return bits(start)

    serial = [run(seed) for seed in range(4)]
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(run, range(4))) == serial


def test_10_two_threads_in_one_controller_raise_and_leave_no_trace():
    """The second comes while the first waits inside its step."""
    mpc = MPC(problem(N))

    def waiting(pool):
        other = pool.submit(mpc.step, REF[0], REF)
        with pytest.raises(ConcurrentUseError):
            other.result()
        yield obstacle(N, (1.5, 0.1))

    with ThreadPoolExecutor(1) as pool:
        disturbed = mpc.step(REF[0], REF, waiting(pool))
    alone = MPC(problem(N)).step(REF[0], REF, [obstacle(N, (1.5, 0.1))])
    assert same([disturbed], [alone])


# 11. Arguments


def test_11_arguments_stay_as_they_are_and_may_come_in_any_form():
    """Exactly representable numbers, so that every type holds the same ones."""
    x0 = np.array([0.0, 2.0, 0.25, 0.0])
    x_ref = np.round(REF * 8) / 8
    means = np.tile([1.5, 0.125], (N + 1, 1))
    covariances = np.tile([[0.0625, 0.03125], [0.03125, 0.125]], (N + 1, 1, 1))
    arrays = (x0, x_ref, means, covariances)
    before = [a.tobytes() for a in arrays]

    def solved(x0, x_ref, means, covariances):
        mpc = MPC(problem(N))
        thing = [ObstaclePrediction(means, covariances, 0.25)]
        return [mpc.step(x0, x_ref, thing) for _ in range(2)]

    plain = solved(*arrays)
    forms = [
        lambda a: a.tolist(),
        lambda a: np.repeat(a, 2, axis=0)[::2],
        lambda a: a[::-1].copy()[::-1],
        np.asfortranarray,
        lambda a: a.astype(np.float32),
        lambda a: tuple(a),
    ]
    for form in forms:
        assert same(plain, solved(*map(form, arrays)))
    whole = [np.round(a) for a in (x0, x_ref, means, covariances)]
    assert same(solved(*whole), solved(*(a.astype(np.int64) for a in whole)))
    assert before == [a.tobytes() for a in arrays]


# 12. Mixed calls, a short one; any sequence of them is in test_state_machine.py


def test_12_bad_calls_among_good_ones_leave_no_trace():
    mpc, twin = MPC(problem(N)), MPC(problem(N))
    bad = [
        ({"x0": [NAN] * 4}, NotFiniteError),
        ({"x_ref": REF[:-1]}, ShapeError),
        ({"obstacles": 3}, InvalidArgumentError),
    ]
    for change, error in bad:
        with pytest.raises(error):
            mpc.step(**(good() | change))
        assert same([mpc.step(**good())], [twin.step(**good())])
        if error is ShapeError:
            mpc.reset()
            twin.reset()


# 13. A second opinion


@pytest.mark.parametrize("inflation", ["exact", "axes"])
@pytest.mark.parametrize("kind", ["ahead", "beside", "crossing", "elongated"])
def test_13_another_solver_finds_the_same_program_solved(kind, inflation):
    """The program about a converged plan, written anew from the caller's data, is solved by it."""
    case = instance(kind, 8, inflation, S_REF, 1)
    plan = SCP(case.problem).solve(case.x0, case.x_ref, case.obstacles)
    hold(case.problem, case.x0, case.x_ref, case.obstacles, plan)
    if not plan.ok:
        return
    arguments = case.x0, case.x_ref, case.obstacles
    program = SCP(case.problem).subproblem(*arguments, guess=plan.iterate)
    found = np.abs(program.upper - program.lower) < 1e-12
    equal, other = program.A[found].tocsc(), program.A[~found]
    sides = sparse.vstack([other, -other]).tocsc()
    limits = np.concatenate([program.upper[~found], -program.lower[~found]])
    kept = np.isfinite(limits)
    z = solve_qp(
        program.P, program.q, sides[kept], limits[kept], equal, program.lower[found],
        solver="clarabel", tol_gap_abs=1e-10, tol_gap_rel=1e-10, tol_feas=1e-10,
    )  # fmt: skip
    inputs = z[case.problem.horizon * 4 :][: plan.U.size].reshape(plan.U.shape)
    np.testing.assert_allclose(inputs, plan.U, atol=1e-3)
    mine, theirs = (cost(case, U) for U in (plan.U, inputs))
    assert mine == pytest.approx(theirs, rel=1e-5)


def cost(case, U):
    """Of inputs alone, by a plain loop."""
    problem, x, total = case.problem, case.x0, 0.0
    for u, ref in zip(U, case.x_ref[1:], strict=True):
        x = problem.model.A @ x + problem.model.B @ u
        total += (x - ref) @ problem.Q @ (x - ref) + u @ problem.R @ u
    return total


@pytest.mark.parametrize("solver", ["osqp", "piqp", "clarabel"])
def test_13_kkt_conditions_hold_in_terms_of_the_callers_data(solver):
    """A swallowed update would leave the certificate of another program.

    With the obstacles' forces from the plan's own multipliers, the gradient with respect to the
    inputs is made anew by a plain adjoint loop; it must vanish where an input is between its
    limits and push outwards where it is not.
    """
    case = instance("ahead", 8, "exact", S_REF, 2)
    problem_ = case.problem
    mpc = MPC(problem_, Settings(solver=solver))
    mpc.step(case.x0 + 0.3, case.x_ref, [obstacle(8, (1.0, 0.4))])
    plan = mpc.step(case.x0, case.x_ref, case.obstacles)
    assert plan.status.certified
    A, B, position = problem_.model.A, problem_.model.B, problem_.model.position
    force = plan.multipliers.obstacles[0]
    assert (force <= 0).all()
    assert force.min() < -1e-3
    reach = problem_.robot_radius + case.obstacles[0].radius
    costate, gradient = np.zeros(4), np.zeros_like(plan.U)
    for i in range(8, 0, -1):
        mu, Sigma = case.obstacles[0].means[i], case.obstacles[0].covariances[i]
        pull = np.zeros(4)
        if force[i - 1] < 0:
            n, distance = nearest(plan.X[i, position] - mu, Sigma, plan.s[0])
            pull[position] = force[i - 1] * n
            assert abs(force[i - 1] * (distance - reach)) < 1e-5
        Q = problem_.Qf if i == 8 else problem_.Q
        costate = A.T @ costate + 2 * Q @ (plan.X[i] - case.x_ref[i]) + pull
        gradient[i - 1] = B.T @ costate + 2 * problem_.R @ plan.U[i - 1]
    low, high = problem_.u_min + 1e-9 >= plan.U, problem_.u_max - 1e-9 <= plan.U
    assert np.abs(gradient[~low & ~high]).max(initial=0.0) < 1e-5
    assert (gradient[low] > -1e-5).all()
    assert (gradient[high] < 1e-5).all()


def nearest(y, Sigma, s):
    """Outward normal and signed distance, by a fan of directions and bisection."""
    low, high = -np.pi, np.pi
    for _ in range(14):
        t = np.linspace(low, high, 721)
        n = np.stack([np.cos(t), np.sin(t)], axis=1)
        values = n @ y - s * np.sqrt(np.einsum("ki,ij,kj->k", n, Sigma, n))
        best = values.argmax()
        low, high = t[max(best - 1, 0)], t[min(best + 1, 720)]
    return n[best], values[best]


# 14. Measured risk


@pytest.mark.parametrize("delta", [0.1, 0.05])
def test_14_collisions_are_as_rare_as_promised(delta):
    """Per stage, with the exact no-go set; the upper end of the 95 % interval decides."""
    s = float(stats.norm.isf(delta))
    case = problem(N, margin=Margin(reference=s, lower=s))
    thing = obstacle(N, (1.6, 0.1), covariance=rotated((0.45, 0.15), 0.6))
    plan = solve_and_hold(case, REF[0], REF, [thing])
    assert plan.ok
    rng, samples = np.random.default_rng(0), 5_000
    worst = 0.0
    for i in range(1, N + 1):
        centres = rng.multivariate_normal(thing.means[i], thing.covariances[i], samples)
        gaps = np.linalg.norm(centres - plan.X[i, [0, 2]], axis=1)
        hits = int((gaps < case.robot_radius + thing.radius).sum())
        interval = stats.binomtest(hits, samples).proportion_ci(0.95, method="exact")
        worst = max(worst, interval.high)
    assert worst <= delta
    assert worst > delta / 100  # the obstacle was in the way
