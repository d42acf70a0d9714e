"""Sparse linear systems on a pixel grid: weighted Laplacians, solved by multigrid-preconditioned conjugate gradients.

Weights of neighboring links may differ by many powers of ten (cuts are links of almost no weight), so unknowns are
aggregated along strong links only, within blocks of 3×3 pixels.

References
----------
Vaněk, Mandel & Brezina, Algebraic multigrid by smoothed aggregation, Computing 56 (1996).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats

_COARSEST = 400  # unknowns that are solved directly
_STRONG = 0.02  # least link, over √(a_ii a_jj), along which unknowns are aggregated
_LEAST_COARSENING = 0.7  # the hierarchy ends where a coarser level would hold a greater share of the unknowns
_SPECTRUM = 2.0  # D⁻¹A of a Laplacian with a shift has its eigenvalues in 0…2 (Gershgorin)
_DAMPING = 4 / 3 / _SPECTRUM  # Vaněk et al.


class PixelGrid:
    """The N pixels of a mask (H, W) as a graph: pixels numbered row by row, and L links between neighbors.

    Link l joins the pixels `p[l]` and `q[l]`. Links to the right come first; links from number `first_down` on go down.
    """

    def __init__(self, mask: Bools) -> None:
        self.mask = mask
        number = np.full(mask.shape, -1, dtype=np.int32)
        number[mask] = np.arange(int(mask.sum()), dtype=np.int32)
        self.pixel = np.argwhere(mask)  # (N, 2) row and column
        self.row, self.column = self.pixel.T
        self.size = len(self.pixel)  # N
        right, down = _links(number[:, :-1], number[:, 1:]), _links(number[:-1], number[1:])
        self.first_down = len(right[0])
        self.p, self.q = (np.concatenate(ends) for ends in zip(right, down))
        self._make_pattern(right, down)

    def _make_pattern(self, right: Any, down: Any) -> None:
        """Compute the sparsity pattern of matrices on this grid: a pixel with its neighbors up, left, right, down."""
        size, count = self.size, len(self.p)
        place = np.full((size, 5), -1, dtype=np.int32)  # which link or pixel each stored value belongs to
        link = np.arange(count, dtype=np.int32)
        place[self.q[self.first_down :], 0] = link[self.first_down :]
        place[self.q[: self.first_down], 1] = link[: self.first_down]
        place[:, 2] = count + np.arange(size, dtype=np.int32)
        place[self.p[: self.first_down], 3] = link[: self.first_down]
        place[self.p[self.first_down :], 4] = link[self.first_down :]
        neighbor = np.zeros((size, 5), dtype=np.int32)
        neighbor[down[1], 0], neighbor[right[1], 1] = down[0], right[0]
        neighbor[:, 2] = np.arange(size, dtype=np.int32)
        neighbor[right[0], 3], neighbor[down[0], 4] = right[1], down[1]
        stored = place >= 0
        self._place = place[stored]
        self._indices = neighbor[stored]
        self._starts = np.concatenate([[0], np.cumsum(stored.sum(axis=1))]).astype(np.int32)

    def laplacian(self, link: Floats, diagonal: Floats) -> Any:
        """Weighted Laplacian as a CSR matrix (N, N), from link weights (L,), plus a diagonal (N,)."""
        from scipy import sparse  # here: a start that integrates nothing does without SciPy

        total = diagonal + np.bincount(self.p, link, self.size) + np.bincount(self.q, link, self.size)
        values = np.concatenate([-link, total])[self._place]
        return sparse.csr_matrix((values, self._indices, self._starts), (self.size, self.size))

    def divergence(self, flux: Floats) -> Floats:
        """Divergence (N,) of a flux (L,) along the links: inflow of each pixel minus outflow."""
        into = np.asarray(np.bincount(self.q, flux, self.size), dtype=np.float64)
        return np.asarray(into - np.bincount(self.p, flux, self.size))

    def image(self, values: NDArray[Any], outside: float = np.nan) -> NDArray[Any]:
        """Place values (N,) at their pixels in an image (H, W)."""
        full = np.full(self.mask.shape, outside, dtype=values.dtype)
        full[self.mask] = values
        return full

    def links(self, right: NDArray[Any], down: NDArray[Any]) -> NDArray[Any]:
        """Values (L,) of the links in their order, from images of the links right (H, W−1) and down (H−1, W)."""
        mask = self.mask
        return np.concatenate([right[mask[:, :-1] & mask[:, 1:]], down[mask[:-1] & mask[1:]]])


def _links(first: NDArray[np.int32], second: NDArray[np.int32]) -> tuple[Any, Any]:
    both = (first >= 0) & (second >= 0)
    return first[both], second[both]


def connected_parts(first: NDArray[Any], second: NDArray[Any], count: int) -> NDArray[np.int64]:
    """Number (N,) of the connected part of each of N = `count` nodes, by edges between `first` and `second` (M,)."""
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components

    graph = sparse.coo_matrix((np.ones(len(first), np.int8), (first, second)), (count, count))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def conjugate_gradients(
    matrix: Any, right: Floats, start: Floats, precondition: Callable[[Floats], Floats], tolerance: float, most: int
) -> tuple[Floats, int]:
    """Solve A x = b for a symmetric, positive definite A by conjugate gradients; returns x (N,) and the iterations.

    `precondition` maps a residual (N,) to an estimate of A⁻¹ times the residual. The iterations end at
    |b − A x| ≤ tolerance |b|, or after `most`.
    """
    from scipy.sparse.linalg import LinearOperator, cg

    operator = LinearOperator(matrix.shape, precondition, dtype=np.float64)
    steps: list[None] = []
    x, _ = cg(matrix, right, start, rtol=tolerance, maxiter=most, M=operator, callback=lambda _: steps.append(None))
    return np.asarray(x), len(steps)


@dataclass(frozen=True)
class MultigridLevel:
    """One level of the multigrid hierarchy: N unknowns, n on the next level."""

    matrix: Any  # (N, N) CSR
    step: Floats  # (N,) of a damped Jacobi iteration
    prolong: Any  # (N, n) CSR
    restrict: Any  # (n, N) CSR


class Multigrid:
    """Algebraic multigrid preconditioner: one V-cycle for a symmetric positive definite matrix.

    The matrix (N, N) is CSR, float64, with off-diagonals ≤ 0. `cell` (N, 2) has the whole-number pixel positions of the
    unknowns.
    """

    def __init__(self, matrix: Any, cell: NDArray[np.int64]) -> None:
        from scipy.sparse.linalg import splu  # here: importing it costs .3 s of every start

        self.levels: list[MultigridLevel] = []
        while matrix.shape[0] > _COARSEST:
            cell = cell // 3
            group = _aggregate(matrix, cell)
            count = int(group.max()) + 1
            if count > _LEAST_COARSENING * matrix.shape[0]:
                break
            prolong = _prolongation(matrix, group, count)
            restrict = prolong.T.tocsr()
            self.levels.append(MultigridLevel(matrix, _DAMPING * (1 / matrix.diagonal()), prolong, restrict))
            matrix = (restrict @ (matrix @ prolong)).tocsr()
            cell_of_group = np.zeros((count, 2), dtype=np.int64)
            cell_of_group[group] = cell
            cell = cell_of_group
        self.coarsest = splu(matrix.tocsc())

    def __call__(self, right: Floats) -> Floats:
        """One V-cycle from zero: approximates A⁻¹ times a residual (N,)."""
        return self._cycle(0, right)

    def _cycle(self, depth: int, right: Floats) -> Floats:
        """One V-cycle from level `depth` on: smoothing, correction from the coarser level, smoothing."""
        if depth == len(self.levels):
            return np.asarray(self.coarsest.solve(right))
        level = self.levels[depth]
        x = level.step * right
        x += level.prolong @ self._cycle(depth + 1, level.restrict @ (right - level.matrix @ x))
        update = right - level.matrix @ x
        update *= level.step
        update += x
        return np.asarray(update)


def _aggregate(matrix: Any, cell: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number (N,) of each unknown's group on the next coarser level: a part of a cell that strong links join."""
    links = matrix.tocoo()
    diagonal = matrix.diagonal()
    row, column = links.row, links.col
    cell_number = cell[:, 0] * (int(cell[:, 1].max()) + 1) + cell[:, 1]
    joined = cell_number[row] == cell_number[column]
    joined &= links.data**2 > _STRONG**2 * diagonal[row] * diagonal[column]
    return connected_parts(row[joined], column[joined], len(cell))


