"""Renders the maps under the flash again, for the comparison with the photographs.

The maps come from an estimator, which may be wrong. Their rendering does not depend on it: on the normals, the flash
makes a shading and a polarization, and both are in the photographs.
"""

from dataclasses import dataclass, replace

import numpy as np

from polcap.image_values import Bools, Floats, Quality
from polcap.optics import frames, shade
from polcap.optics.reduction import ObjectReduction
from polcap.optics.robust import MAD_TO_SIGMA
from polcap.quality.limits import GateLimits
from polcap.results import ResultsUntilInfer
from polcap.stage_values import Cues, SurfaceMaps
from polcap.stages.cues import NOMINAL_IOR

WHITE_QUANTILE = 0.995  # of the object's light; it becomes white
_BRIGHTEST = 0.99  # quantile of the light from which a pixel is a highlight
_JUDGED_PX = 256  # longest side on which the gate compares
_OUTLIER = 5  # standard deviations of the differences
_MOST_DOLP = 0.1  # greater ones count as this: noise and reflections


@dataclass(frozen=True)
class ReducedResult:
    """Maps and light of the object on one reduced grid."""

    maps: SurfaceMaps
    radiance: Floats  # (H, W, 3) S0, linear Rec.709
    ratio: Floats  # (2, H, W) S1/S0, S2/S0
    angle: Floats  # (K,) rad
    sound: Bools  # (H, W) on the object, without clipped light


def reduce(maps: SurfaceMaps, cues: Cues, angle: Floats, longest: int) -> ReducedResult:
    """Reduce maps (H, W) and light to at most `longest` pixels a side; means are taken over the object only.

    `angle` (K,) are the polarizer angles of the shots, rad.
    """
    reduction = ObjectReduction(np.asarray(maps.mask & cues.mask, bool), longest)
    light = np.maximum(frames.total(cues.radiance), 1e-6)
    weight = np.maximum(reduction.mean(light), 1e-9)
    small = reduction.maps(maps)
    clipped = ((cues.quality & np.uint8(Quality.CLIPPED)) > 0).astype(np.float32)
    return ReducedResult(
        maps=small,
        radiance=reduction.mean(cues.radiance),
        ratio=np.stack([reduction.mean(part * light) / weight for part in cues.ratio]),
        angle=angle,
        sound=small.mask & (reduction.mean(clipped) == 0),
    )


@dataclass(frozen=True)
class Rerendering:
    """Gray photographs of each polarizer angle, and the maps rendered under the same light and angle."""

    measured: Floats  # (K, H, W) S0 + S1 cos 2θ + S2 sin 2θ; 1 is white, brighter values are clipped
    predicted: Floats  # (K, H, W) the same, rendered from the maps under a flash at the lens
    flashed: Floats  # (H, W, 3) S0 of the maps under that flash, linear Rec.709
    scale: float  # brightness of the photographs over that of the re-rendering, median of the pixels
    agreement: float = float("nan")  # of the polarizations, see `_agreement`
    difference: float = 0.0  # relative, of S0 of the photographs and the re-rendering: median of the pixels
    significance: float = float("inf")  # DoLP of the photographs' median pixel over its 1σ
    highlights: float = 1.0  # S0 of the photographs over that of the re-rendering, where either is brightest

    def residuals(self, inside: Bools) -> dict[str, list[float]]:
        """Difference of photograph and re-rendering at each angle: `rms` without outliers, and share of `outliers`.

        Pixels `inside` (H, W) count. The rms is relative to white. An outlier differs by more than five robust standard
        deviations: a few pixels of a highlight do not carry the figure.
        """
        found: dict[str, list[float]] = {"rms": [], "outliers": []}
        for measured, predicted in zip(self.measured, self.predicted):
            size = np.abs(measured - predicted)[inside]
            outlier = size > _OUTLIER * max(MAD_TO_SIGMA * float(np.median(size)), 1e-6) if size.size else size > 0
            found["rms"].append(float(np.sqrt(np.mean(size[~outlier] ** 2))))
            found["outliers"].append(float(outlier.mean()))
        return found


