"""Pixels on the outline of a mask: each belongs to the object if the object covers enough of it."""

import cv2
import numpy as np

from polcap.image_values import Bits, Bools, Floats
from polcap.stages.mask.likely_regions import box_around

_REACH = 3  # px from the outline within which object and backdrop are measured
_WINDOW = 7  # px over which object and backdrop are averaged
# least share of the object in the square root of a pixel's brightness; below .5, because objects darken towards the
# outline, where they turn away from the flash; docs/benchmarks/mask.md
_COVERED = 0.25
_CONTRAST = 0.25  # least difference of object and backdrop over their sum; pixels with less are not changed


def refine(picture: Floats, mask: Bools) -> Bools:
    """Decide on the two rows of pixels along the outline of a mask (H, W), by the linear picture (H, W, 3)."""
    refined = mask.copy()
    box = box_around(mask, 0.0, least=_REACH + _WINDOW)
    if box is not None:
        part = np.s_[box[1] : box[3], box[0] : box[2]]
        refined[part] = _covered(picture[part], mask[part])
    return refined


def _covered(picture: Floats, mask: Bools) -> Bools:
    """Decide pixels at the mask's border by their coverage, between the lights of object and backdrop."""
    display = np.sqrt(np.maximum(picture, 0, dtype=np.float32))
    inside = mask.astype(np.uint8)
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    border = cv2.morphologyEx(inside, cv2.MORPH_GRADIENT, cross) > 0
    object_, has_object = _mean_near_outline(display, inside)
    backdrop, has_backdrop = _mean_near_outline(display, 1 - inside)
    difference = object_ - backdrop
    squared = np.sum(difference**2, axis=-1)
    share = np.sum(difference * (display - backdrop), axis=-1) / np.maximum(squared, 1e-12)
    distinct = squared > _CONTRAST**2 * np.sum((object_ + backdrop) ** 2, axis=-1)
    return np.where(border & has_object & has_backdrop & distinct, share > _COVERED, mask)


def _mean_near_outline(display: Floats, side: Bits) -> tuple[Floats, Bools]:
    """Mean (H, W, 3) of the pixels near the outline on one side (H, W), and a mask (H, W): such pixels are in reach."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _REACH + 1,) * 2)
    band = (cv2.erode(side, np.ones((3, 3), np.uint8)) - cv2.erode(side, disc)).astype(np.float32)
    weight = cv2.blur(band, (_WINDOW, _WINDOW))
    mean = cv2.blur(display * band[..., None], (_WINDOW, _WINDOW)) / np.maximum(weight, 1e-6)[..., None]
    return np.asarray(mean), np.asarray(weight > 0)
