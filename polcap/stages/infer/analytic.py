"""Analytic estimator: zenith from the DoLP, azimuth from the AoLP, gloss from the highlight.

Gives normals with their expected error, an albedo map, and one roughness and one F0 for the object.
"""

import cv2
import numpy as np

from polcap.image_values import Floats, Quality
from polcap.optics import brdf, frames, fresnel
from polcap.stage_values import Cues, SurfaceMaps
from polcap.stages.infer import highlights
from polcap.stages.infer.shape import half_turns, integrable_normals
from polcap.stages.infer.zenith import ZenithEstimate, estimate_zenith

_BLURS_PX = (0.7, 1.0, 1.5, 2.2, 3.3, 5.0)  # in steps of 1.5, in which noise falls by a third
_SAME = 2.0  # σ by which two means of the same value may differ: 95 %
_MODEL_ERROR_DEG = 4.0  # interreflection, highlights, unknown index: measured on path-traced objects
_DOUBTFUL_DEG = 15.0  # added where the quality shows that the model fails
_HIGHLIGHT = 0.12  # greatest width of a highlight, over the side of a square as large as the object
_LEAST_COSINE = 0.2  # of the shading that divides


def estimate(cues: Cues, ior: float) -> SurfaceMaps:
    """Estimate the maps (H, W, …) of an object without a network, by inversion of its polarization.

    Normals come from DoLP and AoLP; albedo, roughness and F0 from the separation of highlights. `ior` is the assumed
    refractive index.
    """
    normal, error, cos_zenith = invert(cues, ior)
    normal = integrable_normals.make_integrable(normal, error, cues.mask, cues.rays)
    diffuse, highlight = _albedo(cues, cos_zenith, ior)
    roughness, specular = _gloss(highlight, cos_zenith, cues)
    shape = cues.mask.shape
    return SurfaceMaps(
        normal=(normal * cues.mask[..., None]).astype(np.float32),
        diffuse=diffuse,
        specular=np.full((*shape, 3), specular, np.float32) * cues.mask[..., None],
        roughness=np.full(shape, roughness, np.float32) * cues.mask,
        depth_prior=None,
        confidence=error,
        mask=cues.mask,
        view=cues.view,
        estimator="analytic",
    )


def invert(cues: Cues, ior: float, guide: tuple[Floats, Floats] | None = None) -> tuple[Floats, Floats, Floats]:
    """Invert polarization to normals (H, W, 3), camera frame: zenith from the DoLP, azimuth from the AoLP.

    `guide` are the normals (H, W, 3) of another estimator in the frame of each ray, and their expected error (H, W) in
    degrees. They decide the 180° ambiguity of the azimuth; without a guide, `half_turns` decides it. Also returns the
    expected error (H, W) in degrees and the cosines of the zenith (H, W).
    """
    ratio, sigma = _adaptive_mean(cues)
    squared = ratio[0] ** 2 + ratio[1] ** 2
    dolp = np.sqrt(np.maximum(squared - sigma**2, 0))
    zenith_guide = None
    if guide is not None:
        zenith_guide = np.arccos(np.clip(guide[0][..., 2], 0, 1)), np.radians(guide[1])
    zenith = estimate_zenith(dolp, cues, ior, zenith_guide)
    cos_zenith = np.cos(zenith.angle)
    axis = ratio / np.sqrt(squared + 1e-12)
    if guide is None:
        phi = np.arctan2(axis[1], axis[0]) / 2
        found = half_turns.resolve(_normals_on_rays(cos_zenith, phi, cues.rays), cues.mask)
        phi, certainty = np.where(found.turned, phi + np.pi, phi), 1 - 2 * found.doubt
    else:
        phi, certainty = _azimuth_by_guide(axis, cues.rays, *guide)
    normal = frames.from_ray_frame(_normals_on_rays(cos_zenith, phi, cues.rays), cues.rays)
    return np.asarray(normal), _expected_error(zenith, dolp, sigma, certainty, cues), cos_zenith


