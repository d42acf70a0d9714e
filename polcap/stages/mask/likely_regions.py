"""From probabilities to a mask: their threshold, connected regions without specks and holes, and the expected error."""

import cv2
import numpy as np

from polcap.image_values import Bits, Bools, Floats
from polcap.optics.resize import area_mean
from polcap.optics.warp import Box
from polcap.stages.mask import graph_cut

_SPECK = 0.01  # of the largest region; smaller regions are specks
_INSIDE = 0.5  # probability above which a pixel belongs to the object
_LIKELY = 0.3  # a region without a pixel of more probability is backdrop of the object's color
_PINHOLE = 1e-3  # of the mask; smaller holes are dark texture
_OPENING = 0.15  # largest mean probability of a hole that stays open; others are shadowed parts of the object
_MOST_ERROR = 1.7  # expected error of the mask by colors, over that of the network's mask (decision 15)
# probability from which a pixel's color is one of the object's; below 1 − that, one of the backdrop's
_SAMPLE = 0.9
_SAMPLES, _LEAST_SAMPLES = 150, 50  # colors of each
_AROUND, _AROUND_PX = 0.3, 8  # margin of the box with colors of the backdrop: of its longer side; least px
_BLOCK = 4096  # colors whose densities are computed at a time
_COLOR_STOPS = 0.25  # 1σ of the kernel of the densities of colors [stops]; docs/benchmarks/mask.md
# exponent and limit of the ratio of densities: neighbors have one color, and a backdrop has colors not sampled
_COLOR_POWER, _MOST_LOG_ODDS = 0.5, 3.0
_UNSAMPLED = 1e-3  # least density, relative to that at a sample's own color


def likely_regions(probability: Floats) -> Bools:
    """Mask (H, W) of pixels with a probability (H, W) above `_INSIDE`, without specks and without doubtful holes."""
    return fill_holes(_without_specks(probability > _INSIDE), _PINHOLE, probability)


def clean(mask: Bools, probability: Floats) -> Bools:
    """The mask (H, W) without specks, pinholes, and regions of low probability (H, W)."""
    count, labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=8)
    likely = np.bincount(labels[mask & (probability > _LIKELY)], minlength=count) > 0
    return fill_holes(_without_specks(likely[labels]), _PINHOLE)


def choose(by_color: Bools, by_network: Bools, probability: Floats) -> Bools:
    """Choose between two masks (H, W): by colors, or the network's if its probabilities contradict the colors.

    The outline by colors is sharper, but wrong where object and backdrop have the same color, such as white on white.
    """
    allowed = _MOST_ERROR * expected_error(by_network, probability)
    return by_color if expected_error(by_color, probability) <= allowed else by_network


def _without_specks(mask: Bools) -> Bits:
    """The mask without parts much smaller than its largest."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    area[0] = 0
    large = (area > 0) & (area >= _SPECK * area.max())
    return np.asarray(large[labels], np.uint8)


def fill_holes(mask: Bits, least_share: float, probability: Floats | None = None) -> Bools:
    """Fill holes of a mask (H, W) that are smaller than `least_share` of it, or of high mean probability (H, W).

    Holes at the picture's edge stay open.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(1 - mask, connectivity=4)
    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    fill = area < least_share * mask.sum()
    if probability is not None:
        total = np.bincount(labels.reshape(-1), weights=probability.reshape(-1), minlength=count)
        fill |= total / np.maximum(area, 1) > _OPENING
    fill[np.unique(np.concatenate([labels[[0, -1]].ravel(), labels[:, [0, -1]].ravel()]))] = False
    return np.asarray((mask > 0) | (fill[labels] & (mask == 0)))


def expected_error(mask: Bools, probability: Floats) -> float:
    """Expected error of a mask from probabilities (H, W): 1 − expected intersection over expected union."""
    inside, outside = float(probability[mask].sum()), float(probability[~mask].sum())
    return 1 - inside / max(float(mask.sum()) + outside, 1e-9)


