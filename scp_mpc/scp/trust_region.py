"""The trust region on the inputs, and the merit that decides whether a trial becomes the nominal.

The merit is cost and penalty on all violations; its weight exceeds the forces met so far. A plan is
always rolled out, so it needs no term for defects. The region bounds what the inputs change by; as
constraints of the program its bounds push, so that no point that they hold is ever certified. For
a linear robot half-spaces are sound wherever they are taken, so that the region never acts.
"""

import logging
from math import inf

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.qp.active_set import QPSolution
from scp_mpc.scp.certificate import Nominal
from scp_mpc.scp.transcription import Program, Relaxation, Transcription

_ENOUGH = 0.01  # share of the predicted decrease that a trial must bring
_SHRINK, _GROW = 0.3, 3.0
_SMALLEST = 1e-8  # relative to the inputs' range, at which to give up
_CLOSE = 1e-2  # KKT residual from which on its fall counts, whatever the merit does
_NOISE = 1e-12  # of the merit, relative
_SUSPICIOUS = 14  # refused steps in a row; with right derivatives hardly ever more than ten

_log = logging.getLogger(__name__)


class TrustRegion:
    """A trust region and its merit.

    Args:
        at: The step in numbers.

    Attributes:
        radius: (N nu,) by how much inputs may change; None for no limit.
    """

    def __init__(self, at: Transcription) -> None:
        """Begin without limits."""
        span = (at.problem.u_max - at.problem.u_min) / 2
        self._at, self._span = at, np.tile(np.where(span > 0, span, 1.0), at.problem.horizon)
        self._size, self._weight, self._refused = inf, 0.0, 0
        self.radius: FloatArray | None = None

    def accepts(
        self,
        nominal: Nominal,
        best: Nominal | None,
        trial: Nominal,
        program: Program,
        solution: QPSolution,
        refinement: QPSolution,
    ) -> bool:
        """Whether a trial brings enough of what its program predicted."""
        at = self._at
        if not np.isfinite(trial.cost):
            return False
        if at.linear:
            return True
        largest = float(np.abs(solution.force[len(program.qp.F) :]).max(initial=0.0))
        self._weight = min(max(self._weight / 2, 2 * largest), at.problem.slack_weight)
        if program.relaxation is Relaxation.ALL:
            self._weight = at.problem.slack_weight
        before, after = self._merit(nominal), self._merit(trial)
        d = refinement.v - program.condensed.here
        bent = float(d @ at.curvature(program, solution) @ d) / 2
        predicted = before - program.qp.merit(refinement.v) - bent
        if before - after >= _ENOUGH * predicted - _NOISE * abs(before):
            self._refused = 0
            if before - after >= predicted / 2:
                self._resize(_GROW * self._size)
            return True
        worst = nominal.residuals.worst if best is not None else inf
        return trial.residuals.worst <= worst / 2 <= _CLOSE

    def shrinks(self, nominal: Nominal, program: Program, refinement: QPSolution) -> bool:
        """Trust only a part of the way that the inputs were to go; False where that is none."""
        u = self._at.layout.u
        self._suspect()
        change = (program.condensed.y(refinement.v)[u] - nominal.y[u]) / self._span
        self._resize(_SHRINK * min(self._size, float(np.abs(change).max())))
        return self._size >= _SMALLEST

    def _suspect(self) -> None:
        """Count a refused step; say once what many in a row, ever smaller, must mean."""
        self._refused += 1
        if self._refused == _SUSPICIOUS and not self._at.suspected:
            self._at.suspected = True
            _log.warning(
                "%d ever smaller steps in a row do not lower the cost as the derivatives of %s "
                "predict: are its Jacobians right? Model.check compares them with differences",
                self._refused,
                type(self._at.problem.model).__name__,
            )

    def _resize(self, size: float) -> None:
        self._size = size
        self.radius = None if size == inf else size * self._span

    def _merit(self, nominal: Nominal) -> float:
        """Cost and penalties on all violations, whoever is supposed to yield."""
        depth = float(np.maximum(0.0, -nominal.planes.g).sum())
        return self._at.merit(nominal.cost, 0.0, nominal.excess) + self._weight * depth
