"""The mixed-integer oracle: obstacles that are polytopes, one binary for each face and stage.

    minimise   the cost of the plan
    subject to dynamics, input bounds, and for each obstacle j and stage i
               a_f'(p_i - mu) >= b_f - M (1 - z_f)  for all faces f,   sum_f z_f >= 1,  z binary

A point is outside a convex polytope if and only if it is beyond one of its faces: for a robot that
is a point this is the same problem. SCIP proves its optimum. Nothing here comes from the package
but the numbers.
"""

import contextlib
import os

import numpy as np
import pyscipopt

_BIG = 12.0  # [m] more than any face is away from any point that can be reached


def bounds(problem, x0, x_ref, obstacles, gap=1e-5, seconds=60.0, below=None):
    """Cost of the best plan that SCIP finds, and what no plan costs less than.

    Args:
        problem: With a point for a robot and diagonal weights.
        x0: (nx,) state now.
        x_ref: (N+1, nx) reference.
        obstacles: Still polytopes.
        gap: Relative difference between the two at which to end.
        seconds: Likewise.
        below: Look for plans that cost less than this only.
    """
    N, model, d = problem.horizon, problem.model, problem.model.dim
    scip = pyscipopt.Model()
    scip.hideOutput()
    for name, value in (("limits/time", seconds), ("limits/gap", gap), ("numerics/feastol", 1e-9)):
        scip.setParam(name, value)
    total = pyscipopt.quicksum
    U = [
        [scip.addVar(lb=lo, ub=up) for lo, up in zip(problem.u_min, problem.u_max, strict=True)]
        for _ in range(N)
    ]
    X = [[float(v) for v in x0]]
    for i in range(N):
        X.append([scip.addVar(lb=None) for _ in range(model.nx)])
        for k in range(model.nx):
            ahead = total(float(model.A[k, m]) * X[i][m] for m in range(model.nx))
            ahead += total(float(model.B[k, m]) * U[i][m] for m in range(model.nu))
            scip.addCons(X[i + 1][k] == ahead)
    terms = [float(problem.R[k, k]) * u[k] * u[k] for u in U for k in range(model.nu)]
    for i in range(1, N + 1):
        Q = problem.Q if i < N else problem.Qf
        error = [X[i][k] - float(x_ref[i, k]) for k in range(model.nx)]
        terms += [float(Q[k, k]) * error[k] * error[k] for k in range(model.nx)]
    cost = scip.addVar(lb=0.0)
    scip.addCons(total(terms) <= cost)
    scip.setObjective(cost)
    if below is not None:
        scip.setObjlimit(below)
    for o in obstacles:
        A, b = np.array(o.shape.normals), np.array(o.shape.offsets)
        for i in range(1, N + 1):
            y = [X[i][m] - float(o.means[i, k]) for k, m in enumerate(model.position)]
            z = [scip.addVar(vtype="B") for _ in b]
            scip.addCons(total(z) >= 1)
            for a, offset, on in zip(A, b, z, strict=True):
                across = total(float(a[k]) * y[k] for k in range(d))
                scip.addCons(across >= float(offset) - _BIG * (1 - on))
    with _silent():
        scip.optimize()
    return scip.getPrimalbound(), scip.getDualbound()


@contextlib.contextmanager
def _silent():
    """SCIP warns about tolerances on the process's own standard error."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
