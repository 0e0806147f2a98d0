"""One thread for linear algebra, before NumPy is loaded: small matrices are quicker that way."""

import os

for name in ("MKL_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(name, "1")

import pytest  # noqa: E402

from scp_mpc import Settings  # noqa: E402


@pytest.fixture(autouse=True, scope="session")
def _without_a_clock():
    """Controllers take the time it takes unless a test says otherwise: plans depend on no load."""
    build = Settings.__init__
    given = build.__defaults__
    build.__defaults__ = tuple(None if value == "dt" else value for value in given)
    yield
    build.__defaults__ = given
