"""The gains of the shots from a chart's grey patches, and whether the chart shines.

A matt patch is unpolarized: its light is the same in every shot but for the gain. Gloss adds light that is the same
on dark and light patches alike, and polarized where the chart does not face flash and camera. So the ratio of two
shots against 1/(light of the patch) is a straight line: its height at 0 is the gain, its slope the chart's gloss.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Alignment, AngleStack, ColorCalibration, Floats, Quality

_GREYS = (18, 19, 20, 21, 22, 23)  # white to black
_LIGHT = 4  # the first so many serve for the gains; the darker two reflect 9 and 3 % and are mostly noise
_REFLECTANCE = np.array([0.900, 0.591, 0.362, 0.198])  # of the light ones, as the chart's maker states them
_SCATTER = 0.001  # between patches, of print, registration, falling light: gains by them err by .0009 (decision 6)


Box = tuple[slice, slice]


@dataclass(frozen=True)
class GreyPatches:
    """Gains by the greys."""

    gain: Floats  # (K, 3)
    sigma: Floats  # (K, 3) 1σ
    slope: float  # of ln light over ln reflectance from white to neutral 5; 1: linear
    gloss: float  # greatest ratio of a shot on the white patch that is gloss's, not the gain's; 0 where none is sure


def measure(radiance: AngleStack, alignment: Alignment, color: ColorCalibration) -> GreyPatches | None:
    """Gains from the light grey patches, or None without a chart, or where all of it is clipped.

    Each patch is summed in every shot's own pixels; unclipped patches are pooled by their light.
    """
    if color.quads is None:
        return None
    shots = len(radiance.angle)
    total = np.zeros((shots, len(_GREYS), 3))
    variance = np.zeros_like(total)
    usable = np.zeros(len(_GREYS), bool)
    for p, patch in enumerate(_GREYS):
        clipped = False
        for k in range(shots):
            box, inside = _polygon(color.quads[patch], alignment.transform[k], radiance.value.shape[1:3])
            count = inside.sum()
            clipped |= count < 9 or bool((radiance.quality[k][box][inside] & Quality.CLIPPED).any())
            total[k, p] = radiance.value[k][box][inside].mean(0) if count else 0
            variance[k, p] = radiance.variance[k][box][inside].sum(0) / max(count, 1) ** 2
        usable[p] = not clipped and bool((total[:, p] > 0).all())
    light = usable & (np.arange(len(_GREYS)) < _LIGHT)
    if not light.any():
        return None
    pooled, noise = total[:, light].sum(1), variance[:, light].sum(1)
    gain = pooled / pooled[0]
    photon = gain * np.sqrt(noise / pooled**2 + (noise / pooled**2)[0])
    each = total[:, light] / total[:1, light]  # (K, P, 3)
    scatter = each.std(1) / np.sqrt(light.sum())
    sigma = np.hypot(photon, scatter)
    sigma[0] = 0
    gain, sigma = _alike(gain, sigma)
    slope = _slope(total[0, :_LIGHT].sum(-1), light[:_LIGHT])
    return GreyPatches(gain, sigma, slope, _gloss(total.sum(-1)[:, usable], variance.sum(-1)[:, usable]))


def crossed_share(
    radiance: AngleStack, alignment: Alignment, color: ColorCalibration, gain: Floats
) -> tuple[Floats, float] | None:
    """S0 of the light greys over the crossed shot's light (3,), and its relative 1σ; None where they do not tell.

    Parameters
    ----------
    radiance, alignment, color
        As `measure` takes them.
    gain
        (K, 3) of the shots.
    """
    if color.quads is None or radiance.crossed is None or alignment.crossed is None:
        return None
    shots = (radiance.value / gain[:, None, None].astype(np.float32), radiance.quality)
    other, ratios = radiance.crossed.picture, []
    for patch in _GREYS[:_LIGHT]:
        parts, clipped = [], False
        for value, quality, transform in [
            *zip(*shots, alignment.transform, strict=True),
            (other.value, other.quality, alignment.crossed),
        ]:
            box, inside = _polygon(color.quads[patch], transform, value.shape[:2])
            clipped |= inside.sum() < 9 or bool((quality[box][inside] & Quality.CLIPPED).any())
            parts.append(value[box][inside].mean(0) if inside.any() else np.zeros(3))
        if not clipped and min(part.min() for part in parts) > 0:
            ratios.append(2 * np.mean(parts[:-1], axis=0) / parts[-1])  # unpolarized: every shot is half of S0
    if len(ratios) < 2:
        return None
    share = np.mean(ratios, axis=0)
    return share, float((np.std(ratios, axis=0, ddof=1) / share).max() / np.sqrt(len(ratios)))


def _slope(total: Floats, usable: NDArray[np.bool_]) -> float:
    """Slope of ln total (4,) over ln reflectance; NaN for fewer than three patches."""
    if usable.sum() < 3:
        return float("nan")
    return float(np.polyfit(np.log(_REFLECTANCE[usable]), np.log(total[usable]), 1)[0])


def _gloss(total: Floats, variance: Floats) -> float:
    """What gloss adds to a shot's ratio on the lightest patch, beyond 4σ; total and variance (K, P)."""
    if total.shape[1] < 4:
        return 0.0
    ratio = total / total[0]
    sigma = np.hypot(ratio * np.sqrt(variance / total**2 + (variance / total**2)[0]), _SCATTER)
    inverse = total[0].max() / total[0]  # 1 on the lightest patch, ~30 on black
    worst = 0.0
    for k in range(1, len(total)):
        weight = 1 / sigma[k] ** 2
        at = (weight * inverse).sum() / weight.sum()
        spread = float((weight * (inverse - at) ** 2).sum())
        slope = float((weight * (inverse - at) * ratio[k]).sum()) / max(spread, 1e-12)
        doubt = np.sqrt(1 / max(spread, 1e-12))
        line = (weight * ratio[k]).sum() / weight.sum() + slope * (inverse - at)
        doubt *= max(1.0, float(np.sqrt((weight * (ratio[k] - line) ** 2).sum() / (total.shape[1] - 2))))
        worst = max(worst, abs(slope) - 4 * doubt)
    return float(worst)


