"""Half-spaces that keep the positions of a plan out of the no-go sets."""

from dataclasses import dataclass

import numpy as np

from scp_mpc.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class HalfSpaces:
    """normal' p + slope s >= offset, one for each of M obstacle slots and N stages.

    Attributes:
        normal: (M, N, d) gradient with respect to the position; zero in inactive slots.
        slope: (M, N) derivative with respect to s [m]; zero in inactive slots.
        offset: (M, N) right-hand sides [m]; minus infinity in inactive slots.
        value: (M, N) true constraint function at the linearisation point [m], which is to be
            non-negative; plus infinity in inactive slots.
        bend: (M, N, d, d-1) factor of the second derivative in p for the slots that are polytopes,
            zero in others; None if there are none.
    """

    normal: FloatArray
    slope: FloatArray
    offset: FloatArray
    value: FloatArray
    bend: FloatArray | None = None

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
