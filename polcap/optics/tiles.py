"""Choice of image tiles: the best-scored tiles of each cell of a coarse grid, so that they cover the picture."""

import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Floats


def spread_over_cells(score: Floats, cells: tuple[int, int], per_cell: int) -> NDArray[np.int64]:
    """Rows and columns (T, 2) of tiles: at most `per_cell` with the highest positive score (R, C) of each cell.

    The grid of tiles is divided into `cells` = (rows, columns), or fewer where there are fewer tiles.
    """
    rows, columns = score.shape
    found = []
    for cell_rows in np.array_split(np.arange(rows), min(cells[0], rows)):
        for cell_columns in np.array_split(np.arange(columns), min(cells[1], columns)):
            cell = score[np.ix_(cell_rows, cell_columns)]
            best = np.argsort(cell, axis=None)[::-1][:per_cell]
            i, j = np.unravel_index(best[cell.ravel()[best] > 0], cell.shape)
            found.append(np.stack([cell_rows[i], cell_columns[j]], axis=1))
    return np.concatenate([np.zeros((0, 2), np.int64), *found])
