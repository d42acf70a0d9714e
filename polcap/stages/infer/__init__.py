"""Stage 8: surface normals and material of each pixel, from its cues.

    learned         estimate by the network, joined with the inversion
        sizes_and_positions   test-time augmentation of the network
        fine                  fine relief by a second network
    analytic        estimate without a network: inversion of polarization
        zenith                zenith angles by the object's law of diffuse polarization
    shape           corrections of normals by the shape of the whole object
    highlights      albedo under highlights; gloss of materials

Both estimators work in the frame of each view ray, where polarization depends on the surface alone, and return maps in
the camera frame. This module adds the error of the albedo's scale, and the albedo's detail at the RAW's pixels.
"""

from dataclasses import replace
from math import exp, hypot, inf, log, pi, sqrt
from typing import Annotated, Literal

import cv2
import msgspec
import numpy as np
from msgspec import Meta

from polcap.image_values import Floats, Quality
from polcap.optics import brdf, frames
from polcap.optics.morphology import erode, masked_mean
from polcap.optics.resize import area_mean
from polcap.stage_values import Cues, Network, RunNetwork, SurfaceMaps
from polcap.stages import stage
from polcap.stages.infer import analytic, highlights, learned

_MAPS_SIGMA = 0.05  # of the estimators' own albedos, with a correct scale (docs/benchmarks/gates.md)
# a chart with half of the object's light doubles the albedo, often beyond that of white things (the same page)
_WHITE, _WHITE_SPREAD = -0.2, 0.04  # ln of the greatest albedo of white things, and the width of this limit
_BRIGHTEST = 95  # percentile of the albedos that is compared with the limit
_LEANING = (0.5, 0.87)  # range of the cosines of the judged surfaces: they lean too far to show a highlight
_LN_DOUBLED, _ODDS_OF_DOUBLED = log(2), 0.01  # error of the scale by such a chart; one in a hundred is assumed
_BAND = 2.0  # px, 1σ: shading finer than this predicts the shading finer than a superpixel
_DETAIL_AROUND = 4.0  # px, 1σ of the means of power, and of the albedo
# factors on the power of each explanation of fine detail (docs/benchmarks/albedo.md)
_SHADING = 4.0  # on that of the normals' shading
_UNCERTAIN = 0.3  # on that of shading by the normals' expected error, most of which is coarser
_NOISE = 4.0  # on the variance of S0: the detail comes from one shot, and one photosite a color
_GRAZING = 0.1  # least cosine of the shading
_DARKEST = 0.02  # least albedo and least roughness² of the shading
_EDGE_PX = 2  # around the outline and around defects, where the light mixes
_DEFECTS = Quality.CLIPPED | Quality.OUTSIDE | Quality.GHOST


class InferSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the stage `infer`, the section `infer` of a settings file."""

    ior: Annotated[float, Meta(ge=1.2, le=2.5, description="refractive index assumed by the analytic estimator")] = 1.5
    symmetries: Annotated[
        Literal[1, 2, 4, 8], Meta(description="number of turned and mirrored positions that the network sees")
    ] = 4
    fine: Annotated[bool, Meta(description="a second network adds relief finer than the pixels of the first")] = True


@stage(version=44)
def estimate(cues: Cues, network: Network | None, run: RunNetwork, settings: InferSettings) -> SurfaceMaps:
    """Estimate normal, diffuse, specular, roughness and expected error from cues; without a network by inversion.

    Raises ModelError: the network was made for other channels.
    """
    if network is None:
        maps = analytic.estimate(cues, settings.ior)
    else:
        maps = learned.estimate(cues, network, run, settings.ior, settings.symmetries, fine_pass=settings.fine)
    maps = highlights.correct(maps, cues, settings.ior)
    return replace(
        maps,
        albedo_sigma=None if cues.scale_sigma is None else _scale_error(cues, maps, cues.scale_sigma),
        detail=None if cues.detail is None else _select_detail(cues.detail, cues, maps),
    )


def _scale_error(cues: Cues, maps: SurfaceMaps, sigma: float) -> float:
    """Relative error (1σ) of the scale of all albedos: `sigma` of the chart's light, and the risk that it is doubled.

    A chart behind the object, or in a shadow, gets less light than the object. The only sign is an albedo above that of
    white things. So the 95th percentile of the albedo S0/√cos θ, reduced by `sigma`, is compared with theirs.
    """
    cosine = frames.dot(maps.normal, cues.rays)
    leaning = cues.mask & (cues.quality == 0) & (cosine > _LEANING[0]) & (cosine < _LEANING[1])
    albedo = cues.radiance[leaning].max(axis=-1) / np.sqrt(cosine[leaning])
    log_albedo = log(max(float(np.percentile(albedo, _BRIGHTEST)), 1e-6)) - sigma if len(albedo) else -inf
    odds = _ODDS_OF_DOUBLED * (1 + exp((log_albedo - _WHITE) / _WHITE_SPREAD))  # that the scale is doubled
    return hypot(sigma, _MAPS_SIGMA, _LN_DOUBLED * sqrt(odds / (1 + odds)))


def _select_detail(detail: Floats, cues: Cues, maps: SurfaceMaps) -> Floats:
    """Select the part of the RAW's fine detail that belongs to the albedo, by a Wiener filter; (2H, 2W) float16.

    `detail` (2H, 2W) is the logarithm of light of RAW pixels over that of superpixels (H, W): prints and fine relief
    alike. Each pixel is multiplied by the share of the local power that neither shading nor noise explains. Relief
    continues from scale to scale, so the shading of the normals shows how strong finer shading may be.
    """
    solid = cues.mask & ((cues.quality & np.uint8(_DEFECTS)) == 0)
    inside = erode(solid, _EDGE_PX, from_border=True)
    height, width = inside.shape
    explained = masked_mean(_power_of_shading(cues, maps) + _NOISE * cues.ratio_sigma**2, cues.mask, _DETAIL_AROUND)
    power = masked_mean(area_mean(np.square(detail, dtype=np.float32), (height, width)), inside, _DETAIL_AROUND)
    share = np.clip(1 - explained / np.maximum(power, 1e-9), 0, 1) * inside
    selected = cv2.resize(share.astype(np.float32), (2 * width, 2 * height))
    selected *= detail
    return np.asarray(selected, np.float16)


def _power_of_shading(cues: Cues, maps: SurfaceMaps) -> Floats:
    """Squared logarithm (H, W) of the fine shading of the normals, plus that which their expected error may cause."""
    albedo = np.maximum(masked_mean(maps.diffuse.mean(axis=-1), cues.mask, _DETAIL_AROUND), _DARKEST)
    f0, alpha = maps.specular.mean(axis=-1), np.maximum(maps.roughness**2, _DARKEST)

    def log_light(zenith: Floats) -> Floats:
        """Logarithm (H, W) of the light of surfaces at a zenith angle, with the flash at the lens."""
        c = np.maximum(np.cos(zenith), _GRAZING)
        mirrored = pi * brdf.ggx_distribution(c, alpha) * brdf.smith_masking(c, c, alpha) / (4 * c)
        return np.asarray(np.log(albedo * c + f0 * mirrored), np.float32)

    zenith = np.arccos(np.clip(frames.dot(maps.normal, cues.rays), 0, 1))
    error = np.radians(maps.confidence)
    light = log_light(zenith)
    fine = light - masked_mean(light, cues.mask, _BAND)
    by_error = (log_light(np.maximum(zenith - error, 0)) - log_light(zenith + error)) / 2  # change for 1σ
    return np.asarray(_SHADING * fine**2 + _UNCERTAIN * by_error**2)
