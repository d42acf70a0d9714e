"""Which pixels stand out from the backdrop: the object without a network.

Under a flash beside the lens the object, near, is bright and the backdrop, far or black, is dark. The
backdrop's brightness is read off the picture's border, and what stands above it in brightness or colour is
refined with graph cuts (GrabCut).

References
----------
Rother, Kolmogorov, Blake, GrabCut, SIGGRAPH 2004.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.errors import ObjectError
from polcap.images import Floats
from polcap.optics.resize import area_mean
from polcap.optics.robust import MAD_TO_SIGMA

_STANDS_OUT = (0.8, 1.6)  # stops above the backdrop that make an object, however even or uneven that is
_OTHER_CHROMA = 0.15  # |Δr| + |Δg| + |Δb| of r + g + b = 1 that makes another colour
_SURE = 0.996  # chance from which on, either way, colours decide nothing (decision 15)
_WORK_PIXELS = 3e5  # graph cuts run on an image averaged down to about this


def search(picture: Floats, chart: NDArray[np.uint8], min_area: float) -> NDArray[np.bool_]:
    """The object in linear Rec.709 (H, W, 3), outside the chart's zone (H, W).

    Raises
    ------
    ObjectError
        Less than `min_area` of the picture stands out.
    """
    small, outside = _reduced(picture, chart)

    log = np.log2(np.maximum(small, 0).mean(-1) + 1e-4)
    log = cv2.GaussianBlur(log.astype(np.float32), (0, 0), 1.5)
    level, spread = _backdrop(log, outside)
    bright = log > level + np.clip(4 * spread, *_STANDS_OUT)
    seed = (bright | _otherwise_colored(small, log, level, outside)) & ~outside
    seed = _filled(
        _sizeable(
            cv2.morphologyEx(seed.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)),
            min_area,
        )
    )
    if seed.mean() < min_area:
        raise ObjectError(
            f"no object stands out from the backdrop: {100 * seed.mean():.2f} % of the picture, "
            f"less than mask.min_area = {100 * min_area:g} %; use a darker backdrop, or give --mask PNG"
        )
    return _enlarged(_filled(_sizeable(_graph_cut(small, seed, outside), 0.0)).astype(np.float32), chart)


def sharpened(picture: Floats, mask: NDArray[np.bool_], chart: NDArray[np.uint8], chance: Floats) -> NDArray[np.bool_]:
    """A mask moved to the picture's edges, and decided by colour where its chances leave it open.

    Parameters
    ----------
    picture
        (H, W, 3) linear Rec.709.
    mask
        (H, W) right to a few pixels, or wherever its chances are near 0 or 1.
    chart
        (H, W) 1 where the chart lies.
    chance
        (H, W) 0…1 of each pixel to be the object.
    """
    small, outside = _reduced(picture, chart)
    size = small.shape[1::-1]
    seed = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    cut = _graph_cut(small, seed, outside, area_mean(chance, small.shape))
    return _enlarged(cut.astype(np.float32), chart)


def _reduced(picture: Floats, chart: NDArray[np.uint8]) -> tuple[Floats, NDArray[np.bool_]]:
    """Picture and chart at the size that graph cuts work at."""
    height, width = chart.shape
    shrink = max(1.0, float(np.sqrt(height * width / _WORK_PIXELS)))
    size = (round(width / shrink), round(height / shrink))
    small = area_mean(picture, size[::-1])
    return small, cv2.resize(chart, size, interpolation=cv2.INTER_NEAREST) > 0


def _enlarged(cut: Floats, chart: NDArray[np.uint8]) -> NDArray[np.bool_]:
    size = chart.shape[1], chart.shape[0]
    mask = cv2.resize(cut, size, interpolation=cv2.INTER_LINEAR) if cut.shape != chart.shape else cut
    return np.asarray((mask > 0.5) & (chart == 0))


def _backdrop(log: Floats, outside: NDArray[np.bool_]) -> tuple[float, float]:
    """Level and spread of the border's log brightness; robust, for the object may touch the border."""
    height, width = log.shape
    rim = max(3, min(height, width) // 20)
    border = np.ones_like(outside)
    border[rim:-rim, rim:-rim] = False
    sample = log[border & ~outside]
    level = float(np.percentile(sample, 40))
    below = level - sample[sample < level]
    return level, MAD_TO_SIGMA * float(np.median(below)) if below.size else 0.1


def _otherwise_colored(picture: Floats, log: Floats, level: float, outside: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(H, W) where the colour is not the backdrop's, in pixels at least as bright as it."""
    smooth = cv2.GaussianBlur(np.maximum(picture, 0), (0, 0), 1.5)
    chroma = smooth / (smooth.sum(-1, keepdims=True) + 1e-4)
    like = (np.abs(log - level) < 0.5) & ~outside
    backdrop = np.median(chroma[like], axis=0) if like.any() else np.full(3, 1 / 3)
    return np.asarray((np.abs(chroma - backdrop).sum(-1) > _OTHER_CHROMA) & (log > level))


def _sizeable(mask: NDArray[np.uint8], min_area: float) -> NDArray[np.uint8]:
    """The connected parts at least a twentieth of the largest (an object may be in pieces).

    A wall or a table runs out of the picture, the object stands in it: parts that lie along the picture's
    edge for more than a tenth of their outline go where others remain.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    if count < 2:
        return mask
    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    area[0] = 0
    inner = cv2.erode(mask, np.ones((3, 3), np.uint8), borderValue=0)
    outline = np.bincount(labels[(mask > 0) & (inner == 0)], minlength=count)
    frame = np.ones_like(mask)
    frame[1:-1, 1:-1] = 0
    at_edge = np.bincount(labels[(mask > 0) & (frame > 0)], minlength=count)
    standing = (area >= min_area * mask.size) & (at_edge <= 0.1 * outline)
    if standing.any():
        area[at_edge > 0.1 * outline] = 0
    keep = np.flatnonzero(area >= max(area.max() / 20, min_area * mask.size / 20))
    return np.isin(labels, keep).astype(np.uint8)


def _filled(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Holes smaller than a hundredth of the mask closed (dark texture is still the object)."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(1 - mask, connectivity=4)
    small = np.flatnonzero(stats[:, cv2.CC_STAT_AREA] < mask.sum() / 100)
    return np.asarray(np.maximum(mask, (np.isin(labels, small) & (labels > 0)).astype(np.uint8)))


def _graph_cut(
    picture: Floats, seed: NDArray[np.uint8], outside: NDArray[np.bool_], chance: Floats | None = None
) -> NDArray[np.uint8]:
    """The seed's outline moved to the picture's edges, and anew wherever the chances leave it open."""
    tone = np.log2(np.clip(picture, 0, 4) + 0.002)
    display = (255 * (tone - tone.min()) / (np.ptp(tone) + 1e-9)).astype(np.uint8)
    reach = max(3, round(0.006 * max(seed.shape)))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    sure, possible = cv2.erode(seed, kernel), cv2.dilate(seed, kernel)
    if chance is not None:
        sure[chance < _SURE] = 0
        possible[chance > 1 - _SURE] = 1
    labels = np.full(seed.shape, cv2.GC_BGD, np.uint8)
    labels[possible > 0] = cv2.GC_PR_BGD
    labels[seed > 0] = cv2.GC_PR_FGD
    labels[sure > 0] = cv2.GC_FGD
    labels[outside] = cv2.GC_BGD
    if sure.any() and (labels == cv2.GC_BGD).any():
        cv2.setRNGSeed(1)
        cv2.grabCut(display, labels, None, np.zeros((1, 65)), np.zeros((1, 65)), 3, cv2.GC_INIT_WITH_MASK)
    found = ((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)).astype(np.uint8)
    return found if found.any() else seed
