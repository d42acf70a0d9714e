"""Detects a ColorChecker in the object's mask that the chart search did not find."""

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.errors import ChartError
from polcap.images import AngleStack, ChartReference
from polcap.optics.resize import area_mean
from polcap.stages.whitebalance import chart, patches

_LEAST_SHARE = 0.05  # of the mask; smaller parts do little harm
_LEAST_PITCH_PX = 6.0  # smaller patches cannot be distinguished from texture
_MOST_SIDE_PX = 320  # longer side to which the part is averaged down
_FILLED = 0.9  # least share of its bounding rectangle that a card fills
_ASPECT = (1.15, 1.8)  # range of aspect ratios of a card with 6 × 4 patches, also when tilted
_EXPLAINED = 0.75  # least share of variance that 24 flat patches explain; 17 of 106 textures have it too
_DELTA_E = 15.0  # largest mean ΔE of its colors, as `whitebalance.max_delta_e`; these textures have 20 and more
_PATCH_SHARE = 0.6  # sampled share of a patch's side


def share(radiance: AngleStack, mask: NDArray[np.bool_], reference: ChartReference) -> float:
    """Share of the mask (H, W) whose part in the first shot is a ColorChecker."""
    count, label, about, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    total = max(int(mask.sum()), 1)
    parts = [n for n in range(1, count) if about[n, cv2.CC_STAT_AREA] > _LEAST_SHARE * total]
    return sum(int(about[n, cv2.CC_STAT_AREA]) for n in parts if _is_chart(radiance, label == n, reference)) / total


def _is_chart(radiance: AngleStack, part: NDArray[np.bool_], reference: ChartReference) -> bool:
    """Whether a connected part (H, W) of the mask shows 6 × 4 flat patches of a chart's colors on a card."""
    y, x = np.nonzero(part)
    center, (a, b), turn = cv2.minAreaRect(np.stack([x, y], axis=-1).astype(np.float32))
    long, short = max(a, b) + 1, min(a, b) + 1  # from pixel centers to their edges
    if not _ASPECT[0] < long / short < _ASPECT[1] or len(x) < _FILLED * long * short:
        return False
    if long / chart.COLUMNS < _LEAST_PITCH_PX:
        return False
    box = cv2.boxPoints((center, (a, b), turn)).astype(np.float64)  # clockwise
    if np.linalg.norm(box[1] - box[0]) < np.linalg.norm(box[2] - box[1]):
        box = np.roll(box, -1, axis=0)
    x0, y0 = x.min(), y.min()
    crop = radiance.value[0, y0 : y.max() + 1, x0 : x.max() + 1]
    small = min(1.0, _MOST_SIDE_PX / long)
    crop = area_mean(crop, (max(1, round(crop.shape[0] * small)), max(1, round(crop.shape[1] * small))))
    white = np.maximum(np.percentile(crop, 99, axis=(0, 1)), 1e-9)
    start = chart.from_corners((box - (x0, y0) + 0.5) * small - 0.5, patch=1.0)
    if not chart.is_view(start.homography):
        return False
    place = chart.refine(np.clip(crop / white, 0, 4), start)
    if place.explained < _EXPLAINED or not chart.is_view(place.homography):
        return False
    to_full = np.array([[1 / small, 0, x0 + (0.5 / small - 0.5)], [0, 1 / small, y0 + (0.5 / small - 0.5)], [0, 0, 1]])
    seen = patches.sample(radiance.value[0], radiance.quality[0], place.moved(to_full), _PATCH_SHARE)
    return any(_delta_e(way, reference) < _DELTA_E for way in (seen, seen.turned()))


def _delta_e(seen: patches.PatchSamples, reference: ChartReference) -> float:
    try:
        return patches.fit(seen, reference).mean
    except ChartError:
        return float("inf")
