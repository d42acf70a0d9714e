"""Gains of the shots from a chart's grey patches, and the gloss of the chart.

A matt patch is unpolarized: its light in two shots differs only by the gain. Gloss adds the same light to dark and
bright patches, and this light is polarized if the chart does not face flash and camera. So the ratio of two shots is a
line over 1/(light of the patch): its value at 0 is the gain, its slope the gloss of the chart. Patches that white
balance excluded (hidden, in shade, glossy) are not used.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from polcap.images import Alignment, AngleStack, Bools, ColorCalibration, Floats, MaskedImage, Quality
from polcap.optics.projection import transform_points

_GREYS = (18, 19, 20, 21, 22, 23)  # white to black
_LIGHT = 4  # number of light patches, used for the gains; the two dark ones reflect 9 and 3 % and are mostly noise
_REFLECTANCE = np.array([0.900, 0.591, 0.362, 0.198])  # of the light patches, from the chart's maker
_SCATTER = 0.001  # between patches, by print, registration and falloff; measured gains err by 0.0009 (decision 6)
_LEAST_PX = 9  # of a patch
_SURE = 4.0  # least significance of gloss, σ


@dataclass(frozen=True)
class GreyPatches:
    """Gains from the grey patches, with the linearity and gloss of the chart."""

    gain: Floats  # (K, 3)
    sigma: Floats  # (K, 3) 1σ
    slope: float  # of ln light over ln reflectance, white to neutral 5; 1: linear; NaN: fewer than three patches
    gloss: float  # largest part of a ratio of shots on the white patch that comes from gloss, minus 4σ


def measure(radiance: AngleStack, alignment: Alignment, color: ColorCalibration) -> GreyPatches | None:
    """Gains from the light grey patches; None without a chart, or if all of them are hidden or clipped.

    Each patch is averaged in the pixels of each shot; the patches are then summed.
    """
    if color.place is None:
        return None
    seen = [
        [_patch(radiance.shot(k), transform, color.place.quads[p]) for p in _GREYS]
        for k, transform in enumerate(alignment.transform)
    ]
    mean = np.array([[one.mean for one in shot] for shot in seen], np.float64)  # (K, P, 3)
    variance = np.array([[one.variance for one in shot] for shot in seen], np.float64)
    sound = np.array([[one.sound for one in shot] for shot in seen]).all(axis=0)
    usable = sound & (mean > 0).all(axis=(0, 2)) & _serving(color)  # (6,)
    light = usable & (np.arange(len(_GREYS)) < _LIGHT)
    if not light.any():
        return None
    pooled, noise = mean[:, light].sum(1), variance[:, light].sum(1)
    gain = pooled / pooled[0]
    photon = gain * np.sqrt(noise / pooled**2 + (noise / pooled**2)[0])
    each = mean[:, light] / mean[:1, light]  # (K, P, 3)
    sigma = np.hypot(photon, each.std(1) / np.sqrt(light.sum()))
    sigma[0] = 0
    gain, sigma = _one_for_all_channels(gain, sigma)
    slope = _slope(mean[0, :_LIGHT].sum(-1), light[:_LIGHT])
    return GreyPatches(gain, sigma, slope, _gloss(mean.sum(-1)[:, usable], variance.sum(-1)[:, usable]))


def crossed_factor(radiance: AngleStack, alignment: Alignment, color: ColorCalibration, gain: Floats) -> Floats | None:
    """S0 of the light patches over the crossed shot's light (3,), for gains (K, 3); None for fewer than two patches."""
    if color.place is None or radiance.crossed is None or alignment.crossed is None:
        return None
    ratios = []
    for serves, patch in zip(_serving(color), _GREYS[:_LIGHT]):
        quad = color.place.quads[patch]
        shots = [_patch(radiance.shot(k), transform, quad) for k, transform in enumerate(alignment.transform)]
        crossed = _patch(radiance.crossed.picture, alignment.crossed, quad)
        sound = serves and all(one.sound and one.mean.min() > 0 for one in (*shots, crossed))
        if sound:  # unpolarized: every shot is half of S0
            ratios.append(2 * np.mean([one.mean / g for one, g in zip(shots, gain)], axis=0) / crossed.mean)
    return np.mean(ratios, axis=0) if len(ratios) > 1 else None


