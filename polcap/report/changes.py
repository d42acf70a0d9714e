"""Changes of an object between two results, on the pixels of the first one, and their size over the doubt.

1. The cameras' rays map the second result onto the first: crops, scales and focal lengths may differ.
2. Pictures of the maps under one lamp are registered by a similarity and a homography. A smooth flow then corrects the
   parallax of a camera that moved. The normals are turned by the rotation that fits them best.
3. Color, normal and roughness are subtracted. The doubt of a pixel is the usual difference in this pair, increased
   where the normals' expected error is larger. Two results share most of their errors, but not those of roughness
   where one result divides a material of the other. Regions that differ by more than `LIMIT` doubts are changes.

References
----------
Kabsch, A solution for the best rotation to relate two sets of vectors, Acta Cryst. 1976 (step 2). Kroeger et al.,
Fast optical flow using dense inverse search, ECCV 2016 (step 2).
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats
from polcap.optics import color, frames
from polcap.optics.morphology import erode
from polcap.optics.outline import fill_outward
from polcap.optics.registration import Pyramid, correlation, refine
from polcap.stage_values import SurfaceMaps

_LAMP = np.array([0.4, 0.5, 0.77], np.float32)  # direction of the lamp of the registered pictures
_RIM_PX = 3  # left out at the outline, where pixels mix with the backdrop
_LEAST_CORRELATION = 0.7  # of the registered pictures
_LARGEST_TURN_DEG = 45.0  # between the two cameras
_LEAST_SHARE = 0.1  # of the first object that both results show
_FLOW_SHARE = 0.06  # 1σ of the smoothing of the flow, over the maps' longer side
_AVERAGED_PX = 1.0  # 1σ of the averaging of the maps, which reduces their noise
LIMIT = 3.0  # doubts
_FEW_PX = 16  # fewer pixels are not compared
_LEAST_AREA, _LEAST_PX = 0.0018, 9  # of a changed region: over the object's area, and pixels
_OVER_QUARTER = 2.0  # usual difference over the 25th percentile
_LEAST_DOUBT = {"color": 0.6, "roughness": 0.02}  # ΔE2000, 1
_LARGEST_DOUBT = {"color": 2.5, "normal": 4.0, "roughness": 0.03}  # so that a change of the whole object is found
_OF_EXPECTED = 0.3  # least doubt of normals, over the expected error of the pair: two results share most of it
_GLOSS_STEP = 0.02  # of a histogram of roughness
_LEAST_MATERIAL = 0.05  # share of the compared pixels in a step of it that is a material, not a mixture at borders
_MISREGISTRATION_PX = 0.4  # error of the registration
_PATTERN = 0.7, 2.0  # least and largest doubt of a pixel over the usual one, by its expected error


@dataclass(frozen=True)
class Difference:
    """One quantity's difference between two results on the first one's pixels."""

    value: Floats  # (H, W) in its unit
    doubt: Floats  # (H, W) 1σ of the value where nothing changed
    changed: Bools  # (H, W)
    median: float  # of the absolute value

    @property
    def share(self) -> float:
        """Share of the compared pixels that changed."""
        return float(self.changed.sum() / max(np.isfinite(self.value).sum(), 1))


@dataclass(frozen=True)
class Changes:
    """The second result on the pixels of the first, and the differences."""

    other: SurfaceMaps  # resampled, its normals turned into the first camera's frame
    both: Bools  # (H, W) pixels that are compared
    share: float  # of the first object, that is compared
    correlation: float  # of the registered pictures
    turn_deg: float  # between the two cameras, about the object
    gain: float  # factor on the second result's albedo, 1 where the scales of both are known
    differences: dict[str, Difference]  # "color" ΔE2000, "normal" degrees, "roughness" second minus first

    @property
    def usable(self) -> bool:
        """Whether the pictures agree enough to be compared."""
        agree = self.correlation >= _LEAST_CORRELATION and self.turn_deg <= _LARGEST_TURN_DEG
        return agree and self.share >= _LEAST_SHARE


def measure(one: SurfaceMaps, other: SurfaceMaps) -> Changes:
    """Register the maps of a second result onto the maps of the first, and measure the differences."""
    matrix = _register(one, other)
    position = _refine_by_flow(one, other, matrix)
    moved, both = _resample(one, other, position)
    rotation = _rotation(one.normal[both], moved.normal[both])
    moved = replace(moved, normal=(moved.normal @ rotation.T).astype(np.float32))
    agreement = _agreement(_light(one), _light(moved), both)
    gain = _albedo_gain(one, moved, both)
    return Changes(
        other=moved,
        both=both,
        share=float(both.sum() / max(one.mask.sum(), 1)),
        correlation=agreement,
        turn_deg=float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1) / 2, -1, 1)))),
        gain=gain,
        differences=_differences(
            _average(one, both), _average(replace(moved, diffuse=moved.diffuse * np.float32(gain)), both), both
        ),
    )


def shading(maps: SurfaceMaps) -> Floats:
    """Brightness (H, W) of a white object with these normals under a lamp at the upper right."""
    return np.asarray(0.2 + 0.8 * np.maximum(maps.normal @ _LAMP, 0))


def _light(maps: SurfaceMaps) -> Floats:
    """Picture (H, W) of the maps under the lamp; its square root, in which noise is more even."""
    light = np.sqrt(np.maximum(maps.diffuse.mean(axis=-1), 0) * shading(maps))
    return np.asarray(np.where(maps.mask, light, 0), dtype=np.float32)


def _register(one: SurfaceMaps, other: SurfaceMaps) -> Floats:
    """Homography (3, 3) from pixels of the first maps to those of the second."""
    first, second = (Pyramid(cv2.GaussianBlur(_light(maps), (0, 0), 0.7), _trim(maps.mask)) for maps in (one, other))
    rays = other.view.intrinsic @ np.linalg.inv(one.view.intrinsic)
    starts = [rays, _match_extent(one.mask, other.mask)]
    found = [refine(first, second, "similarity", start).matrix for start in starts]

    def fit(matrix: Floats) -> float:
        return correlation(first, second, matrix) * _overlap(one.mask, other.mask, matrix)

    best = max([*starts, *found], key=fit)
    return max([best, refine(first, second, "simplest", best).matrix], key=fit)


def _overlap(one: Bools, other: Bools, matrix: Floats) -> float:
    """Share of the smaller object that lies on the other one under a motion (3, 3)."""
    flags = cv2.WARP_INVERSE_MAP | cv2.INTER_NEAREST
    moved = cv2.warpPerspective(other.astype(np.uint8), matrix, one.shape[::-1], flags=flags) > 0
    return float((one & moved).sum() / max(min(one.sum(), moved.sum()), 1)) if moved.any() else 0.0


def _trim(mask: Bools) -> Bools:
    """The mask without its rim, also at the picture's border."""
    return np.asarray(erode(mask, _RIM_PX, from_border=True))


