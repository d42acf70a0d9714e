"""Albedo: in highlights, its uncertain scale, and its detail finer than a superpixel.

Clipped highlights are filled, and albedo under highlights comes from a cross-polarized shot, if any. A crossed
shot shows the diffuse reflection under a highlight. Around the highlight, the estimator's albedo over the diffuse
reflection gives the shading that it assumed. The ratio to the shading of the normals is continued into the
highlight, and turns the diffuse reflection there into an albedo.

The reference shot at the RAW's pixels shows printed texture and fine relief alike. Relief continues from scale to
scale. So the shading of the superpixels' normals shows how strong finer shading may be. Where the normals are smooth
and certain, fine detail of the light is detail of the albedo.
"""

from dataclasses import replace
from math import hypot, log, pi

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Cues, Floats, Quality, SurfaceMaps
from polcap.optics import brdf, frames, fresnel
from polcap.optics.outline import disc_radius
from polcap.optics.resize import area_mean

REACHED = 0.05  # least share of known pixels under a Gaussian for a mean
# specular share of S0: below the first the estimator's albedo stays, above the second the crossed shot's counts
_GLOSS = (0.03, 0.1)
_AROUND = 0.05  # 1σ of the continuation, over the object's radius
_LEAST_PX = 2.0
_LEAST_COSINE = 0.2  # of the shading that divides
_LEAST_MATTE = 1e-3  # share of matte pixels in a neighborhood
_FLOOR = 1e-3  # albedo
_MAPS_SIGMA = 0.05  # of the estimators' own albedos, with a correct scale (docs/benchmarks/gates.md)
# of objects next to their chart: mean, and spread of the logarithm (docs/benchmarks/gates.md)
_USUAL_F0, _F0_SPREAD = 0.044, 0.06  # median of an object
_USUAL_WHITE, _WHITE_SPREAD = 0.65, 0.25  # 95th percentile of the albedo
_USUAL, _DOUBT = 1.5, 0.25  # sum of both deviations that is still usual [spreads]; doubt per spread beyond
_LARGEST_DOUBT = 0.7  # a factor of two in light, ln 2
_COMMON_WHITE, _WHITE_RANGE = 0.9, 0.14  # 95th percentile of the albedo: usual limit; excess that doubts a factor of e
_BAND = 2.0  # px, 1σ: shading in finer detail predicts the shading that is finer than a superpixel
_DETAIL_AROUND = 4.0  # px, 1σ of the means of power, and of the albedo
# factors on the power of each explanation of fine detail (docs/benchmarks/albedo.md)
_SHADING = 4.0  # on that of the normals' shading
_UNCERTAIN = 0.3  # on that of shading by the normals' expected error, most of which is coarser
_NOISE = 4.0  # on the variance of S0: the detail comes from one shot, and one photosite a color
_GRAZING = 0.1  # least cosine of the shading
_DARKEST = 0.02  # least albedo and least roughness² of the shading
_EDGE = np.ones((5, 5), np.uint8)  # px around the outline and around defects in which the light mixes
_DEFECTS = Quality.CLIPPED | Quality.OUTSIDE | Quality.GHOST


