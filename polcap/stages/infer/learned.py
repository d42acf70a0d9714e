"""Learned estimator: the network's maps of the whole object, combined with fine detail of the analytic inversion.

1. The cues are reduced to two sizes, one above and one below the network's native size.
2. The network predicts normals, material, depth and error; half-turns of whole regions are corrected.
3. The analytic inversion gives normals of each pixel. Their detail replaces that of the network where noise is low.
4. The refinement network adds relief.
5. The coarse part of the normals becomes that of one surface, except at depth steps.
6. Planar faces lose the variation that the expected error explains.
7. The albedo is the picture times a smooth factor from the network, divided by the square root of the shading.
8. Pixels of one material get one roughness, with one expected error, and one F0.
"""

from dataclasses import replace

import cv2
import numpy as np

from polcap.image_values import Bools, Floats, Quality
from polcap.optics import frames
from polcap.optics.reduction import scaled_view
from polcap.optics.resize import area_mean, weighted_area_mean
from polcap.stage_values import Cues, Network, OrderTest, RunNetwork, SurfaceMaps
from polcap.stages.cues import FLOOR
from polcap.stages.infer import analytic, fine, highlights, sizes_and_positions
from polcap.stages.infer.highlights import LEAST_KNOWN
from polcap.stages.infer.shape import half_turns, integrable_normals, planar_faces

_INVERSION = 4.0  # factor on the inversion's expected error in the join, for the network's input holds the inversion
# error = min(a·predictedᵇ, c), degrees: maximum likelihood on simulated captures and on test pictures (decision 28)
_CALIBRATION = (0.51, 1.19, 40.0)
_SIZES = (1.5625, 0.875)  # of the network's pictures, over its native size: 400 and 224 px (decision 9)
# sizes of smaller pictures, over the native size, and positions of each: evidence for the side of normals
_OVERVIEWS, _OVERVIEW_POSITIONS = (0.5, 0.35), 2
_TEST_SIZE = 0.35  # size of the picture in which orders of the shots are compared, over the network's native size
_GRAZING = 0.15  # least cosine of the shading; .1 and .2 leave the same error
_BRIGHTEST = 2.0  # greatest S0 of diffuse reflection; white paper that faces the flash near the chart has 1


def estimate(
    cues: Cues, network: Network, run: RunNetwork, ior: float, symmetries: int, *, fine_pass: bool
) -> SurfaceMaps:
    """Estimate the maps of an object's crop (H, W) by network and inversion, over 1, 2, 4 or 8 symmetric positions.

    `network` takes the channels of `stages.cues`; `run` runs a network; `ior` is the refractive index of the inversion;
    `fine_pass` adds relief by the refinement network, if there is one.

    Raises ModelError: a network was made for other channels, or returns other maps.
    """
    maps, coarse, predicted_error = estimate_coarse(cues, network, run, ior, symmetries)
    normal = fine.refine(cues, coarse, network.fine, run) if fine_pass and network.fine else coarse.normal
    scale, power, most = _CALIBRATION
    error = np.minimum(scale * predicted_error**power, most)
    error = half_turns.error_with_doubt(error, maps["doubt"], frames.dot(normal, cues.rays))
    normal = integrable_normals.make_integrable(normal, error, cues.mask, cues.rays)
    normal = planar_faces.flatten(normal, error, cues.mask)
    light = (np.maximum(cues.radiance, 0) + FLOOR) * np.exp(maps["factor"])
    diffuse = highlights.fill(light / _shading(normal, cues.rays) - FLOOR, _limit_radiance(cues))
    inside = cues.mask[..., None]
    maps_by_pixel = SurfaceMaps(
        normal=(normal * inside).astype(np.float32),
        diffuse=(np.clip(diffuse, 0, 1) * inside).astype(np.float32),
        specular=(np.clip(maps["specular"], 0, 1) * inside).astype(np.float32),
        roughness=(np.clip(maps["roughness"], 0.02, 1) * cues.mask).astype(np.float32),
        depth_prior=(maps["depth"] * cues.mask).astype(np.float32),
        confidence=(error * cues.mask).astype(np.float32),
        mask=cues.mask,
        view=cues.view,
        order=_compare_orders(cues, network, run),
        estimator=f"network {network.metadata.get('version', network.digest[:8])}",
    )
    return highlights.pool_gloss(maps_by_pixel, cues)


