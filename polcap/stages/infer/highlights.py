"""Highlights: the albedo under them, and the gloss that they show.

**Albedo.** Clipped highlights are filled. A cross-polarized shot shows the diffuse reflection under a highlight.
Outside highlights, the ratio of the estimated albedo to this reflection gives the shading that the estimator assumed.
It is divided by the shading of the normals, continued smoothly into the highlight, and used there to turn the diffuse
reflection into an albedo.

**Gloss.** The network's roughness follows prints and highlights, but few materials make most objects, and a print
changes albedo, not gloss. Pixels of like roughness, and perhaps of like albedo, are taken for one material. Its
roughness √α is the mean of the network's, unless one of its highlights is too bright for that. Under a flash at the
lens, in units of a white plane that faces it, the mirrored light is

    S ≤ F0 / (4 α²)

and reaches this limit where the surface faces the lens. So the brightest highlight bounds the roughness from above.
Mirrored light is what S0 has beyond the albedo, and therefore less certain on a bright material.

A material must show parts that may mirror the flash, and parts that cannot. Otherwise a broad highlight looks like a
bright albedo, and the network's roughness is combined with that of usual materials.

**Expected error of the roughness.** It is common to a material. It is greater if no highlight confirms the network, if
the highlight is clipped, and if the network expects large errors of the normals.
"""

from dataclasses import replace
from math import hypot, sqrt

import cv2
import numpy as np

from polcap.image_values import Bools, Floats, Quality
from polcap.optics import clusters, color, frames, fresnel
from polcap.optics.morphology import dilate, masked_mean
from polcap.optics.outline import disc_radius
from polcap.stage_values import Cues, SurfaceMaps

LEAST_KNOWN = 0.05  # least weight of the known pixels under a filter, for a mean of them
# specular share of S0: below the first the estimator's albedo counts, above the second that of the crossed shot
_SPECULAR_SHARES = (0.03, 0.1)
_AROUND = 0.05  # 1σ of the continuation, over the object's radius
_LEAST_PX = 2.0
_LEAST_COSINE = 0.2  # of the shading that divides
_LEAST_MATTE = 1e-3  # least share of matte pixels in a neighborhood
_FLOOR = 1e-3  # albedo

_MOST_MATERIALS = 4
_COLOR_WEIGHT = 0.1  # weight of the encoded albedo, relative to the roughness
_MOST_SPREAD = 0.06  # rms distance from the mean of a material: a larger one asks for one more material
_BLUR = 0.004  # 1σ over the object's radius, of S0 before the brightest pixel is taken
_LEAST_BLUR_PX = 0.7
_LEAST_HIGHLIGHT = 1e-6
_HIGHLIGHT_RANK = 3  # the third brightest pixel counts as the highlight
_FACING_DEG = 35.0  # greatest zenith angle of a highlight
_AWAY_DEG = (25.0, 60.0)  # zenith angles without highlight; what S0 has there beyond the albedo is its error
_AWAY_QUANTILE = 0.99
_FEWEST_PX, _FEWEST_AWAY = 50, 0.2  # least number of facing and of leaning pixels; least share of leaning ones
# measured on path-traced pictures (docs/benchmarks/network.md)
_ALBEDO_SIGMA = 0.2  # relative error of the albedo under a highlight
_NETWORK_SIGMA = 0.08  # error of the network's roughness
_BOUND_SIGMA = 0.06  # relative error of the bound without that of the mirrored light: F0, and highlights below a pixel
# 1σ of a pooled roughness by simulated captures (docs/benchmarks/albedo.md), added in squares
_SIGMA = 0.06
_SIGMA_PER_DEGREE = 0.006  # of the material's mean expected normal error
_SIGMA_UNCONFIRMED = 0.15  # without a highlight, or with a clipped one
_USUAL, _USUAL_SIGMA = 0.5, 0.2  # mean roughness of 47 materials, and its standard deviation
# median F0 of training surfaces by the predicted F0, if a twentieth of them has more than .06: the network learned from
# more coatings and gems than people own
_PREDICTED_F0 = (0.03, 0.04, 0.05, 0.06, 0.08, 0.105, 0.16, 1.0)
_MEDIAN_F0 = (0.039, 0.0415, 0.0425, 0.0435, 0.046, 0.0556, 0.16, 1.0)


