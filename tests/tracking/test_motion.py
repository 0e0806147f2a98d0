"""Motions: exact discretisation, checked by quadrature of the differential equation."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.linalg import expm

from scp_mpc.errors import BoundsError, NotFiniteError
from scp_mpc.tracking import Motion


def generator(omega, dim=2):
    """The matrix of dp/dt = v, dv/dt = omega J v."""
    A = np.zeros((2 * dim, 2 * dim))
    A[:dim, dim:] = np.eye(dim)
    if omega:
        A[dim:, dim:] = omega * np.array([[0, -1], [1, 0]])
    return A


def van_loan(A, density, dt):
    """Van Loan's exponential for F and Q."""
    n = len(A)
    G = np.zeros((n, n))
    G[n // 2 :, n // 2 :] = density * np.eye(n // 2)
    whole = expm(dt * np.block([[-A, G], [np.zeros((n, n)), A.T]]))
    F = whole[n:, n:].T
    return F, F @ whole[:n, n:]


@pytest.mark.parametrize("omega", [0.0, 1e-9, 1e-5, 9e-4, 1.1e-3, 0.3, -0.7, 3.0])
@pytest.mark.parametrize("dt", [0.01, 0.4, 2.0])
def test_transition_is_exact(omega, dt):
    F, Q = Motion(0.3, omega).transition(dt)
    F_slow, Q_slow = van_loan(generator(omega), 0.3, dt)
    assert np.abs(F - F_slow).max() < 1e-12 * max(1, np.abs(F_slow).max())
    assert np.abs(Q - Q_slow).max() < 1e-10 * np.abs(Q_slow).max()
    assert (Q == Q.T).all()


def test_constant_velocity_in_space():
    F, Q = Motion(0.5).transition(0.3, dim=3)
    F_slow, Q_slow = van_loan(generator(0.0, 3), 0.5, 0.3)
    assert np.abs(F - F_slow).max() < 1e-12
    assert np.abs(Q - Q_slow).max() < 1e-12


@given(omega=st.floats(-3.0, 3.0), first=st.floats(0.0, 2.0), then=st.floats(0.0, 2.0))
@example(omega=1.0, first=0.0, then=5e-324)
def test_two_intervals_are_one(omega, first, then):
    """F(a + b) = F(b) F(a), and the noise of both adds up: irregular times need nothing else."""
    motion = Motion(0.2, omega)
    (F_a, Q_a), (F_b, Q_b), (F, Q) = (motion.transition(t) for t in (first, then, first + then))
    assert np.allclose(F_b @ F_a, F, rtol=0, atol=1e-12)
    assert np.allclose(F_b @ Q_a @ F_b.T + Q_b, Q, rtol=0, atol=1e-9)


def test_no_time_changes_nothing():
    F, Q = Motion(0.2, 0.5).transition(0.0)
    assert np.array_equal(F, np.eye(4))
    assert not Q.any()


def test_positive_turns_go_left():
    F, _ = Motion(0.1, 0.5).transition(1.0)
    x = F @ np.array([0.0, 0.0, 1.0, 0.0])
    assert x[1] > 0
    assert x[3] > 0


@pytest.mark.parametrize(
    ("values", "argument"),
    [((0.0,), "density"), ((0.1, 0.0, -1.0), "weight"), ((0.1, 400.0), "turn_rate")],
)
def test_bad_motions_are_refused(values, argument):
    with pytest.raises(BoundsError) as error:
        Motion(*values)
    assert error.value.argument == argument


def test_bad_transitions_are_refused():
    with pytest.raises(BoundsError, match="turns in 3 dimensions"):
        Motion(0.1, 0.2).transition(0.1, dim=3)
    with pytest.raises(BoundsError, match="negative"):
        Motion(0.1).transition(-0.1)
    with pytest.raises(NotFiniteError):
        Motion(float("nan"))
