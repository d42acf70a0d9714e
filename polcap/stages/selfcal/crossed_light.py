"""Factor from the light of the cross-polarized shot to S0, measured on the chart or on the object.

The flash behind a polarizer has another energy, and the polarizer at the lens halves diffuse light once more. So the
factor is measured without mirror reflection: on a chart's matt grey patches, or on the object where the ratio of S0 to
the crossed shot's light is smallest. Gloss only adds to S0. On most of an object it adds little, so most ratios are
close to the smallest. The factor from an object has an error of about 3 %, because it includes wide, uniform gloss.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.chart_values import ColorCalibration
from polcap.image_values import Floats, Quality
from polcap.optics import crossing, mueller
from polcap.optics.warp import warp
from polcap.stage_values import Alignment, AngleStack
from polcap.stages.selfcal import grey_patches
from polcap.stages.selfcal.object_gains import ObjectShots

_BLUR_PX = 2.0  # 1σ; averages noise before the ratio
_MODE_SHARE = 0.25  # share of the pixels, with the most similar ratios: they have hardly any gloss
_LEAST_PX = 100  # pixels for the mode


def measure(
    radiance: AngleStack, alignment: Alignment, color: ColorCalibration, shots: ObjectShots, gain: Floats, angle: Floats
) -> Floats | None:
    """Factor (3,) from the light of the cross-polarized shot to S0; None without such a shot or enough pixels."""
    if radiance.crossed is None or alignment.crossed is None:
        return None
    by_chart = grey_patches.crossed_factor(radiance, alignment, color, gain)
    if by_chart is not None:
        return by_chart
    source = radiance.crossed.picture
    picture = warp(source.value, alignment.crossed, shots.crop, order=1)
    flags = (source.quality & int(Quality.CLIPPED | Quality.GHOST)).astype(np.float32)
    sound = warp(flags, alignment.crossed, shots.crop, order=1) == 0
    solve = np.linalg.pinv(mueller.analyzer(angle))
    s0, s1, s2 = np.einsum("jk,khwc->jhwc", solve, shots.value / gain[:, None, None])
    p = crossing.polarization_along(s1, s2, radiance.crossed.angle)
    inside = shots.mask & (shots.quality == 0) & sound
    weight = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), _BLUR_PX)
    expected, crossed = (  # I = D − p²/D of `optics/crossing`, and the crossed shot
        cv2.GaussianBlur((part * inside[..., None]).astype(np.float32), (0, 0), _BLUR_PX)
        for part in (s0 - p**2 / np.maximum(s0, 1e-9), picture)
    )
    lit = inside & (weight > 0.5) & (crossed.min(-1) > 0) & (expected.min(-1) > 0)
    bright = lit & (crossed.sum(-1) > 0.2 * np.median(crossed.sum(-1)[lit])) if lit.any() else lit
    if bright.sum() < _LEAST_PX:
        return None
    ratio = np.log(expected[bright] / crossed[bright])  # (N, 3)
    return np.asarray(np.exp(np.median(ratio[_closest(ratio.mean(-1))], axis=0)))


def _closest(ratio: Floats) -> NDArray[np.intp]:
    """Indices of the ratios (N,) in the shortest interval that contains `_MODE_SHARE` of them (their mode)."""
    order = np.argsort(ratio)
    count = max(int(_MODE_SHARE * len(ratio)), 2)
    width = ratio[order[count - 1 :]] - ratio[order[: len(ratio) - count + 1]]
    first = int(np.argmin(width))
    return np.asarray(order[first : first + count])