def fill(image: Floats, cues: Cues) -> Floats:
    """Fill clipped highlights of an image (H, W, 3) with means of the pixels around them; returns the filled image."""
    clipped = cues.mask & ((cues.quality & Quality.CLIPPED) > 0)
    hole = cues.mask & dilate(clipped, 1)
    known = cues.mask & ~hole
    out = np.array(image, np.float32)
    if hole.any() and known.any():
        around, far = mean_around(out, known, hole, blur=2.0, least=LEAST_KNOWN)
        out[hole] = around[hole]
        out[far] = out[known].mean(axis=0)
    return out


def mean_around(image: Floats, known: Bools, wanted: Bools, blur: float, least: float) -> tuple[Floats, Bools]:
    """Interpolate an image (H, W, 3) at wanted pixels (H, W), as Gaussian means of the known pixels (H, W) around each.

    The Gaussian starts at 1σ = `blur` px and doubles until known pixels have a share of `least` of its weight. Also
    returns the wanted pixels that no Gaussian reached, (H, W).
    """
    weight = known.astype(np.float32)
    weighted = (image * weight[..., None]).astype(np.float32)
    out, missing = np.zeros_like(weighted), wanted.copy()
    while missing.any() and blur < 2 * max(known.shape):
        share = cv2.GaussianBlur(weight, (0, 0), blur)
        mean = cv2.GaussianBlur(weighted, (0, 0), blur) / np.maximum(share, 1e-9)[..., None]
        reached = missing & (share > least)
        out[reached] = mean[reached]
        missing, blur = missing & ~reached, 2 * blur
    return out, missing


def correct(maps: SurfaceMaps, cues: Cues, ior: float) -> SurfaceMaps:
    """Correct the albedo of maps (H, W, …) in highlights by the cross-polarized shot, `cues.body`, if there is one."""
    if cues.body is None or cues.body_known is None:
        return maps
    low, high = _SPECULAR_SHARES
    specular = np.clip(1 - cues.body.sum(-1) / np.maximum(cues.radiance.sum(-1), 1e-6), 0, 1)  # share of S0
    share = np.clip((specular - low) / (high - low), 0, 1) * (cues.body_known & cues.mask)  # of that shot
    share = cv2.GaussianBlur(share.astype(np.float32), (0, 0), 1.0) * cues.body_known
    cosine = np.clip(frames.dot(maps.normal, cues.rays), _LEAST_COSINE, 1)
    shading = cosine * fresnel.transmission(cosine, ior)[0] * fresnel.transmission(1.0, ior)[0]
    by_shading = np.log(np.maximum(cues.body, _FLOOR)) - np.log(shading)[..., None]
    estimated = np.log(np.maximum(maps.diffuse, _FLOOR))
    matte = (share < 0.5) & cues.body_known & (maps.diffuse.min(-1) > _FLOOR)  # the estimator's albedo counts more
    reach = max(_AROUND * disc_radius(cues.mask), _LEAST_PX)
    continued, _ = mean_around(estimated - by_shading, matte, np.ones_like(matte), blur=reach, least=_LEAST_MATTE)
    corrected = np.exp(by_shading + continued)
    diffuse = np.where(share[..., None] > 0, maps.diffuse + share[..., None] * (corrected - maps.diffuse), maps.diffuse)
    return replace(maps, diffuse=(np.clip(diffuse, 0, 1) * cues.mask[..., None]).astype(np.float32))


