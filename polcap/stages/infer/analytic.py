"""The analytic estimator: zenith from the DoLP, azimuth from the AoLP, gloss from the highlight.

In: cues. Out: normals, albedo, one roughness and one F0, and the normals' expected error.
"""

from functools import partial

import cv2
import numpy as np

from polcap import parallel
from polcap.images import Cues, Floats, Quality, SurfaceMaps
from polcap.optics import brdf, frames, fresnel
from polcap.stages.infer import half_turns
from polcap.stages.infer.zenith import ZenithEstimate, candidate_laws, estimate_zenith

_BLURS_PX = (0.7, 1.0, 1.5, 2.2, 3.3, 5.0)  # in steps of 1.5, in which noise falls by a third
_SAME = 2.0  # standard deviations that two averages of the same thing may differ by: 95 %
REACHED = 0.05  # share of known pixels under a Gaussian from which a mean is taken
_MODEL_ERROR_DEG = 4.0  # interreflection, highlights, unknown index: measured on path-traced objects


def estimate(cues: Cues, ior: float) -> SurfaceMaps:
    """Normals by the inversion; albedo and gloss as the highlights have them."""
    normal, error, cos_zenith = invert(cues, ior)
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


def prepare(cues: Cues, ior: float) -> tuple[Floats, Floats]:
    """S1/S0 and S2/S0 (2, H, W) averaged, and their 1σ (H, W): what `invert` needs before it has a guide."""
    candidate_laws(ior)  # cached from here on
    return _smoothed(cues)


def invert(
    cues: Cues,
    ior: float,
    guide: tuple[Floats, Floats] | None = None,
    prepared: tuple[Floats, Floats] | None = None,
) -> tuple[Floats, Floats, Floats]:
    """Normals (H, W, 3), their expected error (H, W) in degrees and cosines of the zenith (H, W).

    Zenith by the DoLP and the law of the body that the cues speak for (`zenith.py`).

    Parameters
    ----------
    cues
        Of the object's crop (H, W).
    ior
        Refractive index.
    guide
        Normals (H, W, 3) in the frame of each ray and their expected error (H, W), degrees, by which the half-turn of
        the azimuth is chosen; without it by `half_turns.py`.
    prepared
        What `prepare` gives, where that is known.
    """
    ratio, sigma = prepared or prepare(cues, ior)
    squared = ratio[0] ** 2 + ratio[1] ** 2
    dolp = np.sqrt(np.maximum(squared - sigma**2, 0))
    known = None
    if guide is not None:
        known = np.arccos(np.clip(guide[0][..., 2], 0, 1)), np.radians(guide[1])
    read = estimate_zenith(dolp, cues, ior, known)
    zenith = read.angle
    cos_zenith = np.cos(zenith)
    axis = ratio / np.sqrt(squared + 1e-12)
    if guide is None:
        phi = np.arctan2(axis[1], axis[0]) / 2
        found = half_turns.resolve(_local(cos_zenith, phi, cues.rays), cues.mask)
        phi, certainty = phi + np.where(found.turned, np.pi, 0.0), 1 - 2 * found.doubt
    else:
        phi, certainty = _guided(axis, cues.rays, *guide)
    error, local = parallel.both(
        partial(_expected_error, read, dolp, sigma, certainty, cues), partial(_local, cos_zenith, phi, cues.rays)
    )
    return np.asarray(frames.from_ray_frame(local, cues.rays)), error, cos_zenith