def _prolongation(matrix: Any, group: NDArray[np.int64], count: int) -> Any:
    """Prolongation matrix: constant over each group, then smoothed by one damped Jacobi step."""
    from scipy import sparse

    size = matrix.shape[0]
    piecewise = sparse.csr_matrix((np.ones(size), group, np.arange(size + 1)), (size, count))
    step = sparse.diags(_DAMPING / matrix.diagonal())
    return (piecewise - step @ (matrix @ piecewise)).tocsr()


class TwoGrid:
    """Two-grid preconditioner: one cycle on a grid, with a correction from the grid of half its resolution.

    The coarse grid has one unknown per block of 2×2 pixels, and a preconditioner of its own. Both grids weight a link
    by the same law, so the coarse correction is added to all pixels of a block without a factor.

    The matrix (N, N) is CSR; `block` (N,) is the number of each unknown's block, `coarse` the preconditioner of the
    blocks' matrix.
    """

    def __init__(self, matrix: Any, block: NDArray[np.intp], coarse: Callable[[Floats], Floats]) -> None:
        self.matrix, self.block, self.coarse = matrix.astype(np.float32), block, coarse
        self.inverse_diagonal = 1 / self.matrix.diagonal()
        self.count = int(block.max()) + 1

    def __call__(self, right: Floats) -> Floats:
        """One two-grid cycle (smooth, correct on the blocks, smooth): approximates A⁻¹ times a residual (N,)."""
        right = right.astype(np.float32)
        step = _DAMPING * self.inverse_diagonal
        x = step * right
        residual = np.asarray(np.bincount(self.block, right - self.matrix @ x, self.count), dtype=np.float64)
        x = x + self.coarse(residual).astype(np.float32)[self.block]
        return np.asarray(x + step * (right - self.matrix @ x), dtype=np.float64)
