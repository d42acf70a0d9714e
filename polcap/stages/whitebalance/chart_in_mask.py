"""Detects a ColorChecker inside the object's mask, which the chart search did not find."""

import cv2
import numpy as np

from polcap.chart_values import ChartReference
from polcap.errors import ChartError
from polcap.image_values import Bools
from polcap.stage_values import AngleStack
from polcap.stages.whitebalance import chart, patches

_LEAST_SHARE = 0.05  # of the mask; smaller parts are not tested
_LEAST_PITCH_PX = 6.0  # smaller patches cannot be distinguished from texture
_FILLED = 0.9  # least share of its bounding rectangle that a card covers
_ASPECT = (1.15, 1.8)  # range of aspect ratios of a card with 6 × 4 patches, also when tilted
_EXPLAINED = 0.75  # least share of variance that 24 flat patches explain; 17 of 106 textures reach it
_DELTA_E = 15.0  # largest mean ΔE of a chart, as `whitebalance.max_delta_e`; these 17 textures have 20 and more
_PATCH_SHARE = 0.6  # sampled share of a patch's side


def share(radiance: AngleStack, mask: Bools, reference: ChartReference) -> float:
    """Share of the mask (H, W) that shows a ColorChecker in the first shot; 0 without one."""
    count, label, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    total = max(int(mask.sum()), 1)
    parts = [n for n in range(1, count) if stats[n, cv2.CC_STAT_AREA] > _LEAST_SHARE * total]
    return sum(int(stats[n, cv2.CC_STAT_AREA]) for n in parts if _is_chart(radiance, label == n, reference)) / total


def _is_chart(radiance: AngleStack, part: Bools, reference: ChartReference) -> bool:
    """Whether a connected part (H, W) of the mask shows 6 × 4 flat patches of a chart's colors on a card."""
    y, x = np.nonzero(part)
    rectangle = cv2.minAreaRect(np.stack([x, y], axis=-1).astype(np.float32))
    short, long = sorted(side + 1 for side in rectangle[1])  # from pixel centers to their edges
    if not _ASPECT[0] < long / short < _ASPECT[1] or len(x) < _FILLED * long * short:
        return False
    if long / chart.COLUMNS < _LEAST_PITCH_PX:
        return False
    box = cv2.boxPoints(rectangle).astype(np.float64)  # clockwise
    if np.linalg.norm(box[1] - box[0]) < np.linalg.norm(box[2] - box[1]):
        box = np.roll(box, -1, axis=0)
    place = chart.refine(radiance.value[0], chart.from_corners(box, patch=1.0))
    if place.explained < _EXPLAINED or not chart.is_view(place.homography):
        return False
    upright = patches.sample(radiance.value[0], radiance.quality[0], place, _PATCH_SHARE)
    for samples in (upright, upright.turned()):
        try:
            if patches.fit(samples, reference).error < _DELTA_E:
                return True
        except ChartError:  # too few of its patches are usable
            continue
    return False
