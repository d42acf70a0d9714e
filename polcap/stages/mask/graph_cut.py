"""Graph cut: moves the outline of a mask to color edges of the picture.

References
----------
Rother, Kolmogorov & Blake, GrabCut, SIGGRAPH 2004.
"""

import cv2
import numpy as np

from polcap.image_values import Bits, Bools, Floats
from polcap.optics.resize import area_mean

_WORK_PIXELS = 3e5  # approximate size of the reduced picture that is cut
_REACH = 0.006  # of the picture's longer side: largest movement of the outline
_ROUNDS = 3  # of GrabCut
_CERTAIN = 0.996  # probability of object or backdrop above which colors are not considered (decision 15)


def sharpen(picture: Floats, mask: Bools, chart: Bits, probability: Floats) -> Bools:
    """Move the outline of a mask (H, W) to color edges. Colors decide where the probabilities are uncertain.

    picture (H, W, 3) is linear Rec.709, chart (H, W) is 1 on the chart, probability (H, W) 0…1 is that of being the
    object. The given mask must be right to a few pixels wherever the probabilities are near 0 or 1.
    """
    small, outside = reduce_picture(picture, chart)
    seed = cv2.resize(mask.astype(np.uint8), small.shape[1::-1], interpolation=cv2.INTER_NEAREST)
    return enlarge(cut(small, seed, outside, area_mean(probability, small.shape)) > 0, chart)


def reduce_picture(picture: Floats, chart: Bits) -> tuple[Floats, Bools]:
    """Reduce picture and chart zone for the graph cut, to (h, w, 3) and (h, w)."""
    height, width = chart.shape
    shrink = max(1.0, float(np.sqrt(height * width / _WORK_PIXELS)))
    size = (round(width / shrink), round(height / shrink))
    return area_mean(picture, size[::-1]), cv2.resize(chart, size, interpolation=cv2.INTER_NEAREST) > 0


def cut(picture: Floats, seed: Bits, outside: Bools, probability: Floats | None = None) -> Bits:
    """Move the outline of a mask (h, w) to color edges by GrabCut; probabilities limit the change where certain."""
    tone = stops(picture)
    display = (255 * (tone - tone.min()) / (np.ptp(tone) + 1e-9)).astype(np.uint8)
    reach = max(3, round(_REACH * max(seed.shape)))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    certain, possible = cv2.erode(seed, kernel), cv2.dilate(seed, kernel)
    if probability is not None:
        certain[probability < _CERTAIN] = 0
        possible[probability > 1 - _CERTAIN] = 1
    labels = np.full(seed.shape, cv2.GC_BGD, np.uint8)
    labels[possible > 0] = cv2.GC_PR_BGD
    labels[seed > 0] = cv2.GC_PR_FGD
    labels[certain > 0] = cv2.GC_FGD
    labels[outside] = cv2.GC_BGD
    if certain.any() and (labels == cv2.GC_BGD).any():
        cv2.setRNGSeed(1)
        cv2.grabCut(display, labels, None, np.zeros((1, 65)), np.zeros((1, 65)), _ROUNDS, cv2.GC_INIT_WITH_MASK)
    found = ((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD)).astype(np.uint8)
    return found if found.any() else seed


def stops(picture: Floats) -> Floats:
    """Base-2 logarithm (..., 3) of a linear picture, without outliers."""
    return np.asarray(np.log2(np.clip(picture, 0, 4) + 0.002))


def enlarge(mask: Bools, chart: Bits) -> Bools:
    """Enlarge a mask (h, w) to the size of the chart zone (H, W), and remove that zone."""
    large = cv2.resize(mask.astype(np.float32), chart.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray((large > 0.5) & (chart == 0))
