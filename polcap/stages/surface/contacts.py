"""Parts that were cut free -> where they touch what is behind them: the least jump of a border, held along a stretch.

The crease where a ball touches another leans like a limb and is cut with it. The ball then floats before the other, by
as much at every point of the crease, for there the two were together; along its true limb it stands off farther,
and by ever other distances. A part that hides something without touching it has no such stretch.
"""

import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
from polcap.stages.surface.occlusion import Bools
from polcap.stages.surface.pixel_grid import PixelGrid

_PART = 0.002  # of the object's pixels: smaller parts are specks
_LEAST = 10.0  # percentile of the jumps along a border that stands for the least
_ALIKE = 0.04  # by which jumps differ on a stretch where parts touch, over the object's radius
_STRETCH = 0.43  # links of such a stretch, over the object's radius


def contacts(grid: PixelGrid, apart: Bools, excess: Floats, radius: float) -> Bools:
    """Links (L,) at which two parts touch.

    Parameters
    ----------
    grid
        N pixels and their L links.
    apart
        (L,) links whose ends are not on one sheet.
    excess
        (L,) depth step beyond what the ends' slopes explain, positive where it falls away to the right or down [px].
    radius
        Of the object [px].
    """
    part = _parts(grid, ~apart)
    first, second = part[grid.p], part[grid.q]
    border = np.flatnonzero(apart & (first != second) & (first >= 0) & (second >= 0))
    touch = np.zeros(len(apart), dtype=bool)
    first, second = first[border], second[border]
    jump = excess[border] * np.where(first < second, 1, -1)  # of one of two parts before the other
    pair = np.minimum(first, second) * (int(part.max()) + 1) + np.maximum(first, second)
    for number in np.unique(pair):
        at = np.flatnonzero(pair == number)
        before = jump[at] * np.sign(np.median(jump[at]))
        middle, count = _most_alike(before, _ALIKE * radius)
        if count > _STRETCH * radius:
            touch[border[at[np.abs(before - middle) < _ALIKE * radius]]] = True
    return touch


def _most_alike(jump: Floats, width: float) -> tuple[float, int]:
    """Middle and count of the most jumps (B,) within so much of one another, about the least."""
    low = np.sort(jump)
    count = np.searchsorted(low, low + width, side="right") - np.arange(len(low))
    count[low > np.percentile(low, _LEAST) + width] = 0
    most = int(np.argmax(count))
    return float(low[most] + width / 2), int(count[most])


def _parts(grid: PixelGrid, together: Bools) -> NDArray[np.int64]:
    """Number of the part (N,) that links (L,) hold together; −1 on specks."""
    from scipy import sparse
    from scipy.sparse.csgraph import connected_components

    ends = (grid.p[together], grid.q[together])
    graph = sparse.coo_matrix((np.ones(len(ends[0]), dtype=np.int8), ends), (grid.size, grid.size))
    part = connected_components(graph, directed=False)[1].astype(np.int64)
    return np.where(np.bincount(part)[part] > _PART * grid.size, part, -1)
