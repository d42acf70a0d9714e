"""The object's pixels as a graph: links to the right and down, and the sparse matrices on them."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats


class PixelGrid:
    """Pixels of a mask (H, W), numbered row by row, and the links between neighbours.

    `p` and `q` (L,) are the links' ends: first all links to the right, then, from `turn` on, all links down.
    """

    def __init__(self, mask: NDArray[np.bool_]) -> None:
        self.mask = mask
        number = np.full(mask.shape, -1, dtype=np.int32)
        number[mask] = np.arange(int(mask.sum()), dtype=np.int32)
        self.number = number
        self.row, self.column = np.nonzero(mask)
        right, down = _links(number[:, :-1], number[:, 1:]), _links(number[:-1], number[1:])
        self.turn = len(right[0])
        self.p, self.q = (np.concatenate(ends) for ends in zip(right, down))
        self._lay_out(right, down)

    @property
    def size(self) -> int:
        return len(self.row)

    @property
    def pixel(self) -> NDArray[np.int64]:
        """Row and column of each pixel, (N, 2)."""
        return np.stack([self.row, self.column], axis=-1)

    def _lay_out(self, right: Any, down: Any) -> None:
        """The matrix's pattern: up, left, itself, right and down of each pixel, which is in column order."""
        size, count = self.size, len(self.p)
        place = np.full((size, 5), -1, dtype=np.int32)  # which link or pixel each stored value belongs to
        link = np.arange(count, dtype=np.int32)
        place[self.q[self.turn :], 0] = link[self.turn :]
        place[self.q[: self.turn], 1] = link[: self.turn]
        place[:, 2] = count + np.arange(size, dtype=np.int32)
        place[self.p[: self.turn], 3] = link[: self.turn]
        place[self.p[self.turn :], 4] = link[self.turn :]
        neighbour = np.zeros((size, 5), dtype=np.int32)
        neighbour[down[1], 0], neighbour[right[1], 1] = down[0], right[0]
        neighbour[:, 2] = np.arange(size, dtype=np.int32)
        neighbour[right[0], 3], neighbour[down[0], 4] = right[1], down[1]
        there = place >= 0
        self._place = place[there]
        self._indices = neighbour[there]
        self._starts = np.concatenate([[0], np.cumsum(there.sum(axis=1))]).astype(np.int32)

    def laplacian(self, link: Floats, diagonal: Floats) -> Any:
        """Matrix (N, N) of the links' weights (L,) plus a diagonal (N,)."""
        total = diagonal + np.bincount(self.p, link, self.size) + np.bincount(self.q, link, self.size)
        values = np.concatenate([-link, total])[self._place]
        from scipy import sparse  # here: a start that integrates nothing does without SciPy

        return sparse.csr_matrix((values, self._indices, self._starts), (self.size, self.size))

    def divergence(self, flux: Floats) -> Floats:
        """What flows into each pixel, (N,), of a flux (L,) from p to q."""
        into = np.asarray(np.bincount(self.q, flux, self.size), dtype=np.float64)
        return np.asarray(into - np.bincount(self.p, flux, self.size))

    def image(self, values: NDArray[Any], outside: float = np.nan) -> NDArray[Any]:
        """Values (N,) in their places, (H, W)."""
        full = np.full(self.mask.shape, outside, dtype=values.dtype)
        full[self.mask] = values
        return full


def _links(first: NDArray[np.int32], second: NDArray[np.int32]) -> tuple[Any, Any]:
    both = (first >= 0) & (second >= 0)
    return first[both], second[both]