def _match_extent(one: Bools, other: Bools) -> Floats:
    """The similarity (3, 3) that gives the first mask the middle and the area of the second."""
    scale = np.sqrt(other.sum() / max(one.sum(), 1))
    (y, x), (v, u) = (np.argwhere(mask).mean(axis=0) for mask in (one, other))
    return np.array([[scale, 0, u - scale * x], [0, scale, v - scale * y], [0, 0, 1]])


def _refine_by_flow(one: SurfaceMaps, other: SurfaceMaps, matrix: Floats) -> Floats:
    """Positions (H, W, 2) of the first maps' pixels in the second, by a homography (3, 3) and a smooth flow.

    The flow is left out if it does not raise the correlation of the pictures.
    """
    height, width = one.mask.shape
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    moved_grid: Any = cv2.perspectiveTransform(grid.reshape(1, -1, 2), matrix)
    unrefined: Floats = moved_grid.reshape(height, width, 2).astype(np.float32)
    moved, both = _resample(one, other, unrefined)
    pictures = [np.where(both, _light(maps), 0) for maps in (one, moved)]
    top = max(float(picture.max()) for picture in pictures) or 1.0
    first, second = (np.rint(255 * picture / top).astype(np.uint8) for picture in pictures)
    flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(first, second, None)
    sigma = _FLOW_SHARE * max(height, width)
    weight = cv2.GaussianBlur(both.astype(np.float32), (0, 0), sigma)
    smooth = cv2.GaussianBlur(flow * both[..., None], (0, 0), sigma) / np.maximum(weight, 1e-3)[..., None]
    # the flow in pixels of the second maps, without perspective
    shifted = unrefined + smooth @ (matrix[:2, :2] / matrix[2, 2]).T.astype(np.float32)
    better, inside = _resample(one, other, shifted)
    before, after = (_agreement(_light(one), _light(maps), both & inside) for maps in (moved, better))
    return np.asarray(shifted if after > before else unrefined)


