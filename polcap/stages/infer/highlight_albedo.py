"""Albedo in highlights, from the diffuse reflection that a crossed shot shows there.

Around a highlight the estimator's albedo over the diffuse reflection gives the shading that it assumed. The ratio to
the shading of the normals is continued into the highlight, and turns the diffuse reflection there into an albedo.
"""

from dataclasses import replace

import cv2
import numpy as np

from polcap.images import Cues, Floats, SurfaceMaps
from polcap.optics import frames, fresnel
from polcap.optics.outline import disc_radius

# specular share of S0: below the first the estimator's albedo stays, above the second the crossed shot's counts
_GLOSS = (0.03, 0.1)
_AROUND = 0.05  # 1σ of the continuation, over the object's radius
_LEAST_PX = 2.0
_LEAST_COSINE = 0.2  # of the shading that divides
_REACHED = 1e-3  # least weight of a neighborhood
_FLOOR = 1e-3  # albedo


def correct_highlights(maps: SurfaceMaps, cues: Cues, ior: float) -> SurfaceMaps:
    """The maps (H, W, …) with the albedo of highlights from the crossed shot (`cues.body`); unchanged without one."""
    if cues.body is None or cues.body_known is None:
        return maps
    low, high = _GLOSS
    share = np.clip((specular_share(cues) - low) / (high - low), 0, 1) * cues.body_known  # of the crossed shot
    share = cv2.GaussianBlur(share.astype(np.float32), (0, 0), 1.0) * cues.body_known
    cosine = np.clip(frames.dot(maps.normal, cues.rays), _LEAST_COSINE, 1)
    shading = cosine * fresnel.transmission(cosine, ior)[0] * fresnel.transmission(1.0, ior)[0]
    by_shading = np.log(np.maximum(cues.body, _FLOOR)) - np.log(shading)[..., None]
    estimated = np.log(np.maximum(maps.diffuse, _FLOOR))
    matte = ((share < 0.5) & cues.body_known & (maps.diffuse.min(-1) > _FLOOR)).astype(np.float32)
    reach = max(_AROUND * disc_radius(cues.mask), _LEAST_PX)
    corrected = np.exp(by_shading + _continue((estimated - by_shading) * matte[..., None], matte, reach))
    diffuse = np.where(share[..., None] > 0, maps.diffuse + share[..., None] * (corrected - maps.diffuse), maps.diffuse)
    return replace(maps, diffuse=(np.clip(diffuse, 0, 1) * cues.mask[..., None]).astype(np.float32))


def specular_share(cues: Cues) -> Floats:
    """Specular share of S0, (H, W); 0 where the crossed shot shows nothing. Clipped light counts as specular."""
    assert cues.body is not None and cues.body_known is not None
    share = np.clip(1 - cues.body.sum(-1) / np.maximum(cues.radiance.sum(-1), 1e-6), 0, 1)
    return np.where(cues.body_known & cues.mask, share, 0).astype(np.float32)


def _continue(weighted: Floats, weight: Floats, reach: float) -> Floats:
    """Mean (H, W, 3) of weighted values over the narrowest neighborhood of weight, doubled from 1σ = `reach` px."""
    out = np.zeros_like(weighted, np.float32)
    left = np.ones(weight.shape, bool)
    while left.any() and reach < 2 * max(weight.shape):
        around = cv2.GaussianBlur(weight, (0, 0), reach)
        mean = cv2.GaussianBlur(weighted.astype(np.float32), (0, 0), reach) / np.maximum(around, 1e-9)[..., None]
        reached = left & (around > _REACHED)
        out[reached] = mean[reached]
        left, reach = left & ~reached, 2 * reach
    return out
