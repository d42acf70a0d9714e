"""Gains of the shots from a chart's grey patches, and the gloss of the chart.

A matt patch is unpolarized, so its light in two shots differs only by the gain. Gloss adds the same light to dark and
bright patches. This light is polarized if the chart does not face flash and camera. So the ratio of two shots, plotted
over 1/(light of the patch), is a line whose slope is the gloss of the chart. The gain is the ratio of the sums over the
light patches, where gloss counts least. Patches that white balance excluded (hidden, in shade, glossy) are not used.
"""

from dataclasses import dataclass

import numpy as np

from polcap.chart_values import ColorCalibration
from polcap.image_values import Floats, MaskedImage, Quality
from polcap.optics.projection import pixels_inside, transform_points
from polcap.stage_values import Alignment, AngleStack

_GREYS = (18, 19, 20, 21, 22, 23)  # white to black
_LIGHT = 4  # number of light patches, used for the gains; the two dark ones reflect 9 and 3 % and are mostly noise
_REFLECTANCE = np.array([0.900, 0.591, 0.362, 0.198])  # of the light patches, from the chart's maker
_SCATTER = 0.001  # relative 1σ of a patch by print, registration and falloff; gains err by 0.0009 (decision 6)
_MOST_SCATTER = 0.2  # greatest relative scatter between patches; a chart that moved by half a patch has 0.7
_LEAST_PX, _MARGIN_PX = 9, 0.5  # pixels of a patch; width of its edge that is left out
_SIGMAS = 4.0  # σ; smaller gloss is not significant


@dataclass(frozen=True)
class GreyPatches:
    """Gains of the shots from the chart's grey patches, with their linearity and gloss."""

    gain: Floats  # (K, 3)
    sigma: Floats  # (K, 3) 1σ
    slope: float  # of ln light over ln reflectance, white to neutral 5; 1: linear; NaN: fewer than three patches
    gloss: float  # largest part of a ratio of shots on the white patch that comes from gloss, minus 4σ


def measure(radiance: AngleStack, alignment: Alignment, color: ColorCalibration) -> GreyPatches | None:
    """Gains of the shots from the chart's light grey patches; None without a usable patch, or if the chart moved.

    Each patch is averaged in the pixels of each shot; the patches are then summed.
    """
    if color.place is None:
        return None
    shots = len(radiance.angle)
    mean, variance = np.stack([_means(radiance.shot(k), alignment.transform[k], color) for k in range(shots)], axis=1)
    usable = (mean > 0).all(axis=(0, 2))  # (6,) of mean (K, 6, 3)
    light = usable & (np.arange(len(_GREYS)) < _LIGHT)
    if not light.any():
        return None
    total, noise = mean[:, light].sum(1), variance[:, light].sum(1)
    gain = total / total[0]
    photon = gain * np.sqrt(noise / total**2 + (noise / total**2)[0])
    ratio = mean[:, light] / mean[:1, light]  # (K, P, 3)
    if (ratio.std(1) > _MOST_SCATTER * ratio.mean(1)).any():
        return None
    sigma = np.hypot(photon, ratio.std(1) / np.sqrt(light.sum()))
    sigma[0] = 0
    gain, sigma = _one_for_all_channels(gain, sigma)
    reflectance = np.log(_REFLECTANCE[light[:_LIGHT]])  # for the slope of the tone curve
    enough = len(reflectance) > 2
    slope = float(np.polyfit(reflectance, np.log(mean[0, light].sum(-1)), 1)[0]) if enough else float("nan")
    return GreyPatches(gain, sigma, slope, _gloss(mean.sum(-1)[:, usable], variance.sum(-1)[:, usable]))


def crossed_factor(radiance: AngleStack, alignment: Alignment, color: ColorCalibration, gain: Floats) -> Floats | None:
    """Factor (3,) from the cross-polarized shot's light to S0, by the light grey patches; None for fewer than two."""
    if color.place is None or radiance.crossed is None or alignment.crossed is None:
        return None
    shots = [_means(radiance.shot(k), transform, color)[0] for k, transform in enumerate(alignment.transform)]
    crossed = _means(radiance.crossed.picture, alignment.crossed, color)[0]
    light = 2 * np.mean(shots / gain[:, None], axis=0)  # (6, 3) unpolarized: every shot is half of S0
    usable = (np.min([*shots, crossed], axis=(0, 2)) > 0) & (np.arange(len(_GREYS)) < _LIGHT)
    return (light / crossed)[usable].mean(axis=0) if usable.sum() > 1 else None


def _means(picture: MaskedImage, transform: Floats, color: ColorCalibration) -> Floats:
    """Mean light of each grey patch in a shot, and variances of the means: (2, 6, 3); NaN for unusable patches.

    A patch cannot be used if white balance excluded it, if it is clipped in this shot, or if fewer than nine of its
    pixels are half a pixel or more from its edge. `transform` maps px of the reference shot to px of the shot.
    """
    assert color.place is not None
    found = np.full((2, len(_GREYS), 3), np.nan)
    for index, patch in enumerate(_GREYS):
        quad = transform_points(transform, color.place.quads[patch])
        x, y = pixels_inside(quad, picture.quality.shape, _MARGIN_PX).T
        left_out = color.patches is not None and color.patches.use is not None and color.patches.use[patch] > 0
        if left_out or len(x) < _LEAST_PX or (picture.quality[y, x] & Quality.CLIPPED).any():
            continue
        found[:, index] = picture.value[y, x].mean(axis=0), picture.variance[y, x].sum(axis=0) / len(x) ** 2
    return found


def _gloss(light: Floats, variance: Floats) -> float:
    """Largest part of a ratio of two shots on the lightest patch that comes from gloss, minus 4σ; inputs are (K, P)."""
    if light.shape[1] < 4:
        return 0.0
    ratio = light / light[0]
    sigma = np.hypot(ratio * np.sqrt(variance / light**2 + (variance / light**2)[0]), _SCATTER)
    inverse = light[0].max() / light[0]  # 1 on the lightest patch, ~30 on black
    worst = 0.0
    for k in range(1, len(light)):
        line, covariance = np.polyfit(inverse, ratio[k], 1, w=1 / sigma[k], cov="unscaled")
        misfit = float((((ratio[k] - np.polyval(line, inverse)) / sigma[k]) ** 2).sum()) / (light.shape[1] - 2)
        worst = max(worst, abs(line[0]) - _SIGMAS * np.sqrt(covariance[0, 0] * max(1.0, misfit)))
    return float(worst)


def _one_for_all_channels(gain: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    """Gains (K, 3) and their relative 1σ (K, 3), with one gain for all channels of a shot that agree within 3σ.

    Most flashes do not change color. The first shot, to which the gains refer, has the gain 1 and 1σ of 0.
    """
    weight = 1 / np.maximum(sigma, 1e-6) ** 2
    mean = (gain * weight).sum(1, keepdims=True) / weight.sum(1, keepdims=True)
    agree = (np.abs(gain - mean) <= 3 * np.maximum(sigma, 1e-6)).all(1, keepdims=True)
    pooled = np.sqrt(1 / weight.sum(1, keepdims=True)) * (sigma > 0)
    return np.where(agree, mean, gain), np.where(agree, pooled, sigma)
