"""The learned estimator: the network's maps of the whole object, joined with the inversion's detail.

In: cues and a network. Out: normals, albedo, specular albedo, roughness, depth and expected error.
"""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap import parallel
from polcap.errors import ModelError
from polcap.images import Cues, Floats, Network, Quality, RunNetwork, SurfaceMaps
from polcap.optics import frames
from polcap.optics.resize import area_mean, weighted_area_mean
from polcap.stages.cues import CHANNELS, FLOOR
from polcap.stages.infer import analytic, augmentation, fine, half_turns
from polcap.stages.infer.analytic import REACHED, fill_highlights

_INVERSION = 4.0  # factor on the inversion's expected error in the join: the network has seen what it has seen
# error = min(a·statedᵇ·exp(r·roughness), c), degrees: likeliest on traced training meshes (decision 28)
_CALIBRATION = (0.515, 1.12, 0.906, 50.0)
_CELLS = 2.0  # cells of the network's grid, 1σ, over which its pattern is taken as the same
_BINOMIAL = np.array([0.25, 0.5, 0.25], np.float32)
_GRAZING = 0.15  # cosine below which shading is not told apart; .1 and .2 leave the same error
_BRIGHTEST = 2.0  # S0, which is 1 where white paper faces the flash beside the chart; what no body reflects


def estimate(
    cues: Cues, network: Network, run: RunNetwork, ior: float, symmetries: int, *, fine_pass: bool
) -> SurfaceMaps:
    """The network's maps, its normals joined with the analytic ones by their expected errors.

    The network sees the whole object at the size it was made for, which settles half-turns, shape and gloss.
    Detail comes from the pixels: of color by the picture itself, divided by the shading of the normals and by what
    else the network tells between light and albedo; of normals by what the inversion shows that is finer than the
    network sees, where noise leaves it a say.

    Parameters
    ----------
    cues
        Of the object's crop (H, W).
    network
        Takes the channels of `stages.cues`.
    run
        Runs a network.
    ior
        Refractive index of the inversion.
    symmetries
        1, 2, 4 or 8 turned and mirrored positions that the network looks from.
    fine_pass
        Whether the network's own fine pass, where it has one, adds relief.

    Raises
    ------
    ModelError
        A network was made for other channels, or gives other maps.
    """
    maps, guess, stated = known(cues, network, run, ior, symmetries)
    normal = fine.refine(cues, guess, network.fine, run) if fine_pass and network.fine else guess.normal
    lit = (np.maximum(cues.radiance, 0) + FLOOR) * np.exp(maps["factor"])
    diffuse = fill_highlights(lit / _shading(normal, cues.rays) - FLOOR, _bounded(cues))
    scale, power, rougher, most = _CALIBRATION
    expected = np.minimum(scale * stated**power * np.exp(rougher * np.clip(maps["roughness"], 0, 1)), most)
    expected = half_turns.error_with_doubt(expected, maps["doubt"], frames.dot(normal, cues.rays))
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


def known(
    cues: Cues, network: Network, run: RunNetwork, ior: float, symmetries: int
) -> tuple[dict[str, Floats], fine.CoarseEstimate, Floats]:
    """What stands before the fine pass, whose training begins here too.

    Parameters
    ----------
    cues, network, run, ior, symmetries
        As in `estimate`.

    Returns
    -------
    tuple
        The network's maps (H, W[, 3]) at the crop's size, of which `factor` is the logarithm of the light that its
        albedo sends back under the shading of its normals over S0, and `doubt` the probability of a wrong half-turn;
        what the fine pass is told; the error (H, W) stated for the normals, degrees.
    """
    _check(network)
    size = cues.mask.shape[::-1]
    shrink = max(1.0, max(size) / int(network.metadata["native_size"]))
    seen = _resized(_bounded(cues), 1 / shrink)
    looks = partial(augmentation.combined, seen, network, run, symmetries)
    small, averaged = parallel.both(looks, partial(analytic.prepare, cues, ior), network.at_once)
    # beside the object the network guesses: zeros there leave an edge's direction to the object's own pixels
    small["normal"] = _without_grid(small["normal"], seen.mask) * seen.mask[..., None]
    small["normal"], small["doubt"] = _sided(small["normal"], seen, small["sigma"], small.pop("opposed"))
    small["factor"] = _factor(small["diffuse"] * _shading(small["normal"], seen.rays), seen)
    for name in ("specular", "roughness"):
        small[name] = _blended(small[name], seen.mask)
    maps = {name: np.asarray(cv2.resize(image, size)) for name, image in small.items()}
    ahead = maps["normal"] / np.maximum(_length(maps["normal"]), 1e-6)
    guide = np.asarray(frames.to_ray_frame(ahead, cues.rays)), maps["sigma"]
    by_pixel, doubt, _ = analytic.invert(cues, ior, guide, averaged)
    detailed = _detailed(ahead, by_pixel, cues.mask, shrink)
    normal, stated = _joined((ahead, maps["sigma"]), (detailed, _INVERSION * doubt))
    return maps, fine.CoarseEstimate(normal, ahead, maps["sigma"], maps["roughness"], shrink), stated


def _sided(normal: Floats, seen: Cues, sigma: Floats, opposed: Floats) -> tuple[Floats, Floats]:
    """Normals (H, W, 3), regions that the network took for their half-turn turned back; doubt of the side (H, W)."""
    local = frames.to_ray_frame(normal / np.maximum(_length(normal), 1e-6), seen.rays)
    found = half_turns.resolve(local, seen.mask, half_turns.NetworkDoubt(sigma, opposed))
    opposite = 2 * frames.dot(normal, seen.rays)[..., None] * seen.rays - normal
    return np.where(found.turned[..., None], opposite, normal).astype(np.float32), found.doubt