def estimate_coarse(
    cues: Cues, network: Network, run: RunNetwork, ior: float, symmetries: int
) -> tuple[dict[str, Floats], fine.CoarseEstimate, Floats]:
    """Estimate normals and material before refinement (steps 1–3); also the input of the refinement network's training.

    `symmetries` is the number of turned and mirrored positions that the network sees. Returns the network's maps
    (H, W[, 3]) at the crop's size, the normals before refinement, and their expected error (H, W) in degrees, not yet
    calibrated. The maps also have `factor`, see `_log_factor`, and `doubt`, the probability of a wrong azimuth side.
    """
    size = cues.mask.shape[::-1]
    scale = int(network.metadata["native_size"]) / max(size)
    largest, *others = sorted({min(1.0, factor * scale) for factor in _SIZES}, reverse=True)
    reduced = _reduce(_limit_radiance(cues), largest)
    pictures = [reduced, *(_reduce(reduced, other / largest) for other in others)]
    small = sizes_and_positions.predict(pictures, network, run, symmetries)
    overview = _overview(reduced, min(scale, 1.0) / largest, network, run)
    evidence = half_turns.NetworkDoubt(small["sigma"], small.pop("opposed"), overview)
    small["normal"], small["doubt"] = _correct_half_turns(small["normal"], reduced, evidence)
    small["factor"] = _log_factor(small["diffuse"] * _shading(small["normal"], reduced.rays), reduced)
    smoothed = _masked_filter(small["roughness"], reduced.mask, sizes_and_positions.BINOMIAL, LEAST_KNOWN)
    small["roughness"] = np.where(reduced.mask, smoothed, small["roughness"])  # without the network's 2 px grid
    maps = {name: np.asarray(cv2.resize(image, size)) for name, image in small.items()}
    smooth = frames.unit(maps["normal"])
    guide = np.asarray(frames.to_ray_frame(smooth, cues.rays)), maps["sigma"]
    by_pixel, error, _ = analytic.invert(cues, ior, guide)
    shrink = 1 / largest  # the crop's pixels per pixel of the network's largest picture
    detailed = _add_detail(smooth, by_pixel, cues.mask, shrink)
    normal, predicted_error = _join((smooth, maps["sigma"]), (detailed, _INVERSION * error))
    return maps, fine.CoarseEstimate(normal, smooth, maps["sigma"], maps["roughness"], shrink), predicted_error


def _compare_orders(cues: Cues, network: Network, run: RunNetwork) -> OrderTest | None:
    """The other order of the shots with the least expected error, and the ratio of this error to the stated order's.

    Under a wrong order the polarization fits no shape with this outline and shading, so the network expects larger
    errors (decision 33), in a small picture too. None: there is no other order, or no pixel.
    """
    if not cues.other_orders:
        return None
    scale = int(network.metadata["native_size"]) / max(cues.mask.shape)
    low = _reduce(_limit_radiance(cues), _TEST_SIZE * min(scale, 1.0))
    if not low.mask.any():  # thinner than a pixel of the small picture
        return None

    def mean_error(matrix: Floats) -> float:
        predicted = sizes_and_positions.predict([_transformed(low, matrix)], network, run, 1)
        return float(predicted["sigma"][low.mask].mean())

    errors = [mean_error(other.matrix) for other in cues.other_orders]
    least = int(np.argmin(errors))
    return OrderTest(cues.other_orders[least].order, errors[least] / mean_error(np.eye(3)))


