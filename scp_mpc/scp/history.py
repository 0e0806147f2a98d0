"""What happened in one SCP iteration: for those who want to see it at work."""

from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import FloatArray, IntArray
from scp_mpc.qp.active_set import QPSolution
from scp_mpc.scp.certificate import Nominal
from scp_mpc.scp.iterate import NEGLIGIBLE
from scp_mpc.scp.transcription import Program, Transcription


@dataclass(frozen=True, eq=False)
class Record:
    """One SCP iteration.

    Attributes:
        cost: Of the plan it led to.
        violation: Largest violation of an obstacle's constraint there [m].
        residual: Largest KKT residual of the original problem there.
        step: Norm of what the inputs changed by.
        accepted: Whether that plan became the next nominal.
        iterations: ADMM iterations that OSQP took to name the active set; 0 of other solvers.
        positions: (C+1, d) of the plan, from now on [m].
        obstacles: (k,) which obstacles push the convex program's solution.
        normals: (k, d) their half-spaces' normals: n'(p - point) >= -value holds.
        points: (k, d) about which these were taken [m].
        values: (k,) of the constraint functions there [m].
    """

    cost: float
    violation: float
    residual: float
    step: float
    accepted: bool
    iterations: int
    positions: FloatArray
    obstacles: IntArray
    normals: FloatArray
    points: FloatArray
    values: FloatArray


def recorded(
    at: Transcription,
    nominal: Nominal,
    program: Program,
    solution: QPSolution,
    trial: Nominal,
    accepted: bool,
) -> Record:
    """Take down one iteration: from a nominal, by a program and its solution, to a trial."""
    planes, pairs = program.planes, program.pairs
    push = solution.force[len(program.qp.F) :] > NEGLIGIBLE
    return Record(
        cost=trial.cost,
        violation=float(np.maximum(-trial.planes.g, 0.0).max(initial=0.0)),
        residual=trial.residuals.worst,
        step=float(np.linalg.norm(trial.rollout.inputs - nominal.rollout.inputs)),
        accepted=accepted,
        iterations=program.subproblem.solver.iterations,
        positions=at.path(trial.y),
        obstacles=pairs.obstacle[push],
        normals=planes.a[push, :-1],
        points=at.path(planes.y)[pairs.node[push] + 1],
        values=planes.g[push],
    )
