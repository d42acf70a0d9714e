"""Solve A x = b for the weighted Laplacian of a pixel grid: conjugate gradients, algebraic multigrid inside.

The weights of neighbouring pixels may differ by many powers of ten (surfaces are cut apart where the
depth jumps), so unknowns are lumped only along strong links, within blocks of 3×3 pixels.

References
----------
Vaněk, Mandel & Brezina, Algebraic multigrid by smoothed aggregation, Computing 56 (1996).
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats

_COARSEST = 400  # unknowns that are solved directly
_STRONG = 0.02  # links under this share of √(a_ii a_jj) do not lump their ends
_SPECTRUM = 2.0  # D⁻¹A of a Laplacian with a shift has its eigenvalues in 0…2 (Gershgorin)
_DAMPING = 4 / 3 / _SPECTRUM


@dataclass(frozen=True)
class _Level:
    matrix: Any  # (N, N) CSR
    step: Floats  # (N,) of a damped Jacobi iteration
    prolong: Any  # (N, n) CSR
    restrict: Any  # (n, N) CSR


class Multigrid:
    """One V-cycle for a symmetric positive definite matrix: a preconditioner.

    Parameters
    ----------
    matrix
        (N, N) CSR, float64, off-diagonals ≤ 0.
    cell
        (N, 2) whole-number pixel positions of the unknowns.
    """

    def __init__(self, matrix: Any, cell: NDArray[np.int64]) -> None:
        from scipy.sparse.linalg import splu  # here: importing it costs .3 s of every start

        self.levels: list[_Level] = []
        while matrix.shape[0] > _COARSEST:
            cell = cell // 3
            group, count = _aggregate(matrix, cell)
            if count > 0.7 * matrix.shape[0]:
                break
            prolong = _prolongation(matrix, group, count)
            restrict = prolong.T.tocsr()
            self.levels.append(_Level(matrix, _DAMPING * (1 / matrix.diagonal()), prolong, restrict))
            matrix = (restrict @ (matrix @ prolong)).tocsr()
            kept = np.zeros((count, 2), dtype=np.int64)
            kept[group] = cell
            cell = kept
        self.coarsest = splu(matrix.tocsc())

    def __call__(self, right: Floats) -> Floats:
        """One cycle from zero: about A⁻¹ times a residual (N,)."""
        return self._cycle(0, right)

    def _cycle(self, depth: int, right: Floats) -> Floats:
        if depth == len(self.levels):
            return np.asarray(self.coarsest.solve(right))
        level = self.levels[depth]
        x = level.step * right
        x += level.prolong @ self._cycle(depth + 1, level.restrict @ (right - level.matrix @ x))
        left = right - level.matrix @ x
        left *= level.step
        left += x
        return np.asarray(left)


class Nested:
    """One cycle on a grid whose half resolution has a preconditioner already.

    The coarse equations are those of the same surface on blocks of 2×2 pixels, in the same unit per pixel: a step
    of 1 on the fine grid weighs there as much as here, so block means correct the fine solution unscaled.

    Parameters
    ----------
    matrix
        (N, N) CSR.
    parent
        (N,) number of the block that each unknown lies in.
    coarse
        The preconditioner of the blocks.
    """

    def __init__(self, matrix: Any, parent: NDArray[np.intp], coarse: Callable[[Floats], Floats]) -> None:
        self.matrix, self.parent, self.coarse = matrix.astype(np.float32), parent, coarse
        self.inverse_diagonal = 1 / self.matrix.diagonal()
        self.blocks = int(parent.max()) + 1

    def __call__(self, right: Floats) -> Floats:
        """Smooth, correct on the blocks, smooth: about A⁻¹ times a residual (N,)."""
        right = right.astype(np.float32)
        step = _DAMPING * self.inverse_diagonal
        x = step * right
        left = np.asarray(np.bincount(self.parent, right - self.matrix @ x, self.blocks), dtype=np.float64)
        x = x + self.coarse(left).astype(np.float32)[self.parent]
        return np.asarray(x + step * (right - self.matrix @ x))


def conjugate_gradients(
    matrix: Any, right: Floats, start: Floats, precondition: Any, tolerance: float, most: int
) -> tuple[Floats, int]:
    """Solve A x = b by preconditioned conjugate gradients.

    Parameters
    ----------
    matrix
        A (N, N), symmetric and positive definite; anything with `@`.
    right, start
        b and the first x, (N,).
    precondition
        Residual (N,) → a guess of A⁻¹ times it.
    tolerance
        It ends at |b − A x| ≤ tolerance |b|,
    most
        or after so many iterations.

    Returns
    -------
    x : Floats
        (N,)
    iterations : int
        Taken.

    References
    ----------
    Saad, Iterative Methods for Sparse Linear Systems, 2003, algorithm 9.1.
    """
    x = start
    residual = right - matrix @ x
    goal = tolerance * float(np.linalg.norm(right))
    direction = preconditioned = precondition(residual)
    product = float(residual @ preconditioned)
    for count in range(most):
        if float(np.linalg.norm(residual)) <= goal or product <= 0:
            return x, count
        image = matrix @ direction
        length = product / float(direction @ image)
        x = x + length * direction
        residual = residual - length * image
        preconditioned = precondition(residual)
        product, before = float(residual @ preconditioned), product
        direction = preconditioned + product / before * direction
    return x, most


def _aggregate(matrix: Any, cell: NDArray[np.int64]) -> tuple[NDArray[np.int64], int]:
    """Group number of each unknown: the parts of a cell that strong links hold together."""
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components

    links = matrix.tocoo()
    diagonal = matrix.diagonal()
    row, column = links.row, links.col
    at = cell[:, 0] * (int(cell[:, 1].max()) + 1) + cell[:, 1]
    together = at[row] == at[column]
    together &= links.data**2 > _STRONG**2 * diagonal[row] * diagonal[column]
    graph = sparse.coo_matrix(
        (np.ones(int(together.sum()), dtype=np.int8), (row[together], column[together])), matrix.shape
    )
    count, group = connected_components(graph, directed=False)
    return group.astype(np.int64), int(count)


def _prolongation(matrix: Any, group: NDArray[np.int64], count: int) -> Any:
    """Piecewise constant over the groups, then one damped Jacobi step towards low energy."""
    from scipy import sparse

    size = matrix.shape[0]
    lump = sparse.csr_matrix((np.ones(size), group, np.arange(size + 1)), (size, count))
    step = sparse.diags(_DAMPING / matrix.diagonal())
    return (lump - step @ (matrix @ lump)).tocsr()
