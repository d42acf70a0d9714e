"""Finds the object without a network: it is brighter than the picture's border, or has another color.

Under a flash near the lens, the near object is bright, and the far or black backdrop is dark.
"""

import cv2
import numpy as np

from polcap.errors import ObjectError
from polcap.image_values import Bits, Bools, Floats
from polcap.stages.mask import graph_cut
from polcap.stages.mask.likely_regions import fill_holes

STOPS = 10  # range of radiance, below the bright parts, that is distinguished
_BRIGHT = 95  # percentile of the picture's radiance that counts as 1
_BORDER = 20  # shorter side of the picture over the width of its border
_BRIGHTER = (0.8, 1.6)  # stops above the backdrop that mark an object: 4σ of the backdrop, within these limits
_OTHER_CHROMA = 0.15  # |Δr| + |Δg| + |Δb|, for r + g + b = 1, that marks another color
_SOFT_STOPS, _SOFT_CHROMA = 0.4, 0.04  # widths of the transition from backdrop to object

_HOLE = 0.01  # share of the mask; smaller holes are dark texture
_PART = 1 / 20  # of the largest region; smaller regions are not the object (an object may be in pieces)
_ALONG_EDGE = 0.1  # share of a region's outline along the picture's edge; with more it is a wall or a table


def brightness(color: Floats) -> float:
    """Brightness scale of a whole picture: 95th percentile over the pixels of the channel mean of S0 (H, W, 3)."""
    return max(float(np.percentile(color.mean(-1), _BRIGHT)), 1e-9)


def probability(color: Floats, chart: Bools) -> Floats:
    """Probability (H, W) of being the object, from brightness and color relative to the picture's border.

    `color` is linear Rec.709 (H, W, 3) of a whole picture, on any scale. The result is 0 on the `chart` (H, W). It is
    also an input of the mask's network.
    """
    color = np.maximum(color, 0)
    bright = brightness(color)
    log = cv2.GaussianBlur(np.log2(color.mean(-1) / bright + 2.0**-STOPS), (0, 0), 1.0)
    width = max(3, min(log.shape) // _BORDER)
    border = np.ones(log.shape, bool)
    border[width:-width, width:-width] = False
    border &= ~chart
    if not border.any():
        return np.full_like(log, 0.5)
    level = float(np.percentile(log[border], 40))  # of the backdrop; the object may touch the border
    spread = 1.5 * float(np.median(level - log[border & (log <= level)]))  # about 1σ of the backdrop
    chroma = color / (color.sum(-1, keepdims=True) + 1e-3 * bright)
    difference = np.abs(chroma - np.median(chroma[border], axis=0)).sum(-1)
    brighter = (log - level - np.clip(4 * spread, *_BRIGHTER)) / _SOFT_STOPS
    colored = np.where(log > level, (difference - _OTHER_CHROMA) / _SOFT_CHROMA, -8)
    found = 1 / (1 + np.exp(-np.clip(np.maximum(brighter, colored), -8, 8)))
    return np.where(chart, 0, found).astype(np.float32)


def find_object(picture: Floats, chart: Bits, min_area: float) -> Bools:
    """Segment the object without a network: mask (H, W) from a linear Rec.709 picture (H, W, 3).

    The zone of the `chart` (H, W) is left out.

    Raises ObjectError: the object covers a share of the picture smaller than `min_area`.
    """
    small, outside = graph_cut.reduce_picture(picture, chart)
    seed = (probability(small, outside) > 0.5).astype(np.uint8)
    seed = cv2.morphologyEx(seed, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    seed = fill_holes(_object_regions(seed, min_area), _HOLE).astype(np.uint8)
    if seed.mean() < min_area:
        raise ObjectError(
            f"no object differs from the backdrop: only {100 * seed.mean():.2f} % of the picture, "
            f"less than mask.min_area = {100 * min_area:g} %; use a darker backdrop, or draw a mask (--mask PNG)"
        )
    cut = _object_regions(graph_cut.cut(small, seed, outside), 0.0)
    return graph_cut.enlarge(fill_holes(cut, _HOLE), chart)


def _object_regions(mask: Bits, min_area: float) -> Bits:
    """Keep the large regions of a mask; those along the picture's edge (wall, table) only if there are no others."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    if count < 2:
        return mask
    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    area[0] = 0
    inner = cv2.erode(mask, np.ones((3, 3), np.uint8), borderValue=0)
    outline = np.bincount(labels[(mask > 0) & (inner == 0)], minlength=count)
    frame = np.ones_like(mask)
    frame[1:-1, 1:-1] = 0
    along_edge = np.bincount(labels[(mask > 0) & (frame > 0)], minlength=count) > _ALONG_EDGE * outline
    if ((area >= min_area * mask.size) & ~along_edge).any():
        area[along_edge] = 0
    large = np.flatnonzero(area >= _PART * max(area.max(), min_area * mask.size))
    return np.isin(labels, large).astype(np.uint8)