def _transformed(cues: Cues, matrix: Floats) -> Cues:
    """Cues of another order of the shots, by its `OtherOrder.matrix` (3, 3); the identity gives the stated order."""
    stokes = np.einsum("jk,khw->jhw", matrix, np.stack([np.ones_like(cues.dolp), *cues.ratio]))  # over the stated S0
    s0 = np.maximum(stokes[0], 1e-3)  # positive, because it divides
    changed = replace(cues, radiance=cues.radiance * s0[..., None])
    return _with_polarization(changed, stokes[1:] / s0, cues.ratio_sigma)


def _with_polarization(cues: Cues, ratio: Floats, sigma: Floats) -> Cues:
    """Replace the polarization of cues: S1/S0 and S2/S0 (2, H, W), their 1σ (H, W), and all that follows from them."""
    squared = ratio[0] ** 2 + ratio[1] ** 2
    return replace(
        cues,
        ratio=ratio,
        ratio_sigma=sigma,
        dolp=np.sqrt(np.clip(squared - sigma**2, 0, 1)),
        normalized_stokes=ratio / np.sqrt(squared + 1e-12),
    )


def _limit_radiance(cues: Cues) -> Cues:
    """Clip radiance above that of any diffuse reflection, and flag it CLIPPED, as in the training pictures."""
    beyond = (cues.radiance > _BRIGHTEST).any(axis=-1)
    quality = np.where(beyond, cues.quality | np.uint8(Quality.CLIPPED), cues.quality)
    return replace(cues, radiance=np.minimum(cues.radiance, _BRIGHTEST), quality=quality)


def _reduce(cues: Cues, scale: float) -> Cues:
    """Reduce cues to fewer pixels: light is averaged, ratios of Stokes parameters are averaged with its weight."""
    if scale >= 1.0:
        return cues
    height, width = cues.mask.shape
    small = max(16, round(height * scale)), max(16, round(width * scale))
    light = np.maximum(frames.total(cues.radiance), 1e-6) * cues.mask
    ratio = np.stack([weighted_area_mean(r, light, small) for r in cues.ratio])
    averaging = min(1.0, scale * np.sqrt(width / small[1] * scale))  # ≈ scale: noise of a mean over (1/scale)² pixels
    sigma = weighted_area_mean(cues.ratio_sigma, light, small) * averaging
    mask = area_mean(cues.mask, small) > 0.5
    view = scaled_view(cues.view, scale)
    clipped = area_mean((cues.quality & Quality.CLIPPED) > 0, small) > 0.5
    return replace(
        _with_polarization(cues, ratio, sigma),
        radiance=weighted_area_mean(cues.radiance, cues.mask, small),
        diffuse_color=area_mean(cues.diffuse_color.astype(np.float32), small),
        rays=frames.rays(view, *mask.shape),
        mask=mask,
        quality=np.where(clipped, np.uint8(Quality.CLIPPED), np.uint8(0)),
        view=view,
    )


def _overview(reduced: Cues, scale: float, network: Network, run: RunNetwork) -> Floats:
    """Mean lean (2, H, W) across the ray of the normals that the network predicts from pictures smaller than `reduced`.

    `scale` is the network's native size over that of `reduced`. In a picture of fewer pixels the network sees more of
    the object at once. One position alone is not reliable.
    """
    lean = np.zeros((2, *reduced.mask.shape), np.float32)
    for size in _OVERVIEWS:
        low = _reduce(reduced, size * scale)
        normal = sizes_and_positions.predict([low], network, run, _OVERVIEW_POSITIONS)["normal"]
        local = frames.to_ray_frame(frames.unit(normal), low.rays)[..., :2] * low.mask[..., None]
        lean += np.moveaxis(cv2.resize(local.astype(np.float32), reduced.mask.shape[::-1]), -1, 0) / len(_OVERVIEWS)
    return lean


