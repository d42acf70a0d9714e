"""Stage 8: estimate the surface's normals and material from the cues, by network or by inversion.

Both estimators work in the frame of each view ray, where polarization speaks of the surface alone, and
hand back camera-frame maps.
"""

from dataclasses import replace
from typing import Annotated, Literal

import cv2
import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from scipy.special import erf

from polcap.errors import ModelError
from polcap.images import Cues, Floats, Network, Quality, SurfaceMaps
from polcap.optics import azimuth, brdf, frames, fresnel
from polcap.stages import stage
from polcap.stages.cues import CHANNELS, FLOOR, channels

_BLURS_PX = (0.7, 1.0, 1.5, 2.2, 3.3, 5.0)
_SAME = 2.0  # standard deviations that two averages of the same thing may differ by
_INVERSION = 4.0  # factor on the inversion's expected error in the join: the network has seen what it has seen
_DETAIL = 2.0  # pixels that the network sees, 1σ: what is finer is the inversion's to tell
_CALIBRATION = (0.718, 1.16, 50.0)  # error = min(a·expectedᵇ, c), degrees: traced pictures of training meshes
_POSITIONS = tuple(
    (quarters, mirror) for first in (0, 1) for mirror in (False, True) for quarters in (first, first + 2)
)
_CELLS = 2.0  # cells of the network's grid, 1σ, over which its pattern is taken as the same
_BINOMIAL = np.array([0.25, 0.5, 0.25], np.float32)
_REACHED = 0.05  # share of known pixels under a Gaussian from which a mean is taken
_BRIGHTEST = 2.0  # S0, which is 1 where white paper faces the flash beside the chart; what no body reflects
_MODEL_ERROR_DEG = 4.0  # interreflection, highlights, unknown index: measured on path-traced objects


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    ior: Annotated[float, Meta(ge=1.2, le=2.5, description="refractive index assumed by the analytic estimator")] = 1.5
    turns: Annotated[
        Literal[1, 2, 4, 8],
        Meta(description="turned and mirrored positions in which the network sees the object; their mean is taken"),
    ] = 2


@stage(version=6)
def estimate(cues: Cues, network: Network | None, settings: Settings) -> SurfaceMaps:
    """Normal, diffuse, specular, roughness and expected error; network None means analytic."""
    return _analytic(cues, settings) if network is None else _learned(cues, network, settings)


# --- analytic -----------------------------------------------------------------------------------


def _analytic(cues: Cues, settings: Settings) -> SurfaceMaps:
    """Normals by the inversion; albedo and gloss as the highlights have them."""
    normal, error, cos_zenith = _inverted(cues, settings)
    diffuse, highlight = _albedo(cues, cos_zenith, settings.ior)
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


def _inverted(
    cues: Cues, settings: Settings, guide: tuple[Floats, Floats] | None = None
) -> tuple[Floats, Floats, Floats]:
    """Normals (H, W, 3), their expected error (H, W) in degrees and cosines of the zenith (H, W).

    Zenith by the exact DoLP inversion; half-turn of the azimuth by `optics/azimuth.py`, or as `guide` has it:
    normals (H, W, 3) in the frame of each ray and their expected error (H, W), degrees.
    """
    ratio, sigma = _smoothed(cues)
    squared = ratio[0] ** 2 + ratio[1] ** 2
    dolp = np.sqrt(np.maximum(squared - sigma**2, 0))
    cos_zenith = fresnel.cos_zenith_from_dolp(dolp, settings.ior)
    zenith = np.arccos(cos_zenith)
    axis = ratio / np.sqrt(squared + 1e-12)
    if guide is None:
        phi, certainty = azimuth.resolve(axis, np.sin(zenith), cues.mask)
    else:
        phi, certainty = _guided(axis, cues.rays, *guide)
    error = _expected_error(zenith, dolp, sigma, certainty, cues, settings.ior)
    return _from_angles(cos_zenith, phi, cues.rays), error, cos_zenith


