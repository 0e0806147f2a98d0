"""The s-sigma ellipsoids of all obstacles along the horizon, their shapes, and their half-spaces.

Notation:
    M, N, d     obstacle slots, horizon, dimension of the workspace
    mu      (M, N, d)       means at stages 1 .. N [m]
    R       (M, N, d, d)    eigenvectors of Sigma in columns
    sigma   (M, N, d)       square roots of Sigma's eigenvalues: standard deviations [m]
    r       (M, N)          robot radius + obstacle radius, or more [m]
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import BoolArray, FloatArray, IntArray
from scp_mpc.geometry.polytopes import Polytopes
from scp_mpc.obstacles.prediction import ObstaclePrediction


@dataclass(frozen=True, eq=False)
class NoGoSets:
    """Eigen-decomposed predictions of M obstacle slots at N stages.

    Slots without an obstacle are inactive: they hold unit values, and what is computed from them
    is discarded through `active`. `shapes` says which slots are polytopes; None if there are none.
    """

    means: FloatArray
    rotations: FloatArray
    deviations: FloatArray
    radii: FloatArray
    active: BoolArray
    shapes: Polytopes | None = None

    @classmethod
    def from_predictions(
        cls,
        predictions: Sequence[ObstaclePrediction],
        robot_radius: float,
        slots: int,
        horizon: int,
        dim: int,
    ) -> "NoGoSets":
        """Stack rows 1 .. N of the predictions; the remaining slots stay inactive."""
        return cls._stacked(predictions, slice(1, horizon + 1), robot_radius, slots, horizon, dim)

    @classmethod
    def now(cls, predictions: Sequence[ObstaclePrediction], robot_radius: float) -> "NoGoSets":
        """Stack row 0 of the predictions, as one stage."""
        dim = predictions[0].dim if predictions else 2
        return cls._stacked(predictions, slice(0, 1), robot_radius, len(predictions), 1, dim)

    @classmethod
    def pairs(
        cls,
        means: FloatArray,
        covariances: FloatArray,
        radii: FloatArray,
        shapes: Polytopes | None = None,
    ) -> "NoGoSets":
        """Single stages, each in a slot of its own: means (K, d), covariances (K, d, d).

        Args:
            means: Expected positions [m].
            covariances: Position covariances [m^2].
            radii: (K,) robot radius + obstacle radius [m].
            shapes: Of the K slots; None if all are round.
        """
        variances, rotations = np.linalg.eigh(covariances)
        deviations = np.sqrt(np.maximum(variances, 0.0))
        on = np.ones(len(means), dtype=np.bool_)
        return cls(
            means[:, None], rotations[:, None], deviations[:, None], radii[:, None], on, shapes
        )

    @classmethod
    def stacked(
        cls,
        means: FloatArray,
        covariances: FloatArray,
        radii: FloatArray,
        slots: int,
        shapes: Polytopes | None = None,
    ) -> "NoGoSets":
        """Fill the first J slots with means (J, N, d), covariances (J, N, d, d), radii (J, N)."""
        count, stages, dim = means.shape
        mu = np.zeros((slots, stages, dim))
        rotations = np.zeros((slots, stages, dim, dim))
        rotations[count:] = np.eye(dim)
        deviations = np.ones((slots, stages, dim))
        reach = np.zeros((slots, stages))
        if count:
            variances, rotations[:count] = np.linalg.eigh(covariances)
            deviations[:count] = np.sqrt(np.maximum(variances, 0.0))
            mu[:count], reach[:count] = means, radii
        shapes = None if shapes is None else shapes.padded(slots)
        return cls(mu, rotations, deviations, reach, np.arange(slots) < count, shapes)

    @classmethod
    def _stacked(
        cls,
        predictions: Sequence[ObstaclePrediction],
        rows: slice,
        robot_radius: float,
        slots: int,
        horizon: int,
        dim: int,
    ) -> "NoGoSets":
        count = len(predictions)
        means = np.array([o.means[rows] for o in predictions]).reshape(count, horizon, dim)
        covariances = np.array([o.covariances[rows] for o in predictions])
        radii = robot_radius + np.array([o.radius for o in predictions])
        radii, shapes = np.tile(radii[:, None], horizon), Polytopes.of(predictions)
        return cls.stacked(means, covariances, radii, slots, shapes)

    def taken(self, slots: IntArray) -> "NoGoSets":
        """The given slots, in that order."""
        return NoGoSets(
            self.means[slots],
            self.rotations[slots],
            self.deviations[slots],
            self.radii[slots],
            self.active[slots],
            None if self.shapes is None else self.shapes.taken(slots),
        )

    def to_eigenframe(self, offsets: FloatArray) -> FloatArray:
        """Rotate offsets (M, N, d) from the world into the ellipsoids' axes: R' v."""
        return np.einsum("mnji,mnj->mni", self.rotations, offsets)

    def to_world(self, vectors: FloatArray) -> FloatArray:
        """Rotate vectors (M, N, d) from the ellipsoids' axes into the world: R v."""
        return np.einsum("mnij,mnj->mni", self.rotations, vectors)


@dataclass(frozen=True, eq=False)
class HalfSpaces:
    """normal' p + slope s >= offset, one for each of M obstacle slots and N stages.

    Attributes:
        normal: (M, N, d) gradient with respect to the position; zero in inactive slots.
        slope: (M, N) derivative with respect to s [m]; zero in inactive slots.
        offset: (M, N) right-hand sides [m]; minus infinity in inactive slots.
        value: (M, N) true constraint function at the linearisation point [m], which is to be
            non-negative; plus infinity in inactive slots.
        curvature: (M, N, d, d-1) factor of the second derivative in p for the slots that are
            polytopes, zero in others; None if there are none.
    """

    normal: FloatArray
    slope: FloatArray
    offset: FloatArray
    value: FloatArray
    curvature: FloatArray | None = None

    @classmethod
    def none(cls, obstacles: int, stages: int, dim: int) -> "HalfSpaces":
        """Half-spaces that constrain nothing, for every slot."""
        shape = (obstacles, stages)
        return cls(
            np.zeros((*shape, dim)),
            np.zeros(shape),
            np.full(shape, -np.inf),
            np.full(shape, np.inf),
        )

    def residual(self, positions: FloatArray, s: FloatArray) -> FloatArray:
        """Return normal' p + slope s - offset (M, N) for positions (N, d) and s (M,)."""
        along = np.einsum("mnd,nd->mn", self.normal, positions)
        return along + self.slope * s[:, None] - self.offset
