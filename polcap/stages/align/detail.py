"""Makes the pictures in which shots of different polarizer angles are compared: fine detail of log radiance."""

import cv2
import numpy as np

from polcap.image_values import Floats, MaskedImage, Quality
from polcap.optics import frames
from polcap.optics.morphology import dilate
from polcap.optics.registration import Pyramid, squared_gradient
from polcap.optics.resize import block_means

_BLUR_PX = 0.7  # blur of both shots; hides the blur that interpolation adds to one of them
_FLOOR = 0.01  # of the 99th percentile; added before the logarithm, which would amplify the noise of a dark backdrop
_HOT = 1.2  # greatest value over that of the brightest neighbor; more is a hot pixel, which moves with the sensor
_NEIGHBORS = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], np.uint8)
_TYPICAL_DETAIL = 0.02  # relative; where noise exceeds it, detail is weighted down
_LEAST_PIXELS = 30  # usable ones


def detail(shot: MaskedImage, detail_px: float, step: int) -> Pyramid:
    """Compute the fine detail of a shot: log radiance minus its Gaussian mean of 1σ = `detail_px`.

    The shot is first averaged over `step` × `step` px; `detail_px` counts these averaged pixels. A Wiener filter
    multiplies the detail by d² / (d² + σ²), d the typical detail and σ the relative noise.
    """
    total = frames.total(shot.value)
    total = block_means(np.minimum(total, np.float32(_HOT) * cv2.dilate(total, _NEIGHBORS)), step)
    height, width = total.shape
    variance = frames.total(shot.variance[: height * step : step, : width * step : step])  # it changes slowly
    sigma = np.sqrt(variance) / np.float32(step)
    sample = (slice(None, None, 5),) * 2  # every fifth row and column suffice for a percentile
    floor = max(float(np.percentile(total[sample], 99)) * _FLOOR, 2 * float(np.median(sigma[sample])), 1e-9)
    level = np.maximum(total, 0)
    level += np.float32(floor)
    log = np.asarray(cv2.log(level))
    fine = fine_detail(log, detail_px)
    sigma /= level
    fine /= 1 + (sigma / np.float32(_TYPICAL_DETAIL)) ** 2
    clipped = block_means(shot.quality & Quality.CLIPPED > 0, step) > 0
    return Pyramid(fine, ~dilate(clipped, int(np.ceil(2 * detail_px)) // 2))


def fine_detail(log: Floats, detail_px: float) -> Floats:
    """A picture (H, W) minus its Gaussian mean of 1σ = `detail_px`, slightly smoothed."""
    size = 2 * int(np.ceil(3 * detail_px)) + 1
    fine = np.asarray(cv2.GaussianBlur(log, (0, 0), _BLUR_PX))
    fine -= cv2.GaussianBlur(log, (size, size), detail_px)
    return fine


def edge_strength(shot: Pyramid) -> Pyramid:
    """Strength of the edges in a shot, whichever side is brighter: square root of the gradient's length."""
    strength = np.sqrt(cv2.GaussianBlur(np.sqrt(squared_gradient(shot[0].picture)), (0, 0), 1.0))
    return Pyramid(np.asarray(strength), shot[0].usable)


def shows_detail(shot: Pyramid) -> bool:
    """Whether a picture has enough detail to be registered."""
    value = shot[0].picture[shot[0].usable]
    return len(value) > _LEAST_PIXELS and bool(np.ptp(value) > 0)
