"""The trust region on the inputs, and the merit that decides whether a trial becomes the nominal.

The merit is cost and penalty on all violations; its weight exceeds the forces met so far. A plan is
always rolled out, so it needs no term for defects. The region bounds what the inputs change by; as
constraints of the program its bounds push, so that no point that they hold is ever certified. For
a linear robot half-spaces are sound wherever they are taken, so that the region never acts.
"""

from math import inf

import numpy as np

from scp_mpc.arrays import FloatArray
from scp_mpc.scp.certificate import Nominal
from scp_mpc.scp.transcription import Convex, Relaxation, Transcription


class Region:
    """The trust region and the merit that decides about it.

    Args:
        at: The step in numbers.

    Attributes:
        radius: (N nu,) by how much inputs may change; None for no limit.
    """

    enough = 0.01  # share of the predicted decrease that a trial must bring
    shrink, grow = 0.3, 3.0
    smallest = 1e-8  # relative to the inputs' range, at which to give up
    close = 1e-2  # KKT residual from which on its fall counts, whatever the merit does
    noise = 1e-12  # of the merit, relative

    def __init__(self, at: Transcription) -> None:
        """Begin without limits."""
        self._at = at
        span = (at.problem.u_max - at.problem.u_min) / 2
        self._span = np.tile(np.where(span > 0, span, 1.0), at.problem.horizon)
        self._radius, self._weight = inf, 0.0

    @property
    def radius(self) -> FloatArray | None:
        """See above."""
        return None if self._radius == inf else self._radius * self._span

    def accepts(
        self,
        nominal: Nominal,
        best: Nominal | None,
        trial: Nominal,
        convex: Convex,
        solution: object,
        leaps: int,
    ) -> bool:
        """Whether a trial brings enough of what its program predicted."""
        at = self._at
        if not np.isfinite(trial.cost):
            return False
        if at.linear:
            return not leaps or best is None or self._merit(trial) <= self._merit(best)
        forces = convex.solution.force[len(convex.qp.F) :]
        largest = float(np.abs(forces).max(initial=0.0))
        self._weight = min(max(self._weight / 2, 2 * largest), at.problem.slack_weight)
        if convex.relaxation is Relaxation.EVERYBODY:
            self._weight = at.problem.slack_weight
        before, after = self._merit(nominal), self._merit(trial)
        predicted, actual = before - self._model(convex, solution), before - after
        if actual >= self.enough * predicted - self.noise * abs(before):
            if actual >= predicted / 2:
                self._radius *= self.grow
            return True
        worst = nominal.residuals.worst if best is not None else inf
        return trial.residuals.worst <= worst / 2 <= self.close

    def shrinks(self, nominal: Nominal, convex: Convex, solution: object) -> bool:
        """Trust only a part of the way that the inputs were to go; False where that is none."""
        y = convex.condensed.y(solution.v)  # type: ignore[attr-defined]
        change = (y - nominal.y)[self._at.layout.u] / self._span
        self._radius = self.shrink * min(self._radius, float(np.abs(change).max()))
        return self._radius >= self.smallest

    def _model(self, convex: Convex, solution: object) -> float:
        v = solution.v  # type: ignore[attr-defined]
        d = v - convex.condensed.here
        return convex.qp.merit(v) + float(d @ self._at.curvature(convex, convex.solution) @ d) / 2

    def _merit(self, nominal: Nominal) -> float:
        """Cost and penalties on all violations, whoever is supposed to yield."""
        merit = self._at.merit(nominal.cost, 0.0, nominal.excess)
        weight = self._at.problem.slack_weight if self._at.linear else self._weight
        return merit + weight * float(np.maximum(0.0, -nominal.planes.g).sum())