def _serving(color: ColorCalibration) -> Bools:
    """Whether white balance used each grey patch (6,)."""
    if color.patches is None or color.patches.use is None:
        return np.ones(len(_GREYS), bool)
    return np.asarray(color.patches.use[list(_GREYS)] == 0)


@dataclass(frozen=True)
class _Patch:
    mean: Floats  # (3,)
    variance: Floats  # (3,) of the mean
    sound: bool  # unclipped, with nine pixels or more


def _patch(picture: MaskedImage, transform: Floats, quad: Floats) -> _Patch:
    """Mean of a shot's pixels inside a quad (4, 2) px of the reference grid, one pixel or more from its edge."""
    place = transform_points(transform, quad)  # (4, 2) x, y
    height, width = picture.quality.shape
    low = np.clip(np.floor(place.min(axis=0)).astype(int) - 2, 0, [width, height])
    high = np.clip(np.ceil(place.max(axis=0)).astype(int) + 3, low, [width, height])
    box = slice(low[1], high[1]), slice(low[0], high[0])
    drawn = np.zeros(high[::-1] - low[::-1], np.uint8)
    if drawn.size:
        cv2.fillConvexPoly(drawn, np.round((place - low) * 16).astype(np.int32), 1, shift=4)
        drawn = np.asarray(cv2.erode(drawn, np.ones((3, 3), np.uint8)), np.uint8)
    inside = drawn > 0
    count = int(inside.sum())
    clipped = bool((picture.quality[box][inside] & Quality.CLIPPED).any())
    mean = picture.value[box][inside].mean(0) if count else np.zeros(3)
    variance = picture.variance[box][inside].sum(0) / max(count, 1) ** 2
    return _Patch(mean, variance, count >= _LEAST_PX and not clipped)


def _slope(light: Floats, usable: Bools) -> float:
    """Slope of ln light (4,) over ln reflectance; NaN for fewer than three usable patches."""
    if usable.sum() < 3:
        return float("nan")
    return float(np.polyfit(np.log(_REFLECTANCE[usable]), np.log(light[usable]), 1)[0])


def _gloss(light: Floats, variance: Floats) -> float:
    """Largest part of a ratio of shots on the lightest patch that is gloss, minus 4σ; light and variance (K, P)."""
    if light.shape[1] < 4:
        return 0.0
    ratio = light / light[0]
    sigma = np.hypot(ratio * np.sqrt(variance / light**2 + (variance / light**2)[0]), _SCATTER)
    inverse = light[0].max() / light[0]  # 1 on the lightest patch, ~30 on black
    worst = 0.0
    for k in range(1, len(light)):
        weight = 1 / sigma[k] ** 2
        at = (weight * inverse).sum() / weight.sum()
        square = float((weight * (inverse - at) ** 2).sum())
        slope = float((weight * (inverse - at) * ratio[k]).sum()) / max(square, 1e-12)
        error = np.sqrt(1 / max(square, 1e-12))
        line = (weight * ratio[k]).sum() / weight.sum() + slope * (inverse - at)
        error *= max(1.0, float(np.sqrt((weight * (ratio[k] - line) ** 2).sum() / (light.shape[1] - 2))))
        worst = max(worst, abs(slope) - _SURE * error)
    return float(worst)


def _one_for_all_channels(gain: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    """One gain for all channels of a shot if they agree within 3σ: the color of most flashes does not change."""
    weight = 1 / np.maximum(sigma, 1e-6) ** 2
    mean = (gain * weight).sum(1, keepdims=True) / weight.sum(1, keepdims=True)
    agree = (np.abs(gain - mean) <= 3 * np.maximum(sigma, 1e-6)).all(1, keepdims=True)
    pooled = np.sqrt(1 / weight.sum(1, keepdims=True)) * (sigma > 0)
    return np.where(agree, mean, gain), np.where(agree, pooled, sigma)
