"""The two inflations of the s-sigma ellipsoid by the radii of robot and obstacle.

Notation:
    p       (N, d)      robot positions at stages 1 .. N [m]
    s       (M,)        size of each obstacle's ellipsoid [standard deviations]
    y       (M, N, d)   R'(p - mu), position in the ellipsoid's axes [m]
    g       (M, N)      constraint function: outside the no-go set means g(p, s) >= 0 [m]

Other symbols as in `no_go.py`. Both inflations return g together with its linearisation. For
obstacles that are polytopes there is only one, whatever the inflation of the others,

    g(p, s) = sd(p - mu) - s sigma - r,     sigma^2 the largest eigenvalue of Sigma,

the distance to polytope (+) ball(s sigma + r): jointly convex in (p, s), so that

    n'(p - mu) - h(n) - s sigma >= r

lies inside the true feasible set for every unit n, h as in `polytopes.py`. The obstacle touches
only if n'(p - o) - h(n) <= r, and n'o has a standard deviation of sigma at most: so
s = Phi^-1(1 - delta) bounds the probability of a collision by delta here, too.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from scp_mpc.arrays import FloatArray, IntArray
from scp_mpc.geometry.ellipsoid import signed_distance
from scp_mpc.geometry.no_go import HalfSpaces, NoGoSets
from scp_mpc.geometry.polytopes import Polytopes
from scp_mpc.geometry.tangent_basis import inverse_root, tangents

_POINT = 1e-9  # [m] a semi-axis below this is that of a point


class Inflation(ABC):
    """A shape for the no-go set: how the s-sigma ellipsoid grows by the radii.

    Args:
        reference: s_ref, at which `clearance` is measured and lengths are scaled.
    """

    def __init__(self, reference: float) -> None:
        """Remember the reference size."""
        self._reference = reference

    def linearise(
        self, sets: NoGoSets, positions: FloatArray, s: FloatArray, start: FloatArray
    ) -> HalfSpaces:
        """Linearise g about positions (N, d) and s (M,).

        `start` (M, d) holds each obstacle's offset p_0 - mu_0 now. Where the nearest side of the
        set is not unique, the offset one stage earlier decides; at p = mu that is the direction
        opposite to the relative velocity: the side from which the robot comes.
        """
        if sets.shapes is None:
            return self._linearise(sets, positions, s, start)
        positions = np.broadcast_to(positions, sets.means.shape)
        M, N, d = sets.means.shape
        whole = replace(HalfSpaces.none(M, N, d), curvature=np.zeros((M, N, d, d - 1)))
        j = sets.shapes.others
        if len(j):
            _put(self._linearise(sets.taken(j), positions[j], s[j], start[j]), whole, j)
        j = sets.shapes.slots
        if len(j):
            offsets = positions[j] - sets.means[j]
            side = partial(_one_stage_earlier, offsets, start[j])
            _put(linearise_walls(sets.taken(j), positions[j], s[j], side), whole, j)
        return whole

    def curvature_factor(self, sets: NoGoSets, s: FloatArray, spaces: HalfSpaces) -> FloatArray:
        """Factor L (M, N, d+1, d-1) of g's second derivative in (p, s): Hessian = L L'.

        Args:
            sets: The obstacles' ellipsoids.
            s: (M,) sizes where g was linearised.
            spaces: What `linearise` made of it there.
        """
        if sets.shapes is None:
            return self._curvature_factor(sets, s, spaces)
        assert spaces.curvature is not None
        M, N, d = sets.means.shape
        whole = np.zeros((M, N, d + 1, d - 1))  # s moves a wall's faces without turning them
        whole[:, :, :d] = spaces.curvature
        j = sets.shapes.others
        j = j[sets.active[j]]
        if len(j):
            part = HalfSpaces(spaces.normal[j], spaces.slope[j], spaces.offset[j], spaces.value[j])
            whole[j] = self._curvature_factor(sets.taken(j), s[j], part)
        return whole

    def clearance(self, sets: NoGoSets, positions: FloatArray) -> FloatArray:
        """Signed distance (M, N) [m] to the no-go set at s = s_ref; plus infinity if inactive."""
        if sets.shapes is None:
            return self._clearance(sets, positions)
        positions = np.broadcast_to(positions, sets.means.shape)
        whole = np.empty(sets.means.shape[:2])
        j = sets.shapes.others
        if len(j):
            whole[j] = self._clearance(sets.taken(j), positions[j])
        j = sets.shapes.slots
        if len(j):
            whole[j] = wall_clearance(sets.taken(j), positions[j], self._reference)
        return whole

    @abstractmethod
    def _linearise(
        self, sets: NoGoSets, positions: FloatArray, s: FloatArray, start: FloatArray
    ) -> HalfSpaces:
        """`linearise` for ellipsoids."""

    @abstractmethod
    def _curvature_factor(self, sets: NoGoSets, s: FloatArray, spaces: HalfSpaces) -> FloatArray:
        """`curvature_factor` for ellipsoids."""

    @abstractmethod
    def _clearance(self, sets: NoGoSets, positions: FloatArray) -> FloatArray:
        """`clearance` for ellipsoids."""


class ExactInflation(Inflation):
    """Ellipsoid (+) ball, the Minkowski sum: g = sd(p, s) - r.

    sd(p, s) = max_{|n|=1} n'(p - mu) - s sqrt(n' Sigma n) is jointly convex, so that

        n'(p - mu) - s sqrt(n' Sigma n) >= r

    lies inside the true feasible set for every unit n (convex-concave procedure: Lipp and Boyd,
    2016). With s = Phi^-1(1 - delta) the same half-space bounds the probability of a collision by
    delta (Blackmore, Ono and Williams, 2011).
    """

    def _linearise(
        self, sets: NoGoSets, positions: FloatArray, s: FloatArray, start: FloatArray
    ) -> HalfSpaces:
        """See the base class; normals are unit vectors."""
        offsets = positions - sets.means
        y = sets.to_eigenframe(offsets)

        def side() -> FloatArray:
            return sets.to_eigenframe(_one_stage_earlier(offsets, start))

        sd, n = signed_distance(y, s[:, None, None] * sets.deviations, side)
        across = sets.deviations * n
        slope = -np.sqrt(np.add.reduce(across * across, axis=-1))
        normal = sets.to_world(n)
        offset = np.add.reduce(normal * sets.means, axis=-1) + sets.radii
        return _masked(sets, normal, slope, offset, sd - sets.radii)

    def _curvature_factor(self, sets: NoGoSets, s: FloatArray, spaces: HalfSpaces) -> FloatArray:
        """See the base class.

        From y = grad h(n) + sd n with the support function h(n) = s |diag(sigma) n|: on the tangent
        space T of n, dn = M^-1 (T'dy - T'(dh_n/ds) ds) with M = T' h_nn T + sd.
        """
        n = sets.to_eigenframe(spaces.normal)
        half_width = np.maximum(-spaces.slope, _POINT)[..., None]  # sqrt(n' Sigma n)
        pull = sets.deviations**2 * n / half_width  # dh_n/ds
        T = tangents(n)
        sd = spaces.value + sets.radii
        pulled = (pull[..., None, :] @ T)[..., 0, :]
        wide = sets.deviations[..., None] * T
        stiffness = np.swapaxes(wide, -2, -1) @ wide - pulled[..., :, None] * pulled[..., None, :]
        stiffness *= (s[:, None, None] / half_width)[..., None]
        stiffness += np.maximum(sd, _POINT)[..., None, None] * np.eye(T.shape[-1])
        L = T @ inverse_root(stiffness, _POINT)
        return np.concatenate([sets.rotations @ L, -pull[..., None, :] @ L], axis=-2)

    def _clearance(self, sets: NoGoSets, positions: FloatArray) -> FloatArray:
        """See the base class."""
        y = sets.to_eigenframe(positions - sets.means)
        sd, _ = signed_distance(y, self._reference * sets.deviations)
        return np.where(sets.active[:, None], sd - sets.radii, np.inf)


class AxesInflation(Inflation):
    """The report's ellipse with semi-axes e_l = s sigma_l + r: equations (5a) and (14).

    g = c (|y / e| - 1), where c is the shortest semi-axis at s_ref, so that g is in metres and
    never exceeds the distance to the ellipse there. It is the norm that is linearised, not its
    square, whose tangent stands too far out by (1 + |y/e|^2) / (2 |y/e|).

    Not safe: the ellipse lies inside ellipse (+) disc and touches it on the axes only (Brito et
    al., 2019). Kept to reproduce the report. g is convex in p but not jointly in (p, s).
    """

    def _linearise(
        self, sets: NoGoSets, positions: FloatArray, s: FloatArray, start: FloatArray
    ) -> HalfSpaces:
        """See the base class."""
        offsets = positions - sets.means
        y = sets.to_eigenframe(offsets)
        e = np.maximum(s[:, None, None] * sets.deviations + sets.radii[..., None], _POINT)
        scale = self._scale(sets)
        w = y / e
        at_centre = np.maximum.reduce(np.abs(w), axis=-1, keepdims=True) < 1e-12
        if at_centre.any():
            side = sets.to_eigenframe(_one_stage_earlier(offsets, start))
            w = np.where(at_centre, _nudged(side / e), w)
        norm = np.sqrt(np.add.reduce(w * w, axis=-1))
        gradient = scale[..., None] * w / (norm[..., None] * e)
        slope = -np.add.reduce(gradient * w * sets.deviations, axis=-1)
        value = scale * (norm - 1)
        normal = sets.to_world(gradient)
        offset = np.add.reduce(normal * positions, axis=-1) + slope * s[:, None] - value
        return _masked(sets, normal, slope, offset, value)

    def _curvature_factor(self, sets: NoGoSets, s: FloatArray, spaces: HalfSpaces) -> FloatArray:
        """See the base class; the change of w with s alone is left out: g is not convex in it."""
        e = np.maximum(s[:, None, None] * sets.deviations + sets.radii[..., None], _POINT)
        scale = self._scale(sets)[..., None]
        norm = np.maximum(spaces.value[..., None] / scale + 1, 1e-12)
        direction = e * sets.to_eigenframe(spaces.normal)
        direction /= np.sqrt(np.add.reduce(direction * direction, axis=-1, keepdims=True))
        T = tangents(direction) * np.sqrt(scale / norm)[..., None]
        L = T / e[..., None]
        across = -(norm * direction * sets.deviations)[..., None, :] @ L
        return np.concatenate([sets.rotations @ L, across], axis=-2)

    def _clearance(self, sets: NoGoSets, positions: FloatArray) -> FloatArray:
        """See the base class."""
        y = sets.to_eigenframe(positions - sets.means)
        e = self._reference * sets.deviations + sets.radii[..., None]
        sd, _ = signed_distance(y, e)
        return np.where(sets.active[:, None], sd, np.inf)

    def _scale(self, sets: NoGoSets) -> FloatArray:
        shortest = self._reference * sets.deviations.min(axis=-1) + sets.radii
        return np.maximum(shortest, _POINT)


def _one_stage_earlier(offsets: FloatArray, start: FloatArray) -> FloatArray:
    return np.concatenate([start[:, None], offsets[:, :-1]], axis=1)


def _nudged(direction: FloatArray) -> FloatArray:
    """Vectors of length 1e-12 along `direction`, or along the first axis where that vanishes."""
    length = np.linalg.norm(direction, axis=-1, keepdims=True)
    first = np.eye(direction.shape[-1])[0]
    return 1e-12 * np.where(length > 0, direction / np.where(length > 0, length, 1.0), first)


def _put(part: HalfSpaces, whole: HalfSpaces, slots: IntArray) -> None:
    """Write the half-spaces of some slots into those of all."""
    for name in ("normal", "slope", "offset", "value"):
        getattr(whole, name)[slots] = getattr(part, name)
    if part.curvature is not None and whole.curvature is not None:
        whole.curvature[slots] = part.curvature


def _masked(
    sets: NoGoSets,
    normal: FloatArray,
    slope: FloatArray,
    offset: FloatArray,
    value: FloatArray,
) -> HalfSpaces:
    if sets.active.all():
        return HalfSpaces(normal, slope, offset, value)
    on = sets.active[:, None]
    return HalfSpaces(
        np.where(on[..., None], normal, 0.0),
        np.where(on, slope, 0.0),
        np.where(on, offset, -np.inf),
        np.where(on, value, np.inf),
    )


def linearise_walls(
    sets: NoGoSets, positions: FloatArray, s: FloatArray, side: Callable[[], FloatArray]
) -> HalfSpaces:
    """Linearise g about positions (M, N, d) and s (M,); see `Inflation.linearise`."""
    y = positions - sets.means
    near = _shapes(sets).nearest(y, side)
    sigma = largest(sets)
    value = near.distance - s[:, None] * sigma - sets.radii
    offset = np.add.reduce(near.normal * positions, axis=-1) - near.distance + sets.radii
    return HalfSpaces(near.normal, -sigma, offset, value, near.curvature)


def wall_clearance(sets: NoGoSets, positions: FloatArray, s: float) -> FloatArray:
    """G (M, N) at positions (M, N, d) and one size for all."""
    distance = _shapes(sets).distance(positions - sets.means)
    return distance - s * largest(sets) - sets.radii


def largest(sets: NoGoSets) -> FloatArray:
    """Largest standard deviations sigma (M, N) [m]."""
    sigma: FloatArray = sets.deviations.max(axis=-1)
    return sigma


def _shapes(sets: NoGoSets) -> Polytopes:
    assert sets.shapes is not None
    return sets.shapes