def rerender(small: ReducedResult, ior: float) -> Rerendering:
    """Render the maps under the flash for each polarizer angle, for comparison with the photographs."""
    maps = small.maps
    # the two last angles show S1/S0 and S2/S0 in the picture's axes, as `small.ratio`
    stokes, shots = under_flash(maps, np.array([*small.angle, 0.0, np.pi / 4]), ior)
    s0 = frames.total(stokes[0]) / 3 * maps.mask
    photo = frames.total(small.radiance) / 3 * maps.mask
    light, lit = photo[maps.mask], s0[maps.mask]
    scale = float(np.median(light[lit > 0] / lit[lit > 0])) if (lit > 0).any() else 1.0
    white = max(float(np.quantile(light, WHITE_QUANTILE)), 1e-6) if light.size else 1.0

    shown = scale * lit
    brighter = np.maximum(light, shown)
    bright = brighter >= (np.quantile(brighter, _BRIGHTEST) if brighter.size else 0.0)
    measured, predicted = [], []
    for angle, shot in zip(small.angle, shots):
        measured.append(photo * (1 + small.ratio[0] * np.cos(2 * angle) + small.ratio[1] * np.sin(2 * angle)) / white)
        predicted.append(scale * shot * s0 / white)
    rendered = shots[-2:] - 1
    return Rerendering(
        measured=np.minimum(measured, 1.0),
        predicted=np.minimum(predicted, 1.0),
        flashed=stokes[0] * maps.mask[..., None],
        scale=scale,
        agreement=_agreement(small.ratio[:, small.sound], rendered[:, small.sound]),
        difference=float(np.median(np.abs(light - shown) / np.maximum(light, 1e-6))) if light.size else 0.0,
        highlights=float(light[bright].sum() / max(float(shown[bright].sum()), 1e-9)) if light.size else 1.0,
    )


def under_flash(maps: SurfaceMaps, angle: Floats, ior: float) -> tuple[Floats, Floats]:
    """Maps under a flash at the lens: Stokes parameters (3, H, W, 3) in the frame of each ray, and shots (K, H, W).

    A shot is the light through a polarizer at an angle (K,) rad in the picture, over half the light S0.
    """
    ray = frames.rays(maps.view, *maps.mask.shape)
    ahead = np.zeros_like(ray)
    ahead[..., 2] = 1.0
    one = np.ones(maps.mask.shape, np.float32)
    rough, normal = np.maximum(maps.roughness, 0.02), frames.to_ray_frame(maps.normal, ray)
    stokes = np.asarray(shade.stokes(normal, maps.diffuse, maps.specular, rough, ior * one, ahead, one))
    s0, s1, s2 = frames.total(stokes) / 3 * maps.mask
    axes = [2 * frames.axis_on_ray(np.float32(axis), ray) for axis in angle]
    shots = [1 + (s1 * np.cos(twice) + s2 * np.sin(twice)) / np.maximum(s0, 1e-6) for twice in axes]
    return stokes, np.stack(shots)


def _agreement(measured: Floats, rendered: Floats) -> float:
    """Agreement of two polarizations S1/S0, S2/S0 (2, N), −1…1; NaN without pixels.

    The sum of the smaller DoLPs times the cosine between both, over the sum of the larger DoLPs: 1 if both are equal, 0
    if one is unpolarized or they differ by 45°, −1 if they are across each other.
    """
    one, other = (np.linalg.norm(ratio, axis=0) for ratio in (measured, rendered))
    cosine = (measured * rendered).sum(axis=0) / np.maximum(one * other, 1e-9)
    smaller, larger = np.minimum(np.minimum(one, other), _MOST_DOLP), np.minimum(np.maximum(one, other), _MOST_DOLP)
    return float((smaller * cosine).sum() / larger.sum()) if larger.sum() > 0 else float("nan")


def measure(results: ResultsUntilInfer) -> Rerendering:
    """Render the maps again on few pixels, for the gate."""
    cues = results.cues
    small = reduce(results.maps, cues, results.selfcal.angle, _JUDGED_PX)
    found = rerender(small, NOMINAL_IOR)
    if not small.sound.any():
        return found
    # of the mean over the pixels in a reduced one
    sigma = float(np.median(cues.ratio_sigma[cues.mask])) * max(small.sound.shape) / max(cues.mask.shape)
    return replace(found, significance=float(np.median(np.hypot(*small.ratio)[small.sound])) / max(sigma, 1e-9))


def explains(found: Rerendering, limits: GateLimits) -> bool:
    """Whether maps explain the photographs: polarization and brightness are about those of their re-rendering."""
    alike = not found.agreement < limits.min_rerendering_agreement
    return alike and abs(np.log(found.scale)) <= np.log(limits.max_rerendering_scale)