def pool_gloss(maps: SurfaceMaps, cues: Cues) -> SurfaceMaps:
    """Replace roughness and F0 of a network's maps (H, W, …) by those of the materials, with soft borders.

    Also states the expected error of the roughness, 1σ.
    """
    if not maps.mask.any():
        return maps
    mask = maps.mask
    features = np.column_stack([_COLOR_WEIGHT * color.encode_srgb(maps.diffuse[mask]), maps.roughness[mask]])
    center, spread = _fewest_groups(features.astype(np.float32))
    share = clusters.soft_share(features, center, spread)  # (N, K)
    member = np.full(mask.shape, -1)
    member[mask] = share.argmax(axis=1)
    excess = (cues.radiance - maps.diffuse).mean(axis=-1)  # of S0 over the diffuse light of a surface facing the lens
    mirrored = masked_mean(excess, mask, max(_LEAST_BLUR_PX, _BLUR * disc_radius(mask)))
    zenith = np.degrees(np.arccos(np.clip(frames.dot(maps.normal, cues.rays), 0, 1)))
    weight = share / np.maximum(share.sum(axis=0), 1e-9)
    f0 = np.interp(weight.T @ maps.specular[mask].mean(axis=-1), _PREDICTED_F0, _MEDIAN_F0)
    roughness = weight.T @ maps.roughness[mask]
    sigma = np.hypot(_SIGMA, _SIGMA_PER_DEGREE * (weight.T @ maps.confidence[mask]))
    clipped = (cues.quality & np.uint8(Quality.CLIPPED)) > 0
    for k in range(len(center)):
        of_material = member == k
        highlight = _highlight(of_material, zenith, mirrored, maps.diffuse)
        if highlight is None:
            roughness[k], sigma[k] = _combine_with_usual(roughness[k], hypot(sigma[k], _SIGMA_UNCONFIRMED))
            continue
        light, error = highlight
        roughness[k] = _lower_to_bound(float(roughness[k]), float(f0[k]), light, error)
        if light <= error or (clipped & of_material & (zenith < _FACING_DEG)).sum() >= _HIGHLIGHT_RANK:
            sigma[k] = hypot(sigma[k], _SIGMA_UNCONFIRMED)
    pooled = np.zeros((3, *mask.shape), np.float32)
    pooled[:, mask] = [share @ by_material for by_material in (f0, roughness, sigma)]
    specular = np.repeat(pooled[0][..., None], 3, axis=-1)
    return replace(maps, specular=specular, roughness=pooled[1], roughness_error=pooled[2])


def _fewest_groups(features: Floats) -> tuple[Floats, float]:
    """Group pixels (N, 4): centers (K, 4) of the fewest groups with a small spread, at most 4, and that spread."""
    for count in range(1, _MOST_MATERIALS + 1):
        center, spread = clusters.color_clusters(features, count)
        if spread < _MOST_SPREAD:
            break
    return center, spread


def _combine_with_usual(roughness: float, sigma: float) -> tuple[float, float]:
    """Mean of a roughness with error `sigma` and that of usual materials, weighted by their errors, and its 1σ."""
    weight = _USUAL_SIGMA**2 / (_USUAL_SIGMA**2 + sigma**2)
    return _USUAL + weight * (roughness - _USUAL), sigma * sqrt(weight)


def _highlight(of_material: Bools, zenith: Floats, mirrored: Floats, albedo: Floats) -> tuple[float, float] | None:
    """Mirrored light of a material's highlight, and its 1σ; None if too few pixels face the lens or lean."""
    facing = of_material & (zenith < _FACING_DEG)
    away = of_material & (zenith > _AWAY_DEG[0]) & (zenith < _AWAY_DEG[1])
    if min(facing.sum(), away.sum()) < _FEWEST_PX or away.sum() < _FEWEST_AWAY * of_material.sum():
        return None
    highlight = float(np.partition(mirrored[facing], -_HIGHLIGHT_RANK)[-_HIGHLIGHT_RANK])
    error = hypot(np.quantile(mirrored[away], _AWAY_QUANTILE), _ALBEDO_SIGMA * albedo[facing].mean())
    return max(highlight, _LEAST_HIGHLIGHT), error


def _lower_to_bound(roughness: float, f0: float, highlight: float, error: float) -> float:
    """Lower a roughness towards the bound (F0 / 4 S)^¼ by the highlight S with 1σ `error`, weighted by both errors."""
    bound: float = (f0 / (4 * highlight)) ** 0.25
    sigma = bound * hypot(_BOUND_SIGMA, error / (4 * highlight))
    weight = _NETWORK_SIGMA**2 / (_NETWORK_SIGMA**2 + sigma**2)
    return roughness + weight * min(bound - roughness, 0.0)
