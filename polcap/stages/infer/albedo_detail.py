"""Albedo detail finer than a superpixel: the photograph's detail that neither shading nor noise explains.

The reference shot at the RAW's pixels shows printed texture and fine relief alike. Relief continues from scale to
scale. So the shading of the superpixels' normals shows how strong finer shading may be. Where the normals are smooth
and certain, fine detail of the light is detail of the albedo.
"""

from math import pi

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Cues, Floats, Quality, SurfaceMaps
from polcap.optics import brdf, frames
from polcap.optics.resize import area_mean

_BAND = 2.0  # px, 1σ: shading in finer detail predicts the shading that is finer than a superpixel
_AROUND = 4.0  # px, 1σ of the means of power, and of the albedo
# Factors on the power of each explanation, chosen on four captures and a synthetic relief (docs/benchmarks/albedo.md)
_SHADING = 4.0  # on that of the normals' shading
_UNCERTAIN = 0.3  # on that of shading by the normals' expected error, most of which is coarser
_NOISE = 4.0  # on the variance of S0: the detail comes from one shot, and one photosite a color
_GRAZING = 0.1  # least cosine of the shading
_DARKEST = 0.02  # least albedo and least roughness² of the shading
_EDGE = np.ones((5, 5), np.uint8)  # px around the outline and around defects in which the light mixes
_DEFECTS = Quality.CLIPPED | Quality.OUTSIDE | Quality.GHOST


def select(detail: Floats, cues: Cues, maps: SurfaceMaps) -> Floats:
    """The part of the photograph's detail (2 H, 2 W) that belongs to the albedo, as logarithm, float16.

    Each pixel's detail is multiplied by the share of the power around it that neither shading nor noise explains (a
    Wiener filter). The detail covers the superpixels (H, W) of `maps`.
    """
    solid = cues.mask & ((cues.quality & np.uint8(_DEFECTS)) == 0)
    inside = cv2.erode(solid.astype(np.uint8), _EDGE, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0
    height, width = inside.shape
    explained = _mean(_power_of_shading(cues, maps) + _NOISE * cues.ratio_sigma**2, cues.mask, _AROUND)
    power = _mean(area_mean(np.square(detail, dtype=np.float32), (height, width)), inside, _AROUND)
    share = np.clip(1 - explained / np.maximum(power, 1e-9), 0, 1) * inside
    selected = cv2.resize(share.astype(np.float32), (2 * width, 2 * height))
    selected *= detail
    return np.asarray(selected, np.float16)


def _power_of_shading(cues: Cues, maps: SurfaceMaps) -> Floats:
    """Squared logarithm (H, W) of the fine shading that the normals show, and that their error may hide."""
    albedo = np.maximum(_mean(maps.diffuse.mean(axis=-1), cues.mask, _AROUND), _DARKEST)
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