def expected_error_by_color(picture: Floats, mask: Bools, probability: Floats, chart: Bits) -> float:
    """Expected error of a mask (H, W), by the network's probabilities (H, W) and by colors.

    By Bayes' rule the odds of a pixel are multiplied by the density of its color in the object over that in the
    backdrop. The densities are those of pixels of which network and mask agree with certainty. Where object and
    backdrop have one color, or too few pixels are certain, the network's probabilities remain. `picture` (H, W, 3) is
    linear, `chart` (H, W) is 1 on the chart.
    """
    small, outside = graph_cut.reduce_picture(picture, chart)
    inside, chance = area_mean(mask, outside.shape) > 0.5, np.array(area_mean(probability, outside.shape))
    box = box_around(inside, _AROUND, _AROUND_PX)
    if box is None:
        return expected_error(mask, probability)
    around = np.zeros_like(inside)
    around[box[1] : box[3], box[0] : box[2]] = True
    around &= ~outside
    color = graph_cut.stops(small)
    samples = [color[around & inside & (chance > _SAMPLE)], color[around & ~inside & (chance < 1 - _SAMPLE)]]
    if min(len(one) for one in samples) < _LEAST_SAMPLES:
        return expected_error(mask, probability)
    object_, backdrop = (_density(color[around], one) for one in samples)
    known = np.clip(chance[around], 1e-6, 1 - 1e-6)
    by_color = np.clip(_COLOR_POWER * np.log(object_ / backdrop), -_MOST_LOG_ODDS, _MOST_LOG_ODDS)
    chance[around] = 1 / (1 + (1 - known) / known * np.exp(-by_color))
    return expected_error(inside, chance)


def _density(color: Floats, samples: Floats) -> Floats:
    """Density (N,) of colors (N, 3) among samples (M, 3), by Gaussian kernels; at most 1."""
    chosen = samples[np.linspace(0, len(samples) - 1, min(_SAMPLES, len(samples))).astype(int)]
    density = []
    for block in np.array_split(color, len(color) // _BLOCK + 1):  # (n, 3); its distances fit into the cache
        distance = sum((block[:, k, None] - chosen[:, k]) ** 2 for k in range(3))  # (n, M), squared
        density.append(np.exp(distance / (-2 * _COLOR_STOPS**2)).mean(axis=1))
    return np.concatenate(density) + _UNSAMPLED


def measure_shape(mask: Bools) -> tuple[float, float, float]:
    """Measure three figures of a mask (H, W) that are near 0 for a whole object inside the picture.

    They are the share of the mask outside its largest region, the area of its holes over its own area, and the share of
    the picture's edge that the mask covers.
    """
    area = mask.sum()
    _, _, parts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    largest = parts[1:, cv2.CC_STAT_AREA].max()
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    filled = cv2.drawContours(np.zeros(mask.shape, np.uint8), contours, -1, 1, cv2.FILLED)
    edge = np.concatenate([mask[[0, -1]].ravel(), mask[1:-1, [0, -1]].ravel()])
    return float(1 - largest / area), float((filled.sum() - area) / area), float(edge.mean())


def nth_part(mask: Bools, number: int) -> Bools:
    """The part of a mask (H, W) that is `number` in the order of area, 1 being the largest; empty if there is none."""
    _, label, parts, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    order = 1 + np.argsort(-parts[1:, cv2.CC_STAT_AREA], kind="stable")
    return label == order[number - 1] if number <= len(order) else np.zeros_like(mask)


def box_around(mask: Bools, margin: float, least: int) -> Box | None:
    """Bounding box x0, y0, x1, y1 (end exclusive) of a mask (H, W), with a margin; None for an empty mask.

    `margin` is a share of the box's longer side, and `least` px or more.
    """
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    if not len(rows):
        return None
    add = max(least, round(margin * max(np.ptp(rows), np.ptp(columns))))
    height, width = mask.shape
    return (
        max(int(columns[0]) - add, 0), max(int(rows[0]) - add, 0),
        min(int(columns[-1]) + 1 + add, width), min(int(rows[-1]) + 1 + add, height),
    )  # fmt: skip
