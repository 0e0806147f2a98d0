"""Sparse programs solved by others, through qpsolvers; and all half-spaces of a control step."""

import warnings

import numpy as np
import qpsolvers
from scipy import sparse

from scp_mpc.geometry.no_go import NoGoSets

TIGHT = {
    "clarabel": {"tol_gap_abs": 1e-11, "tol_gap_rel": 1e-11, "tol_feas": 1e-11},
    "piqp": {"eps_abs": 1e-11, "eps_rel": 1e-11},
}


def solution(program, solver="clarabel"):
    """x (n,) and y (m,) with P x + q + A'y = 0; None where there is no solution."""
    equal = program.upper - program.lower < 1e-12
    other, finite = program.A.tocsr()[~equal], np.isfinite
    upper, lower = program.upper[~equal], program.lower[~equal]
    G = sparse.vstack([other[finite(upper)], -other[finite(lower)]], format="csc")
    h = np.concatenate([upper[finite(upper)], -lower[finite(lower)]])
    A, b = program.A.tocsr()[equal].tocsc(), program.lower[equal]
    given = (program.P.tocsc(), program.q, *((G, h) if len(h) else (None, None)))
    given += (A, b) if len(b) else (None, None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        end = qpsolvers.solve_problem(qpsolvers.Problem(*given), solver, **TIGHT.get(solver, {}))
    if not end.found:
        return None
    y, inner = np.zeros(len(program.lower)), np.zeros((~equal).sum())
    if len(h):
        inner[finite(upper)] += end.z[: finite(upper).sum()]
        inner[finite(lower)] -= end.z[finite(upper).sum() :]
    y[~equal] = inner
    if len(b):
        y[equal] = end.y
    return end.x, y


def half_spaces(step, path, s):
    """Those of all obstacles at all nodes (C, d) of a path, at sizes s (M,)."""
    sets = NoGoSets.stacked(
        step.means[:, 1:], step.covariances[:, 1:], step.radii, step.count, step.shapes
    )
    start = step.here - step.means[:, 0]
    return step.problem.no_go.linearise(sets, path, s[: step.count], start)