def _guided(axis: Floats, rays: Floats, normal: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    """Azimuth (H, W) rad of axes (cos 2φ, sin 2φ) on the side of a known normal, and the half-turn's certainty.

    The normal's error is taken as Gaussian across the axis; certainty is P(right side) − P(wrong side).
    """
    from scipy.special import erf  # here: importing it costs .2 s of every start

    phi = np.arctan2(axis[1], axis[0]) / 2
    turned = frames.axis_on_ray(phi, rays)
    along = normal[..., 0] * np.cos(turned) + normal[..., 1] * np.sin(turned)
    spread = np.radians(np.maximum(sigma, 1.0))
    return phi + np.where(along < 0, np.pi, 0.0), np.asarray(erf(np.abs(along) / (np.sqrt(2) * spread)))


def _smoothed(cues: Cues) -> tuple[Floats, Floats]:
    """S1/S0 and S2/S0 averaged, light-weighted, as widely as they stay the same within their noise; and 1σ.

    Each pixel takes the widest Gaussian whose average differs from no narrower one's by more than its
    noise explains (Lepski's rule), so creases stay and flat noise goes. S1, S2 and S0 are averaged, never
    the angle. A Gaussian of s px divides white noise by √(4π) s.

    References
    ----------
    Lepski, Mammen, Spokoiny, Optimal spatial adaptation, Annals of Statistics 1997.
    """
    light = (np.maximum(frames.total(cues.radiance), 1e-6) * cues.mask).astype(np.float32)
    kept: list[tuple[Floats, Floats]] = []
    ratio, sigma = cues.ratio, cues.ratio_sigma
    weighted, weighted_sigma = ((image * light).astype(np.float32) for image in (ratio, sigma))
    growing = cues.mask
    for blur in _BLURS_PX:
        weight = cv2.GaussianBlur(light, (0, 0), blur) + np.float32(1e-9)
        wider = np.stack([cv2.GaussianBlur(part, (0, 0), blur) / weight for part in weighted])
        spread = cv2.GaussianBlur(weighted_sigma, (0, 0), blur) / weight / np.float32(np.sqrt(4 * np.pi) * blur)
        for narrower, limit in kept:
            moved = wider - narrower
            growing = growing & (moved[0] ** 2 + moved[1] ** 2 < limit)
        ratio, sigma = np.where(growing, wider, ratio), np.where(growing, spread, sigma)
        kept.append((wider, (_SAME * spread) ** 2))
    return ratio, sigma


def _local(cos_zenith: Floats, phi: Floats, rays: Floats) -> Floats:
    """Unit normals (H, W, 3) in the frame of each ray from zenith and image azimuth about it."""
    x, y = frames.axis_across(phi, rays)
    share = np.sqrt(np.maximum(1 - cos_zenith**2, 0) / (x * x + y * y))
    return np.stack([share * x, share * y, cos_zenith], axis=-1)


def _albedo(cues: Cues, cos_zenith: Floats, ior: float) -> tuple[Floats, Floats]:
    """Diffuse albedo (H, W, 3) and the highlight's radiance (H, W).

    A highlight is white, small, and faces the camera: what a grey-scale opening of the darkest channel
    removes where the zenith is under 35°. The rest over cos θ T₊(θ) T₊(0) is the albedo: light from around makes
    up for some of what the limb lets through less; off the axis, light comes farther.
    """
    size = max(5, round(0.12 * np.sqrt(max(cues.mask.sum(), 1)))) | 1
    radiance = fill_highlights(cues.radiance, cues) / cues.rays[..., 2:] ** 2
    darkest = cv2.GaussianBlur(radiance.min(-1), (0, 0), 1.0)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    opened = cv2.GaussianBlur(cv2.morphologyEx(darkest, cv2.MORPH_OPEN, kernel), (0, 0), size / 6)
    facing = np.clip((cos_zenith - np.cos(np.radians(35))) / 0.1, 0, 1)
    highlight = np.maximum(darkest - opened, 0) * facing * cues.mask
    plus, _ = fresnel.transmission(np.maximum(cos_zenith, 0.2), ior)
    shading = np.maximum(cos_zenith, 0.2) * plus * fresnel.transmission(1.0, ior)[0]
    diffuse = (radiance - highlight[..., None]) / shading[..., None]
    return (np.clip(diffuse, 0, 1) * cues.mask[..., None]).astype(np.float32), highlight.astype(np.float32)


def fill_highlights(image: Floats, cues: Cues) -> Floats:
    """An image (H, W, 3) that goes on from around into highlights which saturate the shortest exposure.

    A hole that nothing known reaches across the whole picture takes the mean of what is known.
    """
    clipped = cues.mask & ((cues.quality & Quality.CLIPPED) > 0)
    hole = cues.mask & (cv2.dilate(clipped.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    known = cues.mask & ~hole
    out, blur = np.array(image, np.float32), 2.0
    while hole.any() and known.any():
        if blur > max(hole.shape):
            out[hole] = out[known].mean(axis=0)
            break
        share = cv2.GaussianBlur(known.astype(np.float32), (0, 0), blur)
        mean = cv2.GaussianBlur(out * known[..., None], (0, 0), blur) / np.maximum(share, 1e-6)[..., None]
        reached = hole & (share > REACHED)
        out[reached] = mean[reached]
        hole, blur = hole & ~reached, 2 * blur
    return out


def _gloss(highlight: Floats, cos_zenith: Floats, cues: Cues) -> tuple[float, float]:
    """One roughness and one F0 for the object: the GGX lobe that best draws the highlight against the zenith.

    A common dielectric (0.5, 0.04) where there is no highlight to speak of.
    """
    roughness, f0 = 0.5, 0.04
    usable = cues.mask & ((cues.quality & Quality.CLIPPED) == 0) & (cos_zenith > np.cos(np.radians(45)))
    if usable.sum() < 200 or np.quantile(highlight[usable], 0.99) < 0.02:
        return roughness, f0
    edges = np.cos(np.radians(np.arange(0, 46, 3)))
    which = np.digitize(cos_zenith[usable], edges)
    count = np.bincount(which, minlength=len(edges) + 1)[1 : len(edges)]
    if not count.any():
        return roughness, f0
    light = np.bincount(which, highlight[usable], len(edges) + 1)[1 : len(edges)] / np.maximum(count, 1)
    c = (edges[:-1] + edges[1:]) / 2
    weight = np.sqrt(count)
    best = np.inf
    for candidate in np.linspace(0.15, 0.8, 27):
        alpha = candidate**2
        lobe = np.pi * brdf.ggx_distribution(c, alpha) * brdf.smith_masking(c, c, alpha) / (4 * c)
        scale = float((weight * lobe * light).sum() / (weight * lobe**2).sum())
        misfit = float((weight * (light - scale * lobe) ** 2).sum())
        if misfit < best:
            best, roughness, f0 = misfit, float(candidate), float(np.clip(scale, 0.02, 0.12))
    return roughness, f0


def _expected_error(read: ZenithEstimate, dolp: Floats, sigma: Floats, certainty: Floats, cues: Cues) -> Floats:
    """Expected normal error (H, W), degrees: noise through the inversion, doubts of half-turn and law, the model's.

    A wrong half-turn costs 2θ and happens with probability (1 − certainty)/2.
    """
    step = np.maximum(sigma, 1e-5)
    zenith = read.angle
    low, high = (read.at(np.maximum(dolp + s * step, 0)) for s in (-1, 1))
    zenith_error = np.hypot((high - low) / 2, read.spread)
    azimuth_error = np.sin(zenith) * np.minimum(sigma / (2 * np.maximum(dolp, 1e-5)), np.pi / 4)
    flip = (1 - certainty) / 2 * 2 * zenith
    noise = np.degrees(np.hypot(zenith_error, azimuth_error))
    doubtful = (cues.quality & (Quality.ILL_POSED | Quality.METAL | Quality.OUTSIDE | Quality.CLIPPED)) > 0
    error = np.hypot(noise, _MODEL_ERROR_DEG) + np.degrees(flip) + np.where(doubtful, 15.0, 0.0)
    return np.asarray(np.where(cues.mask, error, 0), dtype=np.float32)
