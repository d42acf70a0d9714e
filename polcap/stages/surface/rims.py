"""Where normals alone tell that one part hides another: a surface turns away to its limb, and another stands behind.

Behind a limb anything may lie: its depth step is no integral of slopes, and least squares would set the hidden part
down where nothing strains, most often against the limb. A crease where two parts touch leans less on its nearer side.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
from polcap.stages.surface.occlusion import Bools, radius

_REACH = 3  # px from a link at which the nearer side's steepest, the farther side's flattest normal is looked for
_CANDIDATE = np.radians(65.0)  # lean of the nearer side
_KINK = np.radians(25.0)  # by which the farther side leans less
_LIMB = np.radians(75.0)  # lean of a limb, the mean along it
_ALONG_PX = 4.0  # 1σ of that mean
_LEAST_LENGTH = 0.1  # of a limb, over the object's radius


@dataclass(frozen=True)
class Rims:
    """Links of a pixel grid that leave a limb: +1 where the nearer side is first, −1 where it is second, else 0."""

    right: NDArray[np.int8]  # (H, W−1)
    down: NDArray[np.int8]  # (H−1, W)


def rims(lean: tuple[Floats, Floats], mask: Bools) -> Rims:
    """Links from a limb to what it hides.

    Parameters
    ----------
    lean
        By which the surface falls away to the right and down, (H, W) each [rad]; NaN outside the mask.
    mask
        (H, W).
    """
    candidates = [_candidates(of, mask, axis, sign) for axis, of in zip((1, 0), lean) for sign in (1, -1)]
    total, count = np.zeros(mask.shape, np.float32), np.full(mask.shape, 1e-6, np.float32)
    for axis, (at, steepest) in zip((1, 1, 0, 0), candidates):
        first = np.s_[:, :-1] if axis else np.s_[:-1]
        total[first] += np.where(at, steepest, 0)
        count[first] += at
    mean = cv2.GaussianBlur(total, (0, 0), _ALONG_PX) / cv2.GaussianBlur(count, (0, 0), _ALONG_PX)
    limb = (mean > _LIMB) & (count > 0.5)
    label = contours(limb)
    length = np.bincount(label[limb], minlength=int(label.max()) + 1)
    limb &= (length >= max(_LEAST_LENGTH * radius(mask), 4))[label]
    found = []
    for axis, of in ((1, candidates[:2]), (0, candidates[2:])):
        first = np.s_[:, :-1] if axis else np.s_[:-1]
        found.append((of[0][0].astype(np.int8) - of[1][0]) * limb[first])
    return Rims(*found)


def contours(at: Bools) -> NDArray[np.int32]:
    """Number (H, W) of the contour that each of some pixels (H, W) lies on, gaps of two pixels closed."""
    near = cv2.dilate(at.astype(np.uint8), np.ones((3, 3), np.uint8))
    return np.asarray(cv2.connectedComponents(near, connectivity=8)[1], dtype=np.int32)


def _candidates(lean: Floats, mask: Bools, axis: int, sign: int) -> tuple[Bools, Floats]:
    """Links along an axis whose nearer side, the first (sign 1) or second (−1), leans like a limb; its lean."""
    away = sign * lean
    inside = np.isfinite(away)
    size = (1, _REACH) if axis else (_REACH, 1)
    last = (_REACH - 1, 0) if axis else (0, _REACH - 1)
    back, ahead = (last, (0, 0)) if sign > 0 else ((0, 0), last)
    box = np.ones(size, np.uint8)
    steepest = cv2.dilate(np.where(inside, away, -9).astype(np.float32), box, anchor=back, borderValue=-9)
    flattest = cv2.erode(np.where(inside, away, 9).astype(np.float32), box, anchor=ahead, borderValue=9)
    one, two = (np.s_[:, :-1], np.s_[:, 1:]) if axis else (np.s_[:-1], np.s_[1:])
    nearer, farther = (one, two) if sign > 0 else (two, one)
    kink = steepest[nearer] - flattest[farther]
    # of the links beside one another that see the same limb, the one where the normals turn most
    turn = away[nearer] - away[farther]
    local = cv2.dilate(np.nan_to_num(turn, nan=-9).astype(np.float32), np.ones((1, 5) if axis else (5, 1), np.uint8))
    at = mask[one] & mask[two] & (steepest[nearer] > _CANDIDATE) & (kink > _KINK) & (turn >= local - 1e-6)
    return at, steepest[nearer]
