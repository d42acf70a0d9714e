"""Masks: dilation and erosion by squares, and means inside."""

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats


def dilate(mask: Bools, reach: int) -> Bools:
    """Dilate a mask (H, W) by `reach` px in all eight directions."""
    return np.asarray(cv2.dilate(_as_bytes(mask), _square(reach))).view(bool)


def erode(mask: Bools, reach: int, *, from_border: bool = False) -> Bools:
    """Erode a mask (H, W) by `reach` px in all eight directions; `from_border`: also from the picture's border."""
    outside = {"borderType": cv2.BORDER_CONSTANT, "borderValue": 0} if from_border else {}
    return np.asarray(cv2.erode(_as_bytes(mask), _square(reach), **outside)).view(bool)


def masked_mean(image: Floats, inside: Bools, sigma: float) -> Floats:
    """Gaussian mean, 1σ = `sigma` px, of an image (H, W) or (H, W, C) over the pixels inside a mask (H, W)."""
    planar = image.ndim == 2
    masked = np.where(inside if planar else inside[..., None], image, 0).astype(np.float32)
    share = np.maximum(cv2.GaussianBlur(inside.astype(np.float32), (0, 0), sigma), np.float32(1e-6))
    total = cv2.GaussianBlur(masked, (0, 0), sigma).reshape(masked.shape)
    return np.asarray(total / (share if planar else share[..., None]))


def _as_bytes(mask: Bools) -> NDArray[np.uint8]:
    return np.ascontiguousarray(mask, dtype=bool).view(np.uint8)


def _square(reach: int) -> NDArray[np.uint8]:
    return np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
