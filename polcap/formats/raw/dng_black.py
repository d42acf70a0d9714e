"""Black level of every photosite, as a DNG states it: a repeating pattern, and offsets of columns and rows.

LibRaw reports one level per color of the mosaic. If levels vary more, `even_out` makes them equal.

References
----------
Adobe, Digital Negative Specification 1.4: BlackLevelRepeatDim, BlackLevel, BlackLevelDeltaH, BlackLevelDeltaV.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.formats.raw import file_kind
from polcap.formats.raw.file_kind import Directory, TiffStructure, first
from polcap.image_values import Floats

_FLOATING = 3  # SampleFormat; LibRaw scales such counts to integers


def levels_by_photosite(structure: TiffStructure, sizes: Any, channels: int) -> Floats | None:
    """Black levels of a DNG's visible photosites, (H, W, `channels`); None if LibRaw's levels hold them.

    `sizes` are LibRaw's sizes of picture and margins. LibRaw can hold one level, or 2×2 of a Bayer mosaic.
    """
    size = sizes.raw_width, sizes.raw_height, channels
    directory = next((one for one in structure.directories if _size(one) == size and file_kind.is_sensor(one)), None)
    if directory is None or first(directory, file_kind.SAMPLE_FORMAT, 1) == _FLOATING:
        return None
    rows, columns = (max(int(side), 1) for side in (*directory.get(file_kind.BLACK_REPEAT, ()), 1, 1)[:2])
    levels = np.array(directory.get(file_kind.BLACK, ()))
    if levels.size != rows * columns * channels:
        return None
    pattern = levels.reshape(rows, columns, channels)
    by_column = np.array(directory.get(file_kind.BLACK_BY_COLUMN, ()) or (0.0,))
    by_row = np.array(directory.get(file_kind.BLACK_BY_ROW, ()) or (0.0,))
    top, left = (int(edge) for edge in (*directory.get(file_kind.ACTIVE_AREA, ()), 0, 0)[:2])
    is_bayer = directory.get(file_kind.CFA_REPEAT) == (2, 2) and max(rows, columns) <= 2
    is_even_corner = top % 2 == left % 2 == 0  # LibRaw counts the pattern from the corner of the whole sensor
    if not by_column.any() and not by_row.any() and (np.ptp(pattern) == 0 or (is_bayer and is_even_corner)):
        return None
    y, x = np.arange(sizes.height) + sizes.top_margin - top, np.arange(sizes.width) + sizes.left_margin - left
    level = pattern[y[:, None] % rows, x % columns] + by_row.take(y, mode="clip")[:, None, None]
    return np.asarray(level + by_column.take(x, mode="clip")[:, None])


def _size(directory: Directory) -> tuple[int, int, int]:
    """Width, height and channels of a TIFF directory's image."""
    width, height = first(directory, file_kind.WIDTH), first(directory, file_kind.LENGTH)
    return width, height, first(directory, file_kind.SAMPLES, 1)


def even_out(value: NDArray[Any], black: Floats) -> tuple[NDArray[Any], float]:
    """Shift counts (H, W) or (H, W, C) uint16 so that all have the highest of their black levels (H, W, C) or (C,).

    Returns them and that level. Counts beyond the largest of their type are set to it: they were clipped.
    """
    highest = float(black.max())
    raised = value.reshape(*value.shape[:2], -1) + np.rint(highest - black).astype(np.int32)
    return np.minimum(raised, np.iinfo(value.dtype).max).astype(value.dtype).reshape(value.shape), highest