def _adaptive_mean(cues: Cues) -> tuple[Floats, Floats]:
    """Denoise S1/S0 and S2/S0 (2, H, W) by means over areas where they are constant within noise; also 1σ (H, W).

    Each pixel takes the widest Gaussian mean that differs from no narrower one by more than noise explains (Lepski's
    rule), so creases stay and noise in flat parts goes. S1, S2 and S0 are averaged, never the angle. A Gaussian of
    s px divides white noise by √(4π) s.

    References
    ----------
    Lepski, Mammen & Spokoiny, Optimal spatial adaptation, Annals of Statistics 1997.
    """
    light = (np.maximum(frames.total(cues.radiance), 1e-6) * cues.mask).astype(np.float32)
    narrower: list[tuple[Floats, Floats]] = []
    ratio, sigma = cues.ratio, cues.ratio_sigma
    weighted, weighted_sigma = ((image * light).astype(np.float32) for image in (ratio, sigma))
    constant = cues.mask  # pixels whose means so far agree
    for blur in _BLURS_PX:
        weight = cv2.GaussianBlur(light, (0, 0), blur) + np.float32(1e-9)
        mean = np.stack([cv2.GaussianBlur(part, (0, 0), blur) / weight for part in weighted])
        noise = cv2.GaussianBlur(weighted_sigma, (0, 0), blur) / weight / np.float32(np.sqrt(4 * np.pi) * blur)
        for other, squared_limit in narrower:
            change = mean - other
            constant = constant & (change[0] ** 2 + change[1] ** 2 < squared_limit)
        ratio, sigma = np.where(constant, mean, ratio), np.where(constant, noise, sigma)
        narrower.append((mean, (_SAME * noise) ** 2))
    return ratio, sigma


