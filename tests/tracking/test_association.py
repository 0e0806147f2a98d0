"""Pairing measurements with tracks, against all ways to do it."""

from itertools import permutations

import numpy as np
import pytest

from scp_mpc.tracking.association import associate
from scp_mpc.tracking.kalman import Gaussians

GATE = 9.21


def brute_force(tracks, measured, noise):
    """The best of all partial matchings within the gate: least sum of d2 + log det S - its most."""
    m, P = tracks
    count, found = len(measured), {}
    for i in range(len(m)):
        for k in range(count):
            S = P[i, :2, :2] + noise[k]
            e = measured[k] - m[i, :2]
            found[i, k] = e @ np.linalg.inv(S) @ e, np.log(np.linalg.det(S))
    near = [logdet for square, logdet in found.values() if square <= GATE]
    ceiling = GATE + max(near, default=0.0)
    best, pairs = np.inf, []
    slots = [*range(count), *([None] * len(m))]
    for choice in set(permutations(slots, len(m))):
        chosen = [(i, k) for i, k in enumerate(choice) if k is not None]
        if all(found[pair][0] <= GATE for pair in chosen):
            total = sum(sum(found[pair]) - ceiling for pair in chosen)
            if total < best - 1e-12:
                best, pairs = total, chosen
    return pairs


@pytest.mark.parametrize("seed", range(12))
def test_pairs_are_the_best_of_all(seed):
    rng = np.random.default_rng(seed)
    count, measurements = 3, int(rng.integers(1, 5))
    root = rng.normal(0, 0.6, (count, 4, 4))
    tracks = Gaussians(rng.normal(0, 1.5, (count, 4)), root @ np.swapaxes(root, -2, -1))
    noise = np.tile(0.04 * np.eye(2), (measurements, 1, 1))
    measured = rng.normal(0, 1.5, (measurements, 2))
    old, new = associate(tracks, measured, noise, GATE)
    assert list(zip(old.tolist(), new.tolist(), strict=True)) == brute_force(
        tracks, measured, noise
    )


def test_nothing_to_pair():
    none = Gaussians(np.zeros((0, 4)), np.zeros((0, 4, 4)))
    one = Gaussians(np.zeros((1, 4)), np.eye(4)[None])
    for tracks, count in ((none, 2), (one, 0), (none, 0)):
        old, new = associate(tracks, np.zeros((count, 2)), np.zeros((count, 2, 2)), GATE)
        assert len(old) == len(new) == 0