def _correct_half_turns(normal: Floats, reduced: Cues, doubt: half_turns.NetworkDoubt) -> tuple[Floats, Floats]:
    """Turn regions of the network's normals (H, W, 3) that lean to the wrong side of the ray (180° ambiguity).

    Also returns the probability (H, W) that the chosen side is wrong.
    """
    flash = planar_faces.FlashPicture(reduced.radiance, reduced.rays)
    found = half_turns.resolve(frames.to_ray_frame(frames.unit(normal), reduced.rays), reduced.mask, doubt, flash)
    opposite = 2 * frames.dot(normal, reduced.rays)[..., None] * reduced.rays - normal
    return np.where(found.turned[..., None], opposite, normal).astype(np.float32), found.doubt


def _log_factor(light: Floats, reduced: Cues) -> Floats:
    """Logarithm of predicted light (albedo times shading) over S0, (H, W, 3), without the 2 px grid artifact.

    Outside the object and in clipped highlights it is continued from the pixels around, for the enlargement.
    """
    known = reduced.mask & ((reduced.quality & Quality.CLIPPED) == 0)
    factor = np.log((light + FLOOR) / (np.maximum(reduced.radiance, 0) + FLOOR))
    inside, outside = (
        _masked_filter(factor, known, kernel, 1e-3, cv2.BORDER_CONSTANT)
        for kernel in (sizes_and_positions.BINOMIAL, cv2.getGaussianKernel(9, 2).astype(np.float32))
    )
    return np.where(known[..., None], inside, outside)


def _masked_filter(
    image: Floats, mask: Bools, kernel: Floats, least: float, border: int = cv2.BORDER_DEFAULT
) -> Floats:
    """Mean of an image (H, W[, 3]) over the pixels in the mask (H, W), weighted by a separable filter.

    The sum of the weights counts as at least `least`.
    """
    inside = mask.astype(np.float32)
    extra = (None,) * (image.ndim - 2)
    total, share = (
        cv2.sepFilter2D(part, -1, kernel, kernel, borderType=border)
        for part in ((image * inside[..., *extra]).astype(np.float32), inside)
    )
    return np.asarray(total / np.maximum(share, least)[..., *extra])


def _add_detail(coarse: Floats, by_pixel: Floats, mask: Bools, shrink: float) -> Floats:
    """Add to coarse normals (H, W, 3) the fine detail of the inversion's normals `by_pixel`, (H, W, 3).

    Interreflection, a wrong refractive index and half-turns bend the inversion's normals over whole regions. So only
    detail finer than the network resolves is taken.
    """
    return frames.unit(by_pixel + fine.low_pass((coarse - by_pixel).astype(np.float32), mask, shrink))


def _join(*estimates: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    """Weighted mean direction (1/σ²) of several normal maps (H, W, 3) with expected errors (H, W), and its error.

    Errors are in degrees, and count as 1° at least. If the estimates agree, the error is that of independent ones; if
    they differ, their distance adds to it.
    """
    weights = [1 / np.maximum(sigma, 1.0) ** 2 for _, sigma in estimates]
    total = np.asarray(sum(w[..., None] * frames.unit(normal) for w, (normal, _) in zip(weights, estimates)))
    share = np.clip(frames.dot(total, total) ** 0.5 / sum(weights), 1e-3, 1)  # 1 where all directions agree
    return frames.unit(total), np.hypot(1 / np.sqrt(sum(weights)), np.degrees(np.arccos(share)))


def _shading(normal: Floats, rays: Floats) -> Floats:
    """Shading (H, W, 1) that the albedo estimate assumes for normals and rays: √cos θ, limited.

    The square root of Lambert's law leaves the least error of the albedo, on training pictures and on path-traced
    captures: normals have errors, and light from the surroundings brightens surfaces that turn away.
    """
    return np.asarray(np.sqrt(np.maximum(frames.to_ray_frame(frames.unit(normal), rays)[..., 2:], _GRAZING)))