def _resample(one: SurfaceMaps, other: SurfaceMaps, position: Floats) -> tuple[SurfaceMaps, Bools]:
    """The second maps at positions (H, W, 2), and the pixels (H, W) where both have the object."""
    x, y = np.ascontiguousarray(position[..., 0]), np.ascontiguousarray(position[..., 1])

    def sample(value: Floats) -> Floats:
        sampled: Any = cv2.remap(np.ascontiguousarray(value, np.float32), x, y, cv2.INTER_CUBIC)
        return np.asarray(sampled)

    error = np.zeros_like(other.roughness) if other.roughness_error is None else other.roughness_error
    scalars = np.stack([other.roughness, other.confidence, error], axis=-1)
    layers = [other.normal, other.diffuse, other.specular, scalars]
    filled = fill_outward(np.concatenate(layers, axis=-1), other.mask)
    moved = np.concatenate([sample(filled[..., k : k + 3]) for k in (0, 3, 6)] + [sample(filled[..., 9:])], axis=-1)
    seen = cv2.remap(_trim(other.mask).astype(np.uint8), x, y, cv2.INTER_NEAREST) > 0
    both = np.asarray(seen & _trim(one.mask))
    return (
        replace(
            other,
            normal=frames.unit(moved[..., :3]),
            diffuse=np.maximum(moved[..., 3:6], 0),  # cubic interpolation overshoots
            specular=moved[..., 6:9],
            roughness=moved[..., 9],
            confidence=np.maximum(moved[..., 10], 0.1),
            mask=both,
            view=one.view,
            depth_prior=None,
            detail=None,
            diffuse_error=None,
            roughness_error=None if other.roughness_error is None else moved[..., 11],
        ),
        both,
    )


def _agreement(one: Floats, other: Floats, both: Bools) -> float:
    """Pearson's correlation of two pictures on the pixels of both."""
    if both.sum() < _FEW_PX:
        return 0.0
    return float(np.nan_to_num(np.corrcoef(one[both], other[both])[0, 1]))


def _rotation(one: Floats, other: Floats) -> Floats:
    """Rotation (3, 3) that turns the second normals (N, 3) onto the first ones, without the quarter that fits worst."""
    chosen = np.ones(len(one), bool)
    rotation = np.eye(3)
    for _ in range(3):
        if chosen.sum() < _FEW_PX:
            break
        u, _, vt = np.linalg.svd(one[chosen].T.astype(np.float64) @ other[chosen])
        rotation = u @ np.diag([1, 1, np.sign(np.linalg.det(u @ vt))]) @ vt
        fit = frames.dot(one, other @ rotation.T)
        chosen = fit >= np.quantile(fit, 0.25)
    return rotation


def _albedo_gain(one: SurfaceMaps, other: SurfaceMaps, both: Bools) -> float:
    """Factor on the second albedo that makes the medians equal, where the doubt of the scales allows it; else 1."""
    if not both.any():
        return 1.0
    first, second = (color.luminance(maps.diffuse[both]) + 1e-4 for maps in (one, other))
    ratio = float(np.median(first / second))
    if one.albedo_sigma is None or other.albedo_sigma is None:
        return ratio
    return ratio if abs(np.log(ratio)) < 2 * np.hypot(one.albedo_sigma, other.albedo_sigma) else 1.0


