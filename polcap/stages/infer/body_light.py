"""Albedo in highlights, from light that a crossed shot shows without them.

Around a highlight the estimator's albedo stands for what it took the shading for. That shading is carried on into the
highlight, over what the normals say of it, and divides the light that the body scatters there.
"""

from dataclasses import replace

import cv2
import numpy as np

from polcap.images import Cues, Floats, SurfaceMaps
from polcap.optics import frames, fresnel

# share of S0 that is mirrored: below the first the estimator's albedo stays, above the second the crossed shot's counts
_GLOSS = (0.03, 0.1)
_AROUND = 0.05  # 1σ over which the shading is carried on, of the object's radius
_LEAST_PX = 2.0
_LEAST_COSINE = 0.2  # further out a shading is not to be divided by
_REACHED = 1e-3  # weight of a neighbourhood that tells anything
_FLOOR = 1e-3


def albedo(maps: SurfaceMaps, cues: Cues, ior: float) -> SurfaceMaps:
    """The maps with the albedo of highlights taken from the crossed shot; as they are without one.

    Parameters
    ----------
    maps
        Of either estimator.
    cues
        Their `body` is used where `body_known`.
    ior
        Refractive index of the shading.
    """
    if cues.body is None or cues.body_known is None:
        return maps
    gloss = mirrored_share(cues)
    low, high = _GLOSS
    share = np.clip((gloss - low) / (high - low), 0, 1) * cues.body_known  # of the crossed shot in the answer
    share = cv2.GaussianBlur(share.astype(np.float32), (0, 0), 1.0) * cues.body_known
    cosine = np.clip(frames.dot(maps.normal, cues.rays), _LEAST_COSINE, 1)
    shading = cosine * fresnel.transmission(cosine, ior)[0] * fresnel.transmission(1.0, ior)[0]
    own = np.log(np.maximum(cues.body, _FLOOR)) - np.log(shading)[..., None]
    seen = np.log(np.maximum(maps.diffuse, _FLOOR))
    matt = ((share < 0.5) & cues.body_known & (maps.diffuse.min(-1) > _FLOOR)).astype(np.float32)
    radius = max(_AROUND * float(np.sqrt(cues.mask.sum() / np.pi)), _LEAST_PX)
    carried = _carried((seen - own) * matt[..., None], matt, radius)
    mended = np.exp(own + carried)
    diffuse = np.where(share[..., None] > 0, maps.diffuse + share[..., None] * (mended - maps.diffuse), maps.diffuse)
    return replace(maps, diffuse=(np.clip(diffuse, 0, 1) * cues.mask[..., None]).astype(np.float32))


def mirrored_share(cues: Cues) -> Floats:
    """Share of S0 that the surface mirrors, (H, W); 0 where no crossed shot tells. Clipped light counts as mirrored."""
    assert cues.body is not None and cues.body_known is not None
    whole = np.maximum(cues.radiance.sum(-1), 1e-6)
    share = np.clip(1 - cues.body.sum(-1) / whole, 0, 1)
    return np.where(cues.body_known & cues.mask, share, 0).astype(np.float32)


def _carried(weighted: Floats, weight: Floats, radius: float) -> Floats:
    """Mean (H, W, 3) over ever wider surroundings, the narrowest that tell; 0 where none does."""
    out = np.zeros_like(weighted, np.float32)
    left = np.ones(weight.shape, bool)
    while left.any() and radius < 2 * max(weight.shape):
        around = cv2.GaussianBlur(weight, (0, 0), radius)
        mean = cv2.GaussianBlur(weighted.astype(np.float32), (0, 0), radius) / np.maximum(around, 1e-9)[..., None]
        reached = left & (around > _REACHED)
        out[reached] = mean[reached]
        left, radius = left & ~reached, 2 * radius
    return out
