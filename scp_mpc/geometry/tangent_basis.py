"""Tangent bases and small inverse roots, for whole stacks.

Notation:
    n   (..., d)        unit vector
    T   (..., d, d-1)   orthonormal columns square to n
    M   (..., k, k)     symmetric positive semi-definite, k = d - 1 = 1 or 2
"""

import numpy as np

from scp_mpc.arrays import FloatArray


def tangents(n: FloatArray) -> FloatArray:
    """Return orthonormal columns T (..., d, d-1) that complete each unit vector to a basis."""
    if n.shape[-1] == 2:
        T = np.empty((*n.shape, 1))
        T[..., 0, 0], T[..., 1, 0] = -n[..., 1], n[..., 0]
        return T
    # The first columns of the reflection that takes n onto -+ the last axis.
    mirror = n.copy()
    mirror[..., -1] += np.where(n[..., -1] < 0, -1.0, 1.0)
    share = 2.0 / np.square(mirror).sum(axis=-1)
    outer = mirror[..., :, None] * mirror[..., None, :-1]
    return np.eye(n.shape[-1])[:, :-1] - share[..., None, None] * outer


def inverse_root(M: FloatArray, least: float) -> FloatArray:
    """Return C (..., k, k) with C C' = M^-1, whose eigenvalues count as no less than `least`."""
    if M.shape[-1] == 1:
        return 1.0 / np.sqrt(np.maximum(M, least))
    eigenvalues, vectors = np.linalg.eigh(M)
    root: FloatArray = vectors / np.sqrt(np.maximum(eigenvalues, least))[..., None, :]
    return root
