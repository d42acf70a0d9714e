"""Connected regions of a mask: specks removed, holes filled or left open, and figures of the result."""

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Bits, Floats

Bools = NDArray[np.bool_]
Box = tuple[int, int, int, int]  # x0, y0, x1, y1 px, end exclusive

_SPECK = 0.01  # of the largest region: smaller ones are specks
_LIKELY = 0.3  # least probability, somewhere in a region, that it is more than a backdrop of the object's color
_PINHOLE = 1e-3  # of the mask: smaller holes are dark texture
_OPENING = 0.15  # most mean probability of a hole that is an opening; more is a shadowed hollow
_LEEWAY = 1.7  # expected error of the mask by colors, over that of the network's own (decision 37)


def likely_regions(probability: Floats) -> Bools:
    """The mask (H, W) of pixels that are likely the object, by their probabilities (H, W) 0…1."""
    return fill_holes(_without_specks(probability > 0.5), _PINHOLE, probability)


def clean(mask: Bools, probability: Floats) -> Bools:
    """A mask (H, W) without specks, pinholes, and regions in which no pixel is likely (probabilities (H, W))."""
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    likely = np.bincount(labels[mask & (probability > _LIKELY)], minlength=count) > 0
    return fill_holes(_without_specks(likely[labels]), _PINHOLE)


def choose(colored: Bools, learned: Bools, probability: Floats) -> Bools:
    """The mask by colors, or the network's where its probabilities contradict the colors; (H, W) each.

    The outline by colors is sharper, but fails where object and backdrop have one color, as white on white.
    """
    allowed = _LEEWAY * expected_error(learned, probability)
    return colored if expected_error(colored, probability) <= allowed else learned


def _without_specks(mask: Bools) -> Bits:
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    area[0] = 0
    large = (area > 0) & (area >= _SPECK * area.max())
    return np.asarray(large[labels], np.uint8)


def fill_holes(mask: Bits, least: float, probability: Floats | None = None) -> Bools:
    """A mask (H, W) without holes smaller than a share of it, nor such as are no openings by their probability (H, W).

    Holes at the picture's edge stay.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(1 - mask, connectivity=4)
    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    fill = area < least * mask.sum()
    if probability is not None:
        total = np.bincount(labels.reshape(-1), weights=probability.reshape(-1), minlength=count)
        fill |= total / np.maximum(area, 1) > _OPENING
    fill[np.unique(np.concatenate([labels[[0, -1]].ravel(), labels[:, [0, -1]].ravel()]))] = False
    return np.asarray((mask > 0) | (fill[labels] & (mask == 0)))


def expected_error(mask: Bools, probability: Floats) -> float:
    """1 − the expected intersection over the expected union with the true mask, by probabilities (H, W)."""
    inside, outside = float(probability[mask].sum()), float(probability[~mask].sum())
    return 1 - inside / max(float(mask.sum()) + outside, 1e-9)


def measure_shape(mask: Bools) -> tuple[float, float, float]:
    """Islands, holes and border of a mask (H, W): all small for a whole object inside the picture.

    The share of the mask outside its largest region; the area of the holes over that of the mask; the share of the
    picture's edge that the mask covers.
    """
    area = mask.sum()
    _, _, parts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    largest = parts[1:, cv2.CC_STAT_AREA].max()
    lines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    whole = cv2.drawContours(np.zeros(mask.shape, np.uint8), lines, -1, 1, cv2.FILLED)
    edge = np.concatenate([mask[[0, -1]].ravel(), mask[1:-1, [0, -1]].ravel()])
    return float(1 - largest / area), float((whole.sum() - area) / area), float(edge.mean())


def box_around(mask: Bools, margin: float, least: int) -> Box | None:
    """The box of a mask (H, W) with a margin, in shares of its longer side and at least `least` px; None if empty."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return None
    add = max(least, round(margin * max(np.ptp(rows), np.ptp(columns))))
    height, width = mask.shape
    return (
        max(int(columns[0]) - add, 0), max(int(rows[0]) - add, 0),
        min(int(columns[-1]) + 1 + add, width), min(int(rows[-1]) + 1 + add, height),
    )  # fmt: skip
