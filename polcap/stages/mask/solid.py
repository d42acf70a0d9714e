"""From chances to a mask, and what there is to doubt about it.

One side or the other at every pixel, specks dropped, doubtful holes filled.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats

_SPECK = 0.01  # of the largest part: smaller ones are no parts of their own
_LIKELY = 0.3  # chance that a part has somewhere that is more than the backdrop in its color (decision 15)
_PINHOLE = 1e-3  # of the mask: smaller holes are dark texture
_LEEWAY = 1.7  # times the doubt of the network's own mask, given to that of the colors (decision 15)
_DOUBTED = 0.15  # mean chance of a hole that is a shadowed hollow and no opening


def body(chance: Floats) -> NDArray[np.bool_]:
    """The mask (H, W) of chances (H, W) 0…1."""
    return _filled(_sizeable(chance > 0.5), chance)


def cleaned(mask: NDArray[np.bool_], chance: Floats) -> NDArray[np.bool_]:
    """A mask (H, W) without specks, pinholes, and parts of which no pixel is likely by its chances (H, W)."""
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    seen = np.bincount(labels[mask & (chance > _LIKELY)], minlength=count) > 0
    return _filled(_sizeable(seen[labels]), None)


def preferred(colored: NDArray[np.bool_], learned: NDArray[np.bool_], chance: Floats) -> NDArray[np.bool_]:
    """The mask (H, W) that colors made of the learned one, where the network's chances speak little against it.

    Its outline is sharper; where colors tell nothing, as white on white, it goes astray.
    """
    return colored if doubt(colored, chance) <= _LEEWAY * doubt(learned, chance) else learned


def _sizeable(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """The parts that are no specks."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    area[0] = 0
    keep = (area > 0) & (area >= _SPECK * area.max())
    return np.asarray(keep[labels], np.uint8)


def _filled(mask: NDArray[np.uint8], chance: Floats | None) -> NDArray[np.bool_]:
    """Holes filled that are pinholes, or of which the network is not sure that one looks through them."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(1 - mask, connectivity=4)
    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    outer = np.concatenate([labels[[0, -1]].ravel(), labels[:, [0, -1]].ravel()])
    fill = area < _PINHOLE * mask.sum()
    if chance is not None:
        mean = np.bincount(labels.reshape(-1), weights=chance.reshape(-1), minlength=count) / np.maximum(area, 1)
        fill |= mean > _DOUBTED
    fill[np.unique(outer)] = False
    return np.asarray((mask > 0) | (fill[labels] & (mask == 0)))


def doubt(mask: NDArray[np.bool_], chance: Floats) -> float:
    """1 − the intersection over union with the true mask that chances (H, W) let expect, both sums as expected."""
    inside, outside = float(chance[mask].sum()), float(chance[~mask].sum())
    return 1 - inside / max(float(mask.sum()) + outside, 1e-9)


def shape(mask: NDArray[np.bool_]) -> tuple[float, float, float]:
    """What a mask (H, W) of an object should have little of.

    Returns
    -------
    apart, holes, cut : float
        Share of the mask outside its largest part; area of the holes over its own; share of the picture's edge on it.
    """
    area = mask.sum()
    _, _, parts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    largest = parts[1:, cv2.CC_STAT_AREA].max()
    lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    whole = cv2.drawContours(np.zeros(mask.shape, np.uint8), lines, -1, 1, cv2.FILLED)
    edge = np.concatenate([mask[[0, -1]].ravel(), mask[1:-1, [0, -1]].ravel()])
    return float(1 - largest / area), float((whole.sum() - area) / area), float(edge.mean())