def _differences(one: SurfaceMaps, other: SurfaceMaps, both: Bools) -> dict[str, Difference]:
    """Differences of color, normal and roughness on the pixels of both."""
    expected = np.hypot(one.confidence, other.confidence)
    middle = max(float(np.median(expected[both])), 1e-6) if both.any() else 1.0
    pattern = np.clip(expected / middle, *_PATTERN)
    first, second = (np.clip(maps.diffuse, 0, 1) for maps in (one, other))
    pairs: dict[str, tuple[Floats, Floats, Callable[[Floats, Floats], Floats]]] = {
        "color": (first, second, color.delta_e),
        "normal": (one.normal, other.normal, frames.angle_deg),
        "roughness": (one.roughness, other.roughness, lambda a, b: b - a),
    }
    found = {}
    for name, (before, after, distance) in pairs.items():
        value = np.where(both, distance(before, after), 0)
        steps = [np.abs(distance(before, np.roll(before, 1, axis))) * both for axis in (0, 1)]
        misplaced = _MISREGISTRATION_PX * np.hypot(steps[0], steps[1])
        doubt = np.hypot(_usual_difference(name, value[both]) * pattern, misplaced)
        least = _OF_EXPECTED * expected if name == "normal" else _LEAST_DOUBT[name]
        if name == "roughness" and one.roughness_error is not None and other.roughness_error is not None:
            unshared = np.hypot(one.roughness_error, other.roughness_error)
            least = np.where(_find_divided(one.roughness, other.roughness, both), unshared, least)
        found[name] = _difference(value, np.maximum(doubt, least), both)
    return found


def _find_divided(one: Floats, other: Floats, both: Bools) -> Bools:
    """Pixels (H, W) of a material of one result that is two or more materials in the other, by their roughness."""
    if not both.any():
        return both
    first, second = _materials(one, both), _materials(other, both)
    overlap = np.zeros((first.max() + 1, second.max() + 1), int)
    np.add.at(overlap, (first[both], second[both]), 1)
    divided = np.bincount(overlap.argmax(axis=0), minlength=len(overlap)) > 1
    also_divided = np.bincount(overlap.argmax(axis=1), minlength=overlap.shape[1]) > 1
    return np.asarray(divided[first] | also_divided[second])


def _materials(roughness: Floats, both: Bools) -> NDArray[np.intp]:
    """Number (H, W) of each pixel's material: the nearest peak in the histogram of roughness."""
    step = np.rint(np.maximum(roughness, 0) / _GLOSS_STEP).astype(int)
    counts = np.pad(np.bincount(step[both]), 1)
    middle = counts[1:-1]
    peaks = (middle > counts[:-2]) & (middle >= counts[2:]) & (middle >= _LEAST_MATERIAL * both.sum())
    places = np.flatnonzero(peaks)
    return np.asarray(np.searchsorted((places[1:] + places[:-1]) / 2, step))


def _usual_difference(name: str, value: Floats) -> float:
    """Usual difference in a pair, by its 25th percentile: at least a quarter of the object is taken for unchanged."""
    quarter = float(np.quantile(np.abs(value), 0.25)) if value.size else 0.0
    return min(_OVER_QUARTER * quarter, _LARGEST_DOUBT[name])


def _average(maps: SurfaceMaps, both: Bools) -> SurfaceMaps:
    """The maps averaged over neighboring pixels of both objects."""
    weight = np.maximum(cv2.GaussianBlur(both.astype(np.float32), (0, 0), _AVERAGED_PX), 1e-3)

    def mean(value: Floats) -> Floats:
        inside, share = (both, weight) if value.ndim == 2 else (both[..., None], weight[..., None])
        return np.asarray(cv2.GaussianBlur(np.float32(1) * value * inside, (0, 0), _AVERAGED_PX) / share)

    return replace(
        maps, normal=frames.unit(mean(maps.normal)), diffuse=mean(maps.diffuse), roughness=mean(maps.roughness)
    )


def _difference(value: Floats, doubt: Floats, both: Bools) -> Difference:
    """A difference with the regions that exceed the doubt."""
    beyond = both & (np.abs(value) > LIMIT * doubt)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(beyond.astype(np.uint8))
    large = stats[:, cv2.CC_STAT_AREA] >= max(_LEAST_AREA * both.sum(), _LEAST_PX)
    large[0] = False  # the background
    median = float(np.median(np.abs(value[both]))) if both.any() else 0.0
    return Difference(np.where(both, value, np.nan).astype(np.float32), doubt, np.asarray(large[labels]), median)
