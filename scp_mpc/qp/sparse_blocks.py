"""A sparse matrix whose pattern is fixed once and whose named blocks are rewritten many times."""

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from scp_mpc.arrays import FloatArray, IntArray


class SparseBlocks:
    """Builds a CSC matrix from named blocks and remembers where each block's values went.

    Initialisation: `add` every block, then `build` the matrix. Entries stay in the pattern even
    where their value is zero.

    Usage: `matrix.data[blocks["name"]] = values`, in the order in which the block was added.
    """

    def __init__(self) -> None:
        """Start with no blocks."""
        self._rows: list[IntArray] = []
        self._columns: list[IntArray] = []
        self._values: list[FloatArray] = []
        self._names: list[str] = []

    def add(self, name: str, rows: ArrayLike, columns: ArrayLike, values: ArrayLike) -> None:
        """Add a block: arrays of one shape after broadcasting, read in C order."""
        r, c, v = np.broadcast_arrays(rows, columns, values)
        self._rows.append(r.ravel().astype(np.intp))
        self._columns.append(c.ravel().astype(np.intp))
        self._values.append(v.ravel().astype(np.float64))
        self._names.append(name)

    def build(self, shape: tuple[int, int]) -> tuple[sparse.csc_matrix, dict[str, IntArray]]:
        """Return the matrix and, for each block, the places of its values in `matrix.data`.

        Raises:
            ValueError: Two blocks claim the same entry.
        """
        rows, columns = np.concatenate(self._rows), np.concatenate(self._columns)
        values = np.concatenate(self._values)
        order = np.lexsort((rows, columns))
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        indptr = np.concatenate([[0], np.cumsum(np.bincount(columns, minlength=shape[1]))])
        matrix = sparse.csc_matrix((values[order], rows[order], indptr), shape=shape)
        if not matrix.has_canonical_format:
            raise ValueError("two blocks claim the same entry")
        sizes = np.cumsum([len(v) for v in self._values])[:-1]
        return matrix, dict(zip(self._names, np.split(place, sizes), strict=True))