def _bounded(cues: Cues) -> Cues:
    """What no body reflects counts as saturated, as in the pictures that the network learned from."""
    beyond = (cues.radiance > _BRIGHTEST).any(axis=-1)
    quality = np.where(beyond, cues.quality | np.uint8(Quality.CLIPPED), cues.quality)
    return replace(cues, radiance=np.minimum(cues.radiance, _BRIGHTEST), quality=quality)


def _without_grid(normal: Floats, mask: NDArray[np.bool_]) -> Floats:
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
        out[place] -= common / np.maximum(share, REACHED)[..., None] * mask[place][..., None]
    return out


def _blended(image: Floats, mask: NDArray[np.bool_]) -> Floats:
    """A map (H, W[, 3]) of gloss without the network's grid of one or two pixels: a kernel in which both vanish."""
    inside = mask.astype(np.float32)
    weight = inside if image.ndim == 2 else inside[..., None]
    smooth, share = (
        cv2.sepFilter2D(part, -1, _BINOMIAL, _BINOMIAL) for part in ((image * weight).astype(np.float32), inside)
    )
    share = share if image.ndim == 2 else share[..., None]
    return np.where(weight > 0, smooth / np.maximum(share, REACHED), image)


def _detailed(coarse: Floats, by_pixel: Floats, mask: NDArray[np.bool_], shrink: float) -> Floats:
    """Normals (H, W, 3) of one kind with what is finer than 2 px (1σ), seen `shrink` times smaller, of another.

    Interreflection, index and half-turns bend the inversion's normals over whole regions; relief is finer.
    """
    moved = by_pixel + fine.low_pass((coarse - by_pixel).astype(np.float32), mask, shrink)
    return np.asarray(moved / np.maximum(_length(moved), 1e-6))


def _joined(*estimates: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    """Mean direction of normals (H, W, 3) weighed by 1/σ² of their expected errors (H, W), and its own.

    Where the estimates agree the error is that of independent ones; where they part, their distance adds.
    """
    weights = [1 / np.maximum(sigma, 1.0) ** 2 for _, sigma in estimates]
    total = sum(w[..., None] * n / np.maximum(_length(n), 1e-6) for w, (n, _) in zip(weights, estimates))
    length = _length(np.asarray(total))
    share = np.clip(length[..., 0] / sum(weights), 1e-3, 1)  # 1 where all point the same way
    spread = np.degrees(np.arccos(share))
    return np.asarray(total / np.maximum(length, 1e-12)), np.hypot(1 / np.sqrt(sum(weights)), spread)


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
    small = max(16, round(height * scale)), max(16, round(width * scale))
    light = np.maximum(frames.total(cues.radiance), 1e-6) * cues.mask
    ratio = np.stack([weighted_area_mean(r, light, small) for r in cues.ratio])
    averaging = min(1.0, scale * np.sqrt(width / small[1] * scale))
    sigma = weighted_area_mean(cues.ratio_sigma, light, small) * averaging
    mask = area_mean(cues.mask, small) > 0.5
    radiance = weighted_area_mean(cues.radiance, cues.mask, small)
    squared = ratio[0] ** 2 + ratio[1] ** 2
    view = replace(
        cues.view,
        focal=cues.view.focal * scale,
        center=((cues.view.center[0] + 0.5) * scale - 0.5, (cues.view.center[1] + 0.5) * scale - 0.5),
        scale=cues.view.scale / scale,
    )
    clipped = area_mean((cues.quality & Quality.CLIPPED) > 0, small) > 0.5
    return replace(
        cues,
        radiance=radiance,
        ratio=ratio,
        ratio_sigma=sigma,
        dolp=np.sqrt(np.clip(squared - sigma**2, 0, 1)),
        normalized_stokes=ratio / np.sqrt(squared + 1e-12),
        diffuse_color=area_mean(cues.diffuse_color.astype(np.float32), small),
        rays=frames.rays(view, *mask.shape),
        mask=mask,
        quality=np.where(clipped, np.uint8(Quality.CLIPPED), np.uint8(0)),
        view=view,
    )


def _shading(normal: Floats, rays: Floats) -> Floats:
    """Share of the light (H, W, 1) that normals send back, as far as they are trusted.

    So relief finer than the network sees, and limbs that its pixels cut into steps, leave the albedo. Half of
    Lambert's law, as a power, left the least error of the albedo on pictures of both protocols, engraved or not,
    and on path-traced captures: normals err, and light from around fills what turns away.
    """
    length = np.maximum(_length(normal), 1e-6)
    return np.asarray(np.sqrt(np.maximum(frames.to_ray_frame(normal / length, rays)[..., 2:], _GRAZING)))


def _factor(light: Floats, seen: Cues) -> Floats:
    """Logarithm of light over S0 (H, W, 3), without the network's 2 px grid: a kernel in which that vanishes.

    Beside the object and in saturated highlights it goes on from around, for the pixels there when it is enlarged.
    """
    known = seen.mask & ((seen.quality & Quality.CLIPPED) == 0)
    inside = known.astype(np.float32)
    factor = (np.log((light + FLOOR) / (np.maximum(seen.radiance, 0) + FLOOR)) * inside[..., None]).astype(np.float32)

    def mean(kernel: Floats) -> Floats:
        smooth, share = (
            cv2.sepFilter2D(part, -1, kernel, kernel, borderType=cv2.BORDER_CONSTANT) for part in (factor, inside)
        )
        return np.asarray(smooth / np.maximum(share, 1e-3)[..., None])

    return np.where(known[..., None], mean(_BINOMIAL), mean(cv2.getGaussianKernel(9, 2).astype(np.float32)))
