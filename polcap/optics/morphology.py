"""Morphology of masks: dilation and erosion by squares."""

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Bools


def dilate(mask: Bools, reach: int) -> Bools:
    """Dilate a mask (H, W) by `reach` px in all eight directions."""
    return np.asarray(cv2.dilate(_as_bytes(mask), _square(reach))).view(bool)


def erode(mask: Bools, reach: int, *, from_border: bool = False) -> Bools:
    """Erode a mask (H, W) by `reach` px in all eight directions; `from_border`: also from the picture's border."""
    outside = {"borderType": cv2.BORDER_CONSTANT, "borderValue": 0} if from_border else {}
    return np.asarray(cv2.erode(_as_bytes(mask), _square(reach), **outside)).view(bool)


def _as_bytes(mask: Bools) -> NDArray[np.uint8]:
    return np.ascontiguousarray(mask, dtype=bool).view(np.uint8)


def _square(reach: int) -> NDArray[np.uint8]:
    return np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