def fill_highlights(image: Floats, cues: Cues) -> Floats:
    """Fill highlights that clip in the shortest exposure: image (H, W, 3) with means of the pixels around."""
    clipped = cues.mask & ((cues.quality & Quality.CLIPPED) > 0)
    hole = cues.mask & (cv2.dilate(clipped.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    known = cues.mask & ~hole
    out = np.array(image, np.float32)
    if hole.any() and known.any():
        around, far = mean_around(out, known, hole, blur=2.0, least=REACHED)
        out[hole] = around[hole]
        out[far] = out[known].mean(axis=0)
    return out


def mean_around(
    image: Floats, known: NDArray[np.bool_], wanted: NDArray[np.bool_], blur: float, least: float
) -> tuple[Floats, NDArray[np.bool_]]:
    """Means (H, W, 3) of known pixels about each wanted pixel (H, W), and the wanted pixels without a mean (H, W).

    The Gaussian weights start at 1σ = `blur` px and double until known pixels have a share of `least`.
    """
    weight = known.astype(np.float32)
    weighted = (image * weight[..., None]).astype(np.float32)
    out, left = np.zeros_like(weighted), wanted.copy()
    while left.any() and blur < 2 * max(known.shape):
        share = cv2.GaussianBlur(weight, (0, 0), blur)
        mean = cv2.GaussianBlur(weighted, (0, 0), blur) / np.maximum(share, 1e-9)[..., None]
        reached = left & (share > least)
        out[reached] = mean[reached]
        left, blur = left & ~reached, 2 * blur
    return out, left


def correct_highlights(maps: SurfaceMaps, cues: Cues, ior: float) -> SurfaceMaps:
    """Correct the albedo in highlights by the cross-polarized shot (`cues.body`); maps (H, W, …)."""
    if cues.body is None or cues.body_known is None:
        return maps
    low, high = _GLOSS
    share = np.clip((specular_share(cues) - low) / (high - low), 0, 1) * cues.body_known  # of the crossed shot
    share = cv2.GaussianBlur(share.astype(np.float32), (0, 0), 1.0) * cues.body_known
    cosine = np.clip(frames.dot(maps.normal, cues.rays), _LEAST_COSINE, 1)
    shading = cosine * fresnel.transmission(cosine, ior)[0] * fresnel.transmission(1.0, ior)[0]
    by_shading = np.log(np.maximum(cues.body, _FLOOR)) - np.log(shading)[..., None]
    estimated = np.log(np.maximum(maps.diffuse, _FLOOR))
    matte = (share < 0.5) & cues.body_known & (maps.diffuse.min(-1) > _FLOOR)
    reach = max(_AROUND * disc_radius(cues.mask), _LEAST_PX)
    continued, _ = mean_around(estimated - by_shading, matte, np.ones_like(matte), blur=reach, least=_LEAST_MATTE)
    corrected = np.exp(by_shading + continued)
    diffuse = np.where(share[..., None] > 0, maps.diffuse + share[..., None] * (corrected - maps.diffuse), maps.diffuse)
    return replace(maps, diffuse=(np.clip(diffuse, 0, 1) * cues.mask[..., None]).astype(np.float32))


def specular_share(cues: Cues) -> Floats:
    """Specular share of S0, (H, W), from the cross-polarized shot; 0 where it shows nothing.

    Clipped light is specular.
    """
    assert cues.body is not None and cues.body_known is not None
    share = np.clip(1 - cues.body.sum(-1) / np.maximum(cues.radiance.sum(-1), 1e-6), 0, 1)
    return np.where(cues.body_known & cues.mask, share, 0).astype(np.float32)


def albedo_sigma(maps: SurfaceMaps, of_chart: float | None) -> float | None:
    """Relative 1σ of the scale of all albedos; `of_chart` is that of the light on the chart, None without a chart.

    A chart behind the object, or in a shadow, gets less light than the object. The picture of the chart does not show
    this, but then both the object's colors and its F0 are higher than usual.
    """
    if of_chart is None or not maps.mask.any():
        return None
    white = max(float(np.percentile(maps.diffuse[maps.mask].max(-1), 95)), _FLOOR)
    gloss = max(float(np.median(maps.specular[maps.mask].mean(-1))), _FLOOR)
    unusual = max(log(white / _USUAL_WHITE) / _WHITE_SPREAD, -_USUAL)  # dark objects are no reason for trust
    if maps.estimator != "analytic":  # its F0 is too rough for this
        unusual += log(gloss / _USUAL_F0) / _F0_SPREAD
    doubt = max(_DOUBT * (unusual - _USUAL), (white - _COMMON_WHITE) / _WHITE_RANGE, 0.0)
    return hypot(of_chart, _MAPS_SIGMA, min(doubt, _LARGEST_DOUBT))


def select_detail(detail: Floats, cues: Cues, maps: SurfaceMaps) -> Floats:
    """The part of the photograph's detail (2H, 2W) that belongs to the albedo, as logarithm, float16.

    Each pixel's detail is multiplied by the share of the power around it that neither shading nor noise explains (a
    Wiener filter). The detail covers the superpixels (H, W) of `maps`.
    """
    solid = cues.mask & ((cues.quality & np.uint8(_DEFECTS)) == 0)
    inside = cv2.erode(solid.astype(np.uint8), _EDGE, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    height, width = inside.shape
    explained = _mean(_power_of_shading(cues, maps) + _NOISE * cues.ratio_sigma**2, cues.mask, _DETAIL_AROUND)
    power = _mean(area_mean(np.square(detail, dtype=np.float32), (height, width)), inside, _DETAIL_AROUND)
    share = np.clip(1 - explained / np.maximum(power, 1e-9), 0, 1) * inside
    selected = cv2.resize(share.astype(np.float32), (2 * width, 2 * height))
    selected *= detail
    return np.asarray(selected, np.float16)


def _power_of_shading(cues: Cues, maps: SurfaceMaps) -> Floats:
    """Squared logarithm (H, W) of the fine shading that the normals show, and that their error may hide."""
    albedo = np.maximum(_mean(maps.diffuse.mean(axis=-1), cues.mask, _DETAIL_AROUND), _DARKEST)
    gloss, alpha = maps.specular.mean(axis=-1), np.maximum(maps.roughness**2, _DARKEST)

    def log_light(zenith: Floats) -> Floats:
        """Logarithm (H, W) of the light of surfaces at a zenith angle, with the flash at the lens."""
        c = np.maximum(np.cos(zenith), _GRAZING)
        mirrored = pi * brdf.ggx_distribution(c, alpha) * brdf.smith_masking(c, c, alpha) / (4 * c)
        return np.asarray(np.log(albedo * c + gloss * mirrored), np.float32)

    zenith = np.arccos(np.clip(frames.dot(maps.normal, cues.rays), 0, 1))
    error = np.radians(maps.confidence)
    light = log_light(zenith)
    fine = light - _mean(light, cues.mask, _BAND)
    doubt = (log_light(np.maximum(zenith - error, 0)) - log_light(zenith + error)) / 2
    return np.asarray(_SHADING * fine**2 + _UNCERTAIN * doubt**2)


def _mean(image: Floats, inside: NDArray[np.bool_], sigma: float) -> Floats:
    """Gaussian mean (H, W) of the pixels inside a mask."""
    weight = inside.astype(np.float32)
    total, share = (cv2.GaussianBlur(part, (0, 0), sigma) for part in (image.astype(np.float32) * weight, weight))
    return np.asarray(total / np.maximum(share, 1e-3))
