"""The dynamics about a plan: what forces on it mean for its inputs.

Notation:
    e       (N, nx)     deviations x_i - xref_i, i = 1 .. N
    nu      (N, nx)     multipliers of the dynamics
    A, B    derivatives of x_{i+1} with respect to x_i and u_i, at all stages or the same for all
    D       block bidiagonal, unit diagonal, -A below:  D e = B u + drift
    C_k, D_k    derivatives of a position between two samples with respect to x_i and u_i
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse
from scipy.linalg.lapack import dtbtrs
from scipy.sparse.linalg import splu

from scp_mpc.arrays import FloatArray
from scp_mpc.robots.linear import LinearModel
from scp_mpc.solver.sampling import LinearSampling


class Motion(ABC):
    """Derivatives along a plan, and linear systems with D."""

    @abstractmethod
    def roll(self, pushed: FloatArray) -> FloatArray:
        """Solve D e = pushed (N, nx) for e (N, nx): forwards in time."""

    @abstractmethod
    def costates(self, forces: FloatArray) -> FloatArray:
        """Solve D' nu = forces (N, nx) for nu (N, nx): backwards in time."""

    @abstractmethod
    def thrust(self, nu: FloatArray) -> FloatArray:
        """B' nu (N, nu): what multipliers mean for the inputs."""

    @abstractmethod
    def pull(self, phi: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """What forces phi (C d,) on the positions do: (N, nx) on e, (N, nu) on u, or None."""


class SteadyMotion(Motion):
    """The motion of a linear, time-invariant model: the same about all plans."""

    def __init__(self, model: LinearModel, horizon: int, sampling: LinearSampling) -> None:
        """Factorise D."""
        self._B, self._sampling = model.B, sampling
        steps = sparse.kron(sparse.eye(horizon, k=-1), model.A)
        self.D = sparse.csc_matrix(sparse.eye(horizon * model.nx) - steps)
        # Its own factor: no fill, no pivoting.
        self._factor = splu(self.D, permc_spec="NATURAL", diag_pivot_thresh=0.0)

    def roll(self, pushed: FloatArray) -> FloatArray:
        """See the base class."""
        e: FloatArray = self._factor.solve(pushed.ravel())
        return e.reshape(pushed.shape)

    def costates(self, forces: FloatArray) -> FloatArray:
        """See the base class."""
        backwards: Any = self._factor.solve
        nu: FloatArray = backwards(forces.ravel(), trans="T")
        return nu.reshape(forces.shape)

    def thrust(self, nu: FloatArray) -> FloatArray:
        """See the base class."""
        return nu @ self._B

    def pull(self, phi: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """See the base class."""
        return self._sampling.pull(phi)


class Bands:
    """Where the entries of D stand in LAPACK's storage of a banded lower triangle."""

    def __init__(self, horizon: int, nx: int) -> None:
        """Find the places of A_1 .. A_{N-1}."""
        self.shape = 2 * nx, horizon * nx
        i = np.arange(horizon - 1)[:, None, None]
        below = nx + np.arange(nx)[:, None] - np.arange(nx)
        column = i * nx + np.arange(nx)
        self.places = (below + column * 2 * nx).ravel()

    def of(self, A: FloatArray) -> FloatArray:
        """D (2 nx, N nx) of A (N, nx, nx), in Fortran's order."""
        band = np.zeros(self.shape, order="F")
        band[0] = 1.0
        band.reshape(-1, order="F")[self.places] = -A[1:].ravel()
        return band


@dataclass(frozen=True, eq=False)
class VaryingMotion(Motion):
    """The motion about one plan of a nonlinear model.

    Attributes:
        A: (N, nx, nx) at stages 0 .. N-1; the first is never asked for.
        B: (N, nx, nu).
        between: C (N, k, nx) and D (N, k, nu) of all coordinates between the samples; None for
            none.
        at: (N, m, nx) derivatives of the coordinates at the samples.
        bands: How D is stored.
    """

    A: FloatArray
    B: FloatArray
    between: tuple[FloatArray, FloatArray] | None
    at: FloatArray
    bands: Bands

    @cached_property
    def _band(self) -> FloatArray:
        return self.bands.of(self.A)

    def roll(self, pushed: FloatArray) -> FloatArray:
        """See the base class."""
        e: FloatArray = dtbtrs(self._band, pushed.reshape(-1, 1), uplo="L", diag="U")[0]
        return e.reshape(pushed.shape)

    def costates(self, forces: FloatArray) -> FloatArray:
        """See the base class."""
        nu: FloatArray = dtbtrs(self._band, forces.reshape(-1, 1), uplo="L", trans="T", diag="U")[0]
        return nu.reshape(forces.shape)

    def thrust(self, nu: FloatArray) -> FloatArray:
        """See the base class."""
        thrust: FloatArray = (nu[:, None] @ self.B)[:, 0]
        return thrust

    def pull(self, phi: FloatArray) -> tuple[FloatArray, FloatArray | None]:
        """See the base class."""
        forces = phi.reshape(len(self.A), 1, -1)
        inner = forces.shape[2] - self.at.shape[1]
        on_e = (forces[:, :, inner:] @ self.at)[:, 0]
        if self.between is None:
            return on_e, None
        C, D = self.between
        on_e[:-1] += (forces[1:, :, :inner] @ C[1:])[:, 0]
        return on_e, (forces[:, :, :inner] @ D)[:, 0]

    def respond(self, inputs: FloatArray) -> FloatArray:
        """Responses of e (N, nx, k) to those of the inputs (N nu, k).

        Stage by stage: each needs the one before, and products of all at once take longer.
        """
        N, _, nu = self.B.shape
        e: FloatArray = self.B @ inputs.reshape(N, nu, -1)
        for A, before, after in zip(self.A[1:], e[:-1], e[1:], strict=True):
            after += A.dot(before)
        return e

    def positions(self, e: FloatArray, inputs: FloatArray) -> FloatArray:
        """Coordinates (C d, k) that go with responses e (N, nx, k) and inputs (N nu, k)."""
        samples: FloatArray = self.at @ e
        if self.between is not None:
            C, D = self.between
            inner = D @ inputs.reshape(len(D), D.shape[2], -1)
            inner[1:] += C[1:] @ e[:-1]
            samples = np.concatenate([inner, samples], axis=1)
        return samples.reshape(-1, samples.shape[2])