def _azimuth_by_guide(axis: Floats, rays: Floats, normal: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    """Azimuths φ (H, W) rad from axes (cos 2φ, sin 2φ), with the 180° ambiguity solved by a guide's normals.

    Also returns the certainty (H, W) of this choice, P(right side) − P(wrong side), for a guide with Gaussian errors of
    1σ = `sigma` (H, W) degrees.
    """
    from scipy.special import erf  # here: importing it costs .2 s of every start

    phi = np.arctan2(axis[1], axis[0]) / 2
    azimuth = frames.axis_on_ray(phi, rays)
    agreement = normal[..., 0] * np.cos(azimuth) + normal[..., 1] * np.sin(azimuth)
    spread = np.radians(np.maximum(sigma, 1.0))  # at least 1°
    return np.where(agreement < 0, phi + np.pi, phi), np.asarray(erf(np.abs(agreement) / (np.sqrt(2) * spread)))


def _normals_on_rays(cos_zenith: Floats, phi: Floats, rays: Floats) -> Floats:
    """Unit normals (H, W, 3) in the frame of each ray, from cosines of the zenith and azimuths φ (H, W)."""
    x, y = frames.axis_across(phi, rays)
    scale = np.sqrt(np.maximum(1 - cos_zenith**2, 0) / (x * x + y * y))  # to the length sin θ
    return np.stack([scale * x, scale * y, cos_zenith], axis=-1)


def _expected_error(zenith: ZenithEstimate, dolp: Floats, sigma: Floats, certainty: Floats, cues: Cues) -> Floats:
    """Expected normal error (H, W), degrees.

    Its terms are noise, the choice of the diffuse law, model error, the 180° ambiguity, and 15° at pixels whose quality
    flags show that the model fails. A normal on the wrong side is off by 2θ, with the probability (1 − certainty)/2.
    """
    step = np.maximum(sigma, 1e-5)
    low, high = (zenith.at(np.maximum(dolp + s * step, 0)) for s in (-1, 1))
    zenith_error = np.hypot((high - low) / 2, zenith.spread)
    aolp_error = np.minimum(sigma / (2 * np.maximum(dolp, 1e-5)), np.pi / 4)  # the mean error of a random axis is π/4
    azimuth_error = np.sin(zenith.angle) * aolp_error
    flip = (1 - certainty) / 2 * 2 * zenith.angle
    noise = np.degrees(np.hypot(zenith_error, azimuth_error))
    doubtful = (cues.quality & (Quality.ILL_POSED | Quality.METAL | Quality.OUTSIDE | Quality.CLIPPED)) > 0
    error = np.hypot(noise, _MODEL_ERROR_DEG) + np.degrees(flip) + np.where(doubtful, _DOUBTFUL_DEG, 0.0)
    return np.asarray(np.where(cues.mask, error, 0), dtype=np.float32)


def _albedo(cues: Cues, cos_zenith: Floats, ior: float) -> tuple[Floats, Floats]:
    """Separate diffuse albedo (H, W, 3) and the radiance of the highlight (H, W).

    A highlight is white, small, and faces the camera. So it is the part of the darkest channel that a grey-scale
    opening removes, where the zenith is under 35°. The rest of the radiance, divided by cos θ T₊(θ) T₊(0), is the
    albedo. The cosine has a lower limit, because reflected room light brightens the outline.
    """
    size = max(5, round(_HIGHLIGHT * np.sqrt(max(cues.mask.sum(), 1)))) | 1  # px, odd
    radiance = highlights.fill(cues.radiance, cues) / cues.rays[..., 2:] ** 2  # off the axis the flash is farther
    darkest = cv2.GaussianBlur(radiance.min(-1), (0, 0), 1.0)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    opened = cv2.GaussianBlur(cv2.morphologyEx(darkest, cv2.MORPH_OPEN, kernel), (0, 0), size / 6)
    facing = np.clip((cos_zenith - np.cos(np.radians(35))) / 0.1, 0, 1)  # soft limit
    highlight = np.maximum(darkest - opened, 0) * facing * cues.mask
    plus, _ = fresnel.transmission(np.maximum(cos_zenith, _LEAST_COSINE), ior)
    shading = np.maximum(cos_zenith, _LEAST_COSINE) * plus * fresnel.transmission(1.0, ior)[0]
    diffuse = (radiance - highlight[..., None]) / shading[..., None]
    return (np.clip(diffuse, 0, 1) * cues.mask[..., None]).astype(np.float32), highlight.astype(np.float32)


def _gloss(highlight: Floats, cos_zenith: Floats, cues: Cues) -> tuple[float, float]:
    """Fit one roughness and one F0 for the object: those of the GGX lobe that fits the highlight (H, W) best.

    The highlight is averaged in bins of 3° of the zenith. Without a clear highlight the result is that of a common
    dielectric, (0.5, 0.04).
    """
    roughness, f0 = 0.5, 0.04
    usable = cues.mask & ((cues.quality & Quality.CLIPPED) == 0) & (cos_zenith > np.cos(np.radians(45)))
    if usable.sum() < 200 or np.quantile(highlight[usable], 0.99) < 0.02:  # no clear highlight
        return roughness, f0
    edges = np.cos(np.radians(np.arange(45, -1, -3)))
    seen = usable & (cos_zenith < 1)  # where it is 1, the DoLP is below its noise
    count, _ = np.histogram(cos_zenith[seen], edges)
    light = np.histogram(cos_zenith[seen], edges, weights=highlight[seen])[0] / np.maximum(count, 1)
    c = (edges[:-1] + edges[1:]) / 2
    weight = np.sqrt(count)
    best = np.inf
    for candidate in np.linspace(0.15, 0.8, 27):  # roughness
        alpha = candidate**2
        lobe = np.pi * brdf.ggx_distribution(c, alpha) * brdf.smith_masking(c, c, alpha) / (4 * c)
        scale = float((weight * lobe * light).sum() / (weight * lobe**2).sum())
        misfit = float((weight * (light - scale * lobe) ** 2).sum())
        if misfit < best:
            best, roughness, f0 = misfit, float(candidate), float(np.clip(scale, 0.02, 0.12))
    return roughness, f0
