"""Parts of the object that a mask lacks, such as thin legs: bright before a dark backdrop, and joined to the mask.

Only where the board's print was erased, the backdrop is known to be dark.
"""

import cv2
import numpy as np

from polcap.image_values import Bools, Floats
from polcap.optics.morphology import dilate
from polcap.stages.mask.likely_regions import box_around

_REACH = 0.3  # of the mask's longer side: parts are searched as far from it
_BRIGHT = 4.0  # times the backdrop; a brighter pixel is the object's (docs/benchmarks/fusion-choices.md)
_BEYOND = 4  # px; an added part extends farther from the mask. Nearer pixels are left to `mask_border`


def add(picture: Floats, mask: Bools, board: Bools) -> Bools:
    """The mask (H, W) with the bright parts that it lacks, by the linear picture (H, W, 3) without the board.

    `board` (H, W) are the pixels from which the board's print was erased; they are never added.
    """
    box = box_around(mask, _REACH, least=2 * _BEYOND)
    if box is None:
        return mask
    part = np.s_[box[1] : box[3], box[0] : box[2]]
    brightness, inside = picture[part].mean(axis=-1), mask[part]
    beyond = ~dilate(inside, _BEYOND)
    if not beyond.any():
        return mask
    bright = (brightness > _BRIGHT * np.median(brightness[beyond])) & ~board[part]
    protruding = bright & dilate(bright & beyond, _BEYOND + 2)
    _, label = cv2.connectedComponents((inside | protruding).astype(np.uint8))
    grown = mask.copy()
    grown[part] = np.isin(label, np.unique(label[inside]))
    return grown