def _alike(gain: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    """One gain for all channels of a shot where they agree within 3σ: most flashes keep their colour."""
    weight = 1 / np.maximum(sigma, 1e-6) ** 2
    mean = (gain * weight).sum(1, keepdims=True) / weight.sum(1, keepdims=True)
    agree = (np.abs(gain - mean) <= 3 * np.maximum(sigma, 1e-6)).all(1, keepdims=True)
    pooled_sigma = np.sqrt(1 / weight.sum(1, keepdims=True)) * (sigma > 0)
    return np.where(agree, mean, gain), np.where(agree, pooled_sigma, sigma)


def _polygon(quad: Floats, transform: Floats, shape: tuple[int, ...]) -> tuple[Box, NDArray[np.bool_]]:
    """The pixels of a shot inside a reference-grid quad (4, 2), one pixel within its edge, in a box around them."""
    corners = transform @ np.column_stack([quad, np.ones(4)]).T
    place = (corners[:2] / corners[2]).T  # (4, 2) x, y
    low = np.clip(np.floor(place.min(axis=0)).astype(int) - 2, 0, shape[1::-1])
    high = np.clip(np.ceil(place.max(axis=0)).astype(int) + 3, low, shape[1::-1])
    box = slice(low[1], high[1]), slice(low[0], high[0])
    inside = np.zeros(high[::-1] - low[::-1], np.uint8)
    if inside.size:
        cv2.fillConvexPoly(inside, np.round((place - low) * 16).astype(np.int32), 1, shift=4)
        inside = np.asarray(cv2.erode(inside, np.ones((3, 3), np.uint8)), np.uint8)
    return box, inside > 0
