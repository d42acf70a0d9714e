"""By what a crossed shot's light is to be multiplied to stand beside S0: told by the chart, else by the object.

The flash behind a polarizer has another energy, and what the body scatters is halved once more before the lens. So the
factor is measured where nothing is mirrored: on a chart's matt greys, or on the object, where S0 over the crossed
shot's light is least. Gloss only adds to S0; over most of an object it adds little, and the ratios pile up there.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Alignment, AngleStack, Bits, ColorCalibration, Floats, Quality
from polcap.optics import crossing, mueller
from polcap.optics.warp import warp
from polcap.stages.selfcal import grey_patches

_BLUR_PX = 2.0  # noise is averaged before the ratio is taken
_SHORTEST = 0.25  # share of the pixels whose ratios lie closest together: they have no gloss to speak of
_LEAST_PX = 100
_GUESSED = 0.03  # 1σ of the object's own word: a wide, even gloss is part of it. Assumed


def measure(
    radiance: AngleStack,
    alignment: Alignment,
    color: ColorCalibration,
    light: Floats,
    gain: Floats,
    angle: Floats,
    sound: NDArray[np.bool_],
    crop: tuple[int, int, int, int],
) -> tuple[Floats, float] | None:
    """The factor (3,) and its relative 1σ; None without a crossed shot.

    Parameters
    ----------
    radiance, alignment, color
        As the stage has them.
    light
        (K, h, w, 3) the shots on the crop, registered.
    gain
        (K, 3).
    angle
        (K,) rad, of the shots.
    sound
        (h, w) pixels of the object that can be believed.
    crop
        x0, y0, x1, y1 on the reference grid, px.
    """
    if radiance.crossed is None or alignment.crossed is None:
        return None
    told = grey_patches.crossed_share(radiance, alignment, color, gain)
    if told is not None:
        return told
    picture, quality = on_crop(radiance, alignment.crossed, crop)
    solve = np.linalg.pinv(mueller.analyzer(angle))
    s0, s1, s2 = np.einsum("jk,khwc->jhwc", solve, light / gain[:, None, None])
    across = crossing.polarized(s1, s2, radiance.crossed.angle)
    inside = sound & (quality == 0)
    share = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), _BLUR_PX)
    whole, other = (
        cv2.GaussianBlur((part * inside[..., None]).astype(np.float32), (0, 0), _BLUR_PX)
        for part in (s0 - across**2 / np.maximum(s0, 1e-9), picture)
    )
    some = inside & (share > 0.5) & (other.min(-1) > 0) & (whole.min(-1) > 0)
    bright = some & (other.sum(-1) > 0.2 * np.median(other.sum(-1)[some])) if some.any() else some
    if bright.sum() < _LEAST_PX:
        return None
    ratio = np.log(whole[bright] / other[bright])  # (N, 3)
    kept = ratio[_closest(ratio.mean(-1))]
    return np.exp(np.median(kept, axis=0)), _GUESSED


def on_crop(radiance: AngleStack, transform: Floats, box: tuple[int, int, int, int]) -> tuple[Floats, Bits]:
    """The crossed shot (h, w, 3) on a box of the reference grid, and its clipped pixels, linear interpolation."""
    assert radiance.crossed is not None
    picture = radiance.crossed.picture
    bad = (picture.quality & int(Quality.CLIPPED | Quality.GHOST)).astype(np.float32)
    return warp(picture.value, transform, box, order=1), (warp(bad, transform, box, order=1) > 0).astype(np.uint8)


def _closest(ratio: Floats) -> NDArray[np.intp]:
    """Which of the ratios (N,) make the shortest interval that holds `_SHORTEST` of them."""
    order = np.argsort(ratio)
    count = max(int(_SHORTEST * len(ratio)), 2)
    width = ratio[order[count - 1 :]] - ratio[order[: len(ratio) - count + 1]]
    first = int(np.argmin(width))
    return np.asarray(order[first : first + count])
