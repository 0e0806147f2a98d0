"""What happened in one SCP iteration: for those who want to see it at work."""

from dataclasses import dataclass

from scp_mpc.arrays import FloatArray, IntArray


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