def _guided(axis: Floats, rays: Floats, normal: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    """Azimuth (H, W) rad of axes (cos 2φ, sin 2φ) on the side of a known normal, and the half-turn's certainty.

    The normal's error is taken as Gaussian across the axis; certainty is P(right side) − P(wrong side).
    """
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
    light = (np.maximum(cues.radiance.sum(-1), 1e-6) * cues.mask).astype(np.float32)
    kept: list[tuple[Floats, Floats]] = []
    ratio, sigma = cues.ratio, cues.ratio_sigma
    weighted, weighted_sigma = ((image * light).astype(np.float32) for image in (ratio, sigma))
    growing = cues.mask
    for blur in _BLURS_PX:
        weight = cv2.GaussianBlur(light, (0, 0), blur) + np.float32(1e-9)
        wider = np.stack([cv2.GaussianBlur(part, (0, 0), blur) / weight for part in weighted])
        spread = cv2.GaussianBlur(weighted_sigma, (0, 0), blur) / weight / np.float32(np.sqrt(4 * np.pi) * blur)
        for narrower, apart in kept:
            moved = wider - narrower
            growing = growing & (moved[0] ** 2 + moved[1] ** 2 < apart)
        ratio, sigma = np.where(growing, wider, ratio), np.where(growing, spread, sigma)
        kept.append((wider, (_SAME * spread) ** 2))
    return ratio, sigma


def _from_angles(cos_zenith: Floats, phi: Floats, rays: Floats) -> Floats:
    """Unit normals (H, W, 3) in the camera frame from zenith and image azimuth about each ray."""
    turned = frames.axis_on_ray(phi, rays)
    sin_zenith = np.sqrt(np.maximum(1 - cos_zenith**2, 0))
    local = np.stack([sin_zenith * np.cos(turned), sin_zenith * np.sin(turned), cos_zenith], axis=-1)
    return np.asarray(frames.from_ray_frame(local, rays))


def _albedo(cues: Cues, cos_zenith: Floats, ior: float) -> tuple[Floats, Floats]:
    """Diffuse albedo (H, W, 3) and the highlight's radiance (H, W).

    A highlight is white, small, and faces the camera: what a grey-scale opening of the darkest channel
    removes where the zenith is under 35°. The rest over cos θ T₊² is the albedo.
    """
    size = max(5, round(0.12 * np.sqrt(max(cues.mask.sum(), 1)))) | 1
    radiance = _filled(cues.radiance, cues)
    darkest = cv2.GaussianBlur(radiance.min(-1), (0, 0), 1.0)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    opened = cv2.GaussianBlur(cv2.morphologyEx(darkest, cv2.MORPH_OPEN, kernel), (0, 0), size / 6)
    facing = np.clip((cos_zenith - np.cos(np.radians(35))) / 0.1, 0, 1)
    highlight = np.maximum(darkest - opened, 0) * facing * cues.mask
    plus, _ = fresnel.transmission(np.maximum(cos_zenith, 0.2), ior)
    shading = np.maximum(cos_zenith, 0.2) * plus * fresnel.transmission(1.0, ior)[0]
    diffuse = (radiance - highlight[..., None]) / shading[..., None]
    return (np.clip(diffuse, 0, 1) * cues.mask[..., None]).astype(np.float32), highlight.astype(np.float32)


def _filled(image: Floats, cues: Cues) -> Floats:
    """An image (H, W, 3) that goes on from around into highlights which saturate the shortest exposure."""
    clipped = cues.mask & ((cues.quality & Quality.CLIPPED) > 0)
    hole = cues.mask & (cv2.dilate(clipped.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    known = cues.mask & ~hole
    out, blur = np.array(image, np.float32), 2.0
    while hole.any() and known.any():
        share = cv2.GaussianBlur(known.astype(np.float32), (0, 0), blur)
        mean = cv2.GaussianBlur(out * known[..., None], (0, 0), blur) / np.maximum(share, 1e-6)[..., None]
        reached = hole & (share > _REACHED)
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


def _expected_error(zenith: Floats, dolp: Floats, sigma: Floats, certainty: Floats, cues: Cues, ior: float) -> Floats:
    """Expected normal error (H, W), degrees: noise through the inversion, the half-turn's doubt, the model's.

    A wrong half-turn costs 2θ and happens with probability (1 − certainty)/2.
    """
    step = np.maximum(sigma, 1e-5)
    low, high = (np.arccos(fresnel.cos_zenith_from_dolp(dolp + s * step, ior)) for s in (-1, 1))
    zenith_error = (high - low) / 2
    azimuth_error = np.sin(zenith) * np.minimum(sigma / (2 * np.maximum(dolp, 1e-5)), np.pi / 4)
    flip = (1 - certainty) / 2 * 2 * zenith
    noise = np.degrees(np.hypot(zenith_error, azimuth_error))
    doubtful = (cues.quality & (Quality.ILL_POSED | Quality.METAL | Quality.OUTSIDE | Quality.CLIPPED)) > 0
    error = np.hypot(noise, _MODEL_ERROR_DEG) + np.degrees(flip) + np.where(doubtful, 15.0, 0.0)
    return np.asarray(np.where(cues.mask, error, 0), dtype=np.float32)


# --- learned ------------------------------------------------------------------------------------


def _learned(cues: Cues, network: Network, settings: Settings) -> SurfaceMaps:
    """The network's maps, its normals joined with the analytic ones by their expected errors.

    The network sees the whole object at the size it was made for, which settles half-turns, shape and gloss.
    Detail comes from the pixels: of color by the picture itself, which the network's albedo only divides by its
    shading; of normals by what the inversion shows that is finer than the network sees, where noise leaves it a say.
    """
    _check(network)
    size = cues.mask.shape[::-1]
    shrink = max(1.0, max(size) / int(network.metadata["native_size"]))
    bounded = _bounded(cues)
    seen = _resized(bounded, 1 / shrink)
    small = _whole(seen, network, settings)
    # beside the object the network guesses: zeros there leave an edge's direction to the object's own pixels
    small["normal"] = _evened(small["normal"], seen.mask) * seen.mask[..., None]
    small["factor"] = _factor(small["diffuse"], seen)
    maps = {name: np.asarray(cv2.resize(image, size)) for name, image in small.items()}
    ahead = maps["normal"] / np.maximum(_length(maps["normal"]), 1e-6)
    guide = np.asarray(frames.to_ray_frame(ahead, cues.rays)), maps["sigma"]
    by_pixel, doubt, _ = _inverted(cues, settings, guide)
    detailed = _detailed(ahead, by_pixel, cues.mask, shrink)
    normal, stated = _joined((ahead, maps["sigma"]), (detailed, _INVERSION * doubt))
    diffuse = _filled((np.maximum(cues.radiance, 0) + FLOOR) * np.exp(maps["factor"]) - FLOOR, bounded)
    scale, power, most = _CALIBRATION
    expected = np.minimum(scale * stated**power, most)
    inside = cues.mask[..., None]
    return SurfaceMaps(
        normal=(normal * inside).astype(np.float32),
        diffuse=(np.clip(diffuse, 0, 1) * inside).astype(np.float32),
        specular=(np.clip(maps["specular"], 0, 1) * inside).astype(np.float32),
        roughness=(np.clip(maps["roughness"], 0.02, 1) * cues.mask).astype(np.float32),
        depth_prior=(maps["depth"] * cues.mask).astype(np.float32),
        confidence=(expected * cues.mask).astype(np.float32),
        mask=cues.mask,
        view=cues.view,
        estimator=f"network {network.metadata.get('version', network.digest[:8])}",
    )


def _bounded(cues: Cues) -> Cues:
    """What no body reflects counts as saturated, as in the pictures that the network learned from."""
    beyond = (cues.radiance > _BRIGHTEST).any(axis=-1)
    quality = np.where(beyond, cues.quality | np.uint8(Quality.CLIPPED), cues.quality)
    return replace(cues, radiance=np.minimum(cues.radiance, _BRIGHTEST), quality=quality)


def _whole(cues: Cues, network: Network, settings: Settings) -> dict[str, Floats]:
    """The network's maps of the whole object, normals in the camera frame; the mean over symmetries of the square.

    A turn or mirror of the picture is one of the scene: polarization turns twice as fast, rays with it.
    """
    picture, rays = np.moveaxis(channels(cues), 0, -1), cues.rays
    total: dict[str, Floats] = {}
    for quarters, mirror in _POSITIONS[: settings.turns]:
        turned = _turned(picture, quarters, mirror)
        maps = _run(np.moveaxis(_with_axes_turned(turned, quarters, mirror), -1, 0), network)
        own = np.array(_turned(rays, quarters, mirror))
        own[..., :2] = _vector_turned(own[..., :2], quarters, mirror)
        maps["normal"] = np.array(frames.from_ray_frame(maps["normal"], own))
        for name, image in maps.items():
            back = np.rot90(image, -quarters)
            back = back[:, ::-1] if mirror else back
            if name == "normal":
                upright = _vector_turned(back[..., :2], -quarters, False) * [-1.0 if mirror else 1.0, 1.0]
                back = np.concatenate([upright, back[..., 2:]], axis=-1)
            total[name] = total.get(name, 0) + np.asarray(back, np.float32) / settings.turns
    return total


def _turned(image: Floats, quarters: int, mirror: bool) -> Floats:
    """Pixels mirrored left to right, then turned counter-clockwise."""
    return np.asarray(np.rot90(image[:, ::-1] if mirror else image, quarters))


def _vector_turned(vector: Floats, quarters: int, mirror: bool) -> Floats:
    """Vectors (..., 2), y up, mirrored and turned likewise."""
    x, y = (-vector[..., 0] if mirror else vector[..., 0]), vector[..., 1]
    for _ in range(quarters % 4):
        x, y = -y, x
    return np.stack([x, y], axis=-1)


def _with_axes_turned(picture: Floats, quarters: int, mirror: bool) -> Floats:
    """Channels (H, W, N) whose pixels were turned, their directions turned too."""
    out = np.array(picture)
    for first in ("s1", "zenith_x", "cos_2phi"):  # twice the angle: a quarter negates, a mirror conjugates
        at = CHANNELS.index(first)
        out[..., at : at + 2] *= (-1.0) ** quarters
        out[..., at + 1] *= -1.0 if mirror else 1.0
    at = CHANNELS.index("ray_x")
    out[..., at : at + 2] = _vector_turned(picture[..., at : at + 2], quarters, mirror)
    return out


def _evened(normal: Floats, mask: NDArray[np.bool_]) -> Floats:
    """Normals (H, W, 3) without the network's 2 px grid: what pixels in the same place of its cells have in common.

    Relief does not keep step with the cells, so it stays.
    """
    whole = (cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0).astype(np.float32)
    out = normal.astype(np.float32)
    uneven = (out - cv2.sepFilter2D(out, -1, _BINOMIAL, _BINOMIAL)) * whole[..., None]
    for place in (np.s_[y::2, x::2] for y in (0, 1) for x in (0, 1)):
        common, share = (
            cv2.GaussianBlur(np.ascontiguousarray(part[place]), (0, 0), _CELLS) for part in (uneven, whole)
        )
        out[place] -= common / np.maximum(share, _REACHED)[..., None] * mask[place][..., None]
    return out


def _detailed(coarse: Floats, fine: Floats, mask: NDArray[np.bool_], shrink: float) -> Floats:
    """Normals (H, W, 3) of one kind with what is finer than 2 px (1σ), seen `shrink` times smaller, of another.

    Interreflection, index and half-turns bend the inversion's normals over whole regions; relief is finer.
    """
    height, width = mask.shape
    size = (round(width / shrink), round(height / shrink))
    inside = mask.astype(np.float32)
    apart, share = (
        cv2.GaussianBlur(cv2.resize(image, size, interpolation=cv2.INTER_AREA), (0, 0), _DETAIL)
        for image in ((coarse - fine).astype(np.float32) * inside[..., None], inside)
    )
    moved = fine + cv2.resize(apart / np.maximum(share, 1e-3)[..., None], (width, height))
    return np.asarray(moved / np.maximum(_length(moved), 1e-6))


def _joined(*estimates: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    """Mean direction of normals (H, W, 3) weighed by 1/σ² of their expected errors (H, W), and its own.

    Where the estimates agree the error is that of independent ones; where they part, their distance adds.
    """
    weights = [1 / np.maximum(sigma, 1.0) ** 2 for _, sigma in estimates]
    total = sum(w[..., None] * n / np.maximum(_length(n), 1e-6) for w, (n, _) in zip(weights, estimates))
    length = _length(np.asarray(total))
    share = np.clip(length[..., 0] / sum(weights), 1e-3, 1)  # 1 where all point the same way
    apart = np.degrees(np.arccos(share))
    return np.asarray(total / np.maximum(length, 1e-12)), np.hypot(1 / np.sqrt(sum(weights)), apart)


def _length(vectors: Floats) -> Floats:
    return np.asarray(frames.dot(vectors, vectors)[..., None] ** 0.5)


def _check(network: Network) -> None:
    if network.channels != CHANNELS:
        raise ModelError(
            f"model {network.digest[:8]} expects channels {', '.join(network.channels)}; "
            f"this version makes {', '.join(CHANNELS)}; use a model of this version, or --estimator analytic"
        )


def _resized(cues: Cues, scale: float) -> Cues:
    """The cues of a picture taken with fewer pixels: light is averaged, ratios with their light."""
    if scale >= 1.0:
        return cues
    height, width = cues.mask.shape
    size = (max(16, round(width * scale)), max(16, round(height * scale)))

    def mean(image: Floats) -> Floats:
        return np.asarray(cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_AREA))

    light = np.maximum(cues.radiance.sum(-1), 1e-6) * cues.mask
    weight = np.maximum(mean(light), 1e-9)
    ratio = np.stack([mean(r * light) / weight for r in cues.ratio])
    sigma = mean(cues.ratio_sigma * light) / weight * min(1.0, scale * np.sqrt(width / size[0] * scale))
    share = mean(cues.mask.astype(np.float32))
    mask = share > 0.5
    radiance = mean(cues.radiance * cues.mask[..., None]) / np.maximum(share, 1e-3)[..., None]
    squared = ratio[0] ** 2 + ratio[1] ** 2
    view = replace(
        cues.view,
        focal=cues.view.focal * scale,
        center=((cues.view.center[0] + 0.5) * scale - 0.5, (cues.view.center[1] + 0.5) * scale - 0.5),
        scale=cues.view.scale / scale,
    )
    clipped = mean((cues.quality & Quality.CLIPPED).astype(np.float32)) > 0.5 * Quality.CLIPPED
    return replace(
        cues,
        radiance=radiance,
        ratio=ratio,
        ratio_sigma=sigma,
        dolp=np.sqrt(np.clip(squared - sigma**2, 0, 1)),
        normalized_stokes=ratio / np.sqrt(squared + 1e-12),
        diffuse_color=mean(cues.diffuse_color),
        rays=frames.rays(view, *mask.shape),
        mask=mask,
        quality=np.where(clipped, np.uint8(Quality.CLIPPED), np.uint8(0)),
        view=view,
    )


def _factor(albedo: Floats, seen: Cues) -> Floats:
    """Logarithm of albedo over S0 (H, W, 3), without the network's 2 px grid: a kernel in which that vanishes.

    Beside the object and in saturated highlights it goes on from around, for the pixels there when it is enlarged.
    """
    known = seen.mask & ((seen.quality & Quality.CLIPPED) == 0)
    inside = known.astype(np.float32)
    factor = (np.log((albedo + FLOOR) / (np.maximum(seen.radiance, 0) + FLOOR)) * inside[..., None]).astype(np.float32)

    def mean(kernel: Floats) -> Floats:
        smooth, share = (
            cv2.sepFilter2D(part, -1, kernel, kernel, borderType=cv2.BORDER_CONSTANT) for part in (factor, inside)
        )
        return np.asarray(smooth / np.maximum(share, 1e-3)[..., None])

    return np.where(known[..., None], mean(_BINOMIAL), mean(cv2.getGaussianKernel(9, 2).astype(np.float32)))


def _run(picture: Floats, network: Network) -> dict[str, Floats]:
    """All maps (H, W[, 3]) of channels (N, H, W)."""
    _, height, width = picture.shape
    multiple = int(network.metadata["size_multiple"])
    pad = ((0, 0), (0, -height % multiple), (0, -width % multiple))
    output = network.run(np.pad(picture, pad)[None].astype(np.float32))
    images = {name: np.moveaxis(value[0], 0, -1)[:height, :width] for name, value in output.items()}
    return {name: image[..., 0] if image.shape[-1] == 1 else image for name, image in images.items()}
