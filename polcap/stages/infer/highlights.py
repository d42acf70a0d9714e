"""Albedo in highlights: fills clipped ones, and corrects all of them by a cross-polarized shot, if any.

A cross-polarized shot shows the diffuse reflection under a highlight. Outside highlights, the ratio of the estimated
albedo to this reflection gives the shading that the estimator assumed. It is divided by the shading of the normals,
continued smoothly into the highlight, and used there to turn the diffuse reflection into an albedo.
"""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats, Quality
from polcap.optics import frames, fresnel
from polcap.optics.morphology import dilate
from polcap.optics.outline import disc_radius
from polcap.stage_values import Cues, SurfaceMaps

REACHED = 0.05  # least share of known pixels under a Gaussian for a mean
# specular share of S0: below the first the estimator's albedo is used, above the second that of the crossed shot
_GLOSS = (0.03, 0.1)
_AROUND = 0.05  # 1σ of the continuation, over the object's radius
_LEAST_PX = 2.0
_LEAST_COSINE = 0.2  # of the shading that divides
_LEAST_MATTE = 1e-3  # share of matte pixels in a neighborhood
_FLOOR = 1e-3  # albedo


def fill(image: Floats, cues: Cues) -> Floats:
    """Fill clipped highlights of an image (H, W, 3) with means of the pixels around them; returns the filled image."""
    clipped = cues.mask & ((cues.quality & Quality.CLIPPED) > 0)
    hole = cues.mask & dilate(clipped, 1)
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
    """Interpolate an image (H, W, 3) at wanted pixels (H, W), as Gaussian means of the known pixels (H, W) around each.

    The Gaussian starts at 1σ = `blur` px and doubles until known pixels have a share of `least` of its weight. Also
    returns the wanted pixels that no Gaussian reached, (H, W).
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


def correct(maps: SurfaceMaps, cues: Cues, ior: float) -> SurfaceMaps:
    """Correct the albedo of maps (H, W, …) in highlights by the cross-polarized shot, `cues.body`, if there is one."""
    if cues.body is None or cues.body_known is None:
        return maps
    low, high = _GLOSS
    share = np.clip((_specular_share(cues) - low) / (high - low), 0, 1) * cues.body_known  # of the crossed shot
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


def _specular_share(cues: Cues) -> Floats:
    """Specular share of S0, (H, W), from the cross-polarized shot; 0 where that shot is not valid."""
    assert cues.body is not None and cues.body_known is not None
    share = np.clip(1 - cues.body.sum(-1) / np.maximum(cues.radiance.sum(-1), 1e-6), 0, 1)
    return np.where(cues.body_known & cues.mask, share, 0).astype(np.float32)
