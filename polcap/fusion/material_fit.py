"""F0 and roughness per material, from the highlights of all views and from their maps together.

Each view shows a point of the surface under another half-angle, so all views together sample the lobe of the gloss,
which one view cannot. Texels of like albedo are taken for one material. Its radiance S0 under the flash is

    S0 = E (g ρ_d D(n, l, v) + F0 S(n, l, v, α))

with the diffuse and the specular law of `optics/shade.py`, and E the flash's light at the distance of the point. For
each α, g and F0 follow from weighted least squares; the α with the least residual is the fit. Errors of the normals
widen the lobe: α² is less by twice their variance. The flash's place near the lens is found first, as the one for
which all materials fit best.

The brightness of a highlight gives F0/α², and its width gives α. F0 and roughness of the views' maps have a weight in
the fit, in proportion to the residual. They are medians over the views, because the errors of one view are alike
everywhere.

References
----------
Lensch et al., Image-based reconstruction of spatial appearance and geometric detail, ACM TOG 2003 (clusters of
materials, lobes from few views); Walter et al. 2007 (GGX).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from scipy.optimize import minimize, minimize_scalar

from polcap.fusion.atlas import Atlas
from polcap.fusion.baking import AtlasMaps, Sight, on_atlas, sights
from polcap.fusion.values import FusionView
from polcap.images import Floats
from polcap.optics import color, frames, shade
from polcap.optics.point_light import irradiance
from polcap.stages import stage

_ALPHAS = np.geomspace(0.01, 1.0, 14)
_ALPHA_ERROR = 0.01  # relative; F0 changes by twice as much, because the brightness F0/α² at the highlight is fixed
_SAMPLES = 6000  # of a material, at most
_LEAST_SAMPLES = 300  # of a material, below which its maps are left as they are
_LEAST_SHARE = 0.02  # of the weight in the view that sees most of a material, for a view's maps to count
_LEAST_COSINE = 0.3  # between normal and view: flatter views show errors of the normals
_FLOOR = 0.02  # of the median radiance: error of every sample, with `_RELATIVE`
_RELATIVE = 0.08
_ROUNDS = 3  # of reweighting
_GAIN_SIGMA, _ROUGHNESS_SIGMA = 0.1, 0.16  # errors of the maps over a material
_F0_SIGMA = 0.012  # the same, at most
_F0_SIGMA_ROUGH = 0.0002  # over α²: errors of the diffuse light change the F0 of a highlight by 4 α² times as much
_FARTHEST_FLASH = 0.15  # m from the lens
_INDEX = 1.5  # refractive index of the diffuse law and of the Fresnel term


class MaterialSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the stage `material_fit` of the fusion."""

    materials: Annotated[int, Meta(ge=1, le=32, description="most materials, by albedo [1]")] = 12
    normal_sigma_deg: Annotated[
        float, Meta(ge=0, le=20, description="error of the baked normals, per axis, which widens the lobes [°]")
    ] = 3.0
    map_weight: Annotated[
        float, Meta(ge=0, le=10, description="weight of the views' own maps against the fit of the highlights [1]")
    ] = 0.15


@dataclass(frozen=True)
class LobeSamples:
    """Radiance of points of one material in all views, and what the maps say of its gloss."""

    radiance: Floats  # (P,) luminance of S0 over the light that the point receives
    albedo: Floats  # (P,) luminance of the baked albedo
    normal: Floats  # (P, 3) baked, in the frame of the ray
    point: Floats  # (P, 3) m, camera frame
    weight: Floats  # (P,)
    f0: float
    alpha: float

    def take(self, index: NDArray[np.intp] | slice) -> "LobeSamples":
        """Some of the samples."""
        return replace(
            self,
            radiance=self.radiance[index],
            albedo=self.albedo[index],
            normal=self.normal[index],
            point=self.point[index],
            weight=self.weight[index],
        )


@dataclass(frozen=True)
class Lobe:
    """Gloss of one material."""

    f0: float
    alpha: float
    gain: float  # of the albedo
    residual: float  # weighted mean of ln(1 + error²), in units of the expected error, and the prior's part


@stage(version=4)
def fit(views: tuple[FusionView, ...], atlas: Atlas, maps: AtlasMaps, settings: MaterialSettings) -> AtlasMaps:
    """Refine F0 and roughness by the highlights of all views; without S0 in the views the maps stay as they are."""
    lit = [view for view in views if view.s0 is not None]
    if not lit:
        return maps
    share = _materials(maps, atlas, settings.materials)  # (N, K)
    samples = _samples(lit, sights(lit, atlas), atlas, maps, share)
    light = _flash(samples, settings)
    lobes = [None if one is None else _lobe(one, light, settings) for one in samples]
    return _blended(atlas, maps, share, lobes)


def _materials(maps: AtlasMaps, atlas: Atlas, count: int) -> Floats:
    """Soft share (N, K) of each texel in each material, by clusters of the encoded albedo."""
    encoded = color.encode_srgb(np.clip(maps.diffuse[atlas.covered], 0, 1)).astype(np.float32)
    seen = maps.seen[atlas.covered]
    some = encoded[seen][:: max(1, int(seen.sum()) // 40_000)]
    count = min(count, len(some))
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-4)
    cv2.setRNGSeed(0)
    compactness, _, center = cv2.kmeans(some, count, np.empty(0, np.int32), stop, 3, cv2.KMEANS_PP_CENTERS)
    spread = max(float(np.sqrt(compactness / len(some))), 0.02)
    distance = np.linalg.norm(encoded[:, None] - center[None], axis=-1)
    likeness = np.exp(-((distance / spread) ** 2) + (distance.min(axis=1, keepdims=True) / spread) ** 2)
    return np.asarray(likeness / likeness.sum(axis=1, keepdims=True))


def _samples(
    views: Sequence[FusionView], seen: Sequence[Sight], atlas: Atlas, maps: AtlasMaps, share: Floats
) -> list[LobeSamples | None]:
    """Samples of each material; None where it has too few."""
    normal, albedo = maps.normal[atlas.covered], color.luminance(maps.diffuse[atlas.covered])
    parts = []
    middle = atlas.position.mean(axis=0)
    for view, one in zip(views, seen):
        assert view.s0 is not None
        steep = np.flatnonzero(one.cosine > _LEAST_COSINE)
        point = atlas.position[one.texel[steep]] @ view.pose.rotation.T + view.pose.translation
        to_lens = frames.unit(-point)
        local = frames.to_ray_frame(normal[one.texel[steep]] @ view.pose.rotation.T, to_lens)
        far = float(np.linalg.norm(view.pose.rotation @ middle + view.pose.translation))
        light = irradiance(point, view.light[:2], 0.0) * far**2
        radiance = color.luminance(one.sample(view.s0))[steep] / light
        parts.append((radiance, albedo[one.texel[steep]], local, point, one.weight[steep], one.texel[steep]))
    radiance, base, local, point, weight, texel = (np.concatenate(column) for column in zip(*parts))
    best = share.argmax(axis=1)
    material, gloss = best[texel], _typical_gloss(views, seen, best, share.shape[1])
    found: list[LobeSamples | None] = []
    for k, (f0, rough) in enumerate(gloss):
        mine = np.flatnonzero((material == k) & (weight > 0))
        if len(mine) < _LEAST_SAMPLES:
            found.append(None)
            continue
        mine = mine[np.linspace(0, len(mine) - 1, min(len(mine), _SAMPLES)).astype(int)]
        found.append(LobeSamples(radiance, base, local, point, weight, f0, max(rough**2, _ALPHAS[0])).take(mine))
    return found


def _typical_gloss(
    views: Sequence[FusionView], seen: Sequence[Sight], material: NDArray[np.intp], count: int
) -> list[tuple[float, float]]:
    """F0 and roughness of each material in the maps: medians over the views that see enough of it."""
    rows = np.zeros((len(views), count, 3))  # means of F0 and roughness, weight
    for row, view, one in zip(rows, views, seen):
        gloss = color.luminance(one.sample(view.specular)), one.sample(view.roughness)[:, 0], np.ones(len(one.texel))
        row[:] = np.stack([np.bincount(material[one.texel], one.weight * x, count) for x in gloss], axis=-1)
        row[:, :2] /= np.maximum(row[:, 2:], 1e-9)
    enough = rows[..., 2] > _LEAST_SHARE * rows[..., 2].max(axis=0)
    return [tuple(np.median(rows[enough[:, k], k, :2], axis=0)) if enough[:, k].any() else (0.0, 0.0)
            for k in range(count)]  # fmt: skip


def _flash(samples: Sequence[LobeSamples | None], settings: MaterialSettings) -> Floats:
    """Place (3,) of the flash in the camera frame for which all materials fit best."""
    few = [one.take(slice(None, None, 8)) for one in samples if one is not None]
    if not few:
        return np.zeros(3)

    def misfit(place: Floats) -> float:
        far = max(float(np.hypot(*place)) / _FARTHEST_FLASH - 1, 0)
        return sum(_lobe(one, np.append(place, 0.0), settings).residual for one in few) + 10 * far

    simplex = np.array([[0.0, 0.0], [0.03, 0.0], [0.0, 0.03]])
    best = minimize(misfit, np.zeros(2), method="Nelder-Mead",
                    options={"initial_simplex": simplex, "maxfev": 40, "xatol": 0.002, "fatol": 1e-4})  # fmt: skip
    return np.append(best.x, 0.0)


def _lobe(samples: LobeSamples, light: Floats, settings: MaterialSettings) -> Lobe:
    """The lobe that fits the samples best for a flash at `light` (3,) [m, camera frame]."""
    to_lens = frames.unit(-samples.point)
    to_light = frames.to_ray_frame(frames.unit(light - samples.point), to_lens)
    ones, white, none = np.ones(len(to_light)), np.ones((len(to_light), 1)), np.zeros((len(to_light), 1))
    body = shade.stokes(samples.normal, white, none, 0.5 * ones, _INDEX * ones, to_light, ones)[0][:, 0]
    diffuse = samples.albedo * body
    floor = _FLOOR * float(np.median(samples.radiance))
    widened = 2 * np.radians(settings.normal_sigma_deg) ** 2

    def lobe(log_alpha: float, prior: float) -> Lobe:
        alpha = np.exp(log_alpha)
        gloss = shade.stokes(samples.normal, none, white, np.sqrt(alpha) * ones, _INDEX * ones, to_light, ones)[0][:, 0]
        gain, f0, residual = _amplitudes(samples, diffuse, gloss, floor, prior)
        narrower = np.sqrt(max(alpha**2 - widened, _ALPHAS[0] ** 2))  # the lobe without the errors of the normals
        residual += prior * ((np.sqrt(narrower) - np.sqrt(samples.alpha)) / _ROUGHNESS_SIGMA) ** 2
        return Lobe(f0, float(narrower), gain, residual)

    of_maps = lobe(0.5 * float(np.log(samples.alpha**2 + widened)), settings.map_weight)
    prior = settings.map_weight * of_maps.residual  # the residual is the noise of the highlights
    steps = np.log(_ALPHAS)
    best = int(np.argmin([lobe(one, prior).residual for one in steps]))
    around = steps[max(best - 1, 0)], steps[min(best + 1, len(steps) - 1)]
    found = minimize_scalar(lambda one: lobe(one, prior).residual, bounds=around, options={"xatol": _ALPHA_ERROR})
    return lobe(float(found.x), prior)


def _amplitudes(
    samples: LobeSamples, diffuse: Floats, gloss: Floats, floor: float, prior: float
) -> tuple[float, float, float]:
    """Gain of the albedo, F0 and the mean residual, by reweighted least squares around the maps."""
    terms = np.stack([diffuse, gloss], axis=-1)
    scale = floor + _RELATIVE * np.maximum(samples.radiance, 0)
    robust = np.ones(len(scale))
    f0_sigma = min(_F0_SIGMA, _F0_SIGMA_ROUGH / samples.alpha**2)
    expected, tie = np.array([1.0, samples.f0]), prior / np.array([_GAIN_SIGMA, f0_sigma]) ** 2
    for _ in range(_ROUNDS):
        w = samples.weight * robust / scale**2 / samples.weight.sum()
        normal = terms.T @ (w[:, None] * terms) + np.diag(tie)
        amplitude = np.linalg.solve(normal, terms.T @ (w * samples.radiance) + tie * expected)
        if amplitude[1] < 0:  # no highlight at all
            amplitude = np.array([(w * diffuse) @ samples.radiance / max(float((w * diffuse) @ diffuse), 1e-12), 0.0])
        error = (samples.radiance - terms @ amplitude) / scale
        robust = 1 / (1 + error**2)
    loss = float((samples.weight * np.log1p(error**2)).sum() / samples.weight.sum())
    loss += float(tie @ (amplitude - expected) ** 2)
    return float(amplitude[0]), float(amplitude[1]), loss


def _blended(atlas: Atlas, maps: AtlasMaps, share: Floats, lobes: Sequence[Lobe | None]) -> AtlasMaps:
    """Maps with the F0 and roughness of the lobes; a material without a lobe has the means of its maps."""
    specular, roughness = maps.specular[atlas.covered].astype(np.float64), maps.roughness[atlas.covered]
    seen = maps.weight[atlas.covered]
    target = np.zeros((len(share), 2))
    for k, lobe in enumerate(lobes):
        weight = share[:, k] * seen
        mean_f0 = float((weight * color.luminance(specular)).sum() / max(weight.sum(), 1e-9))
        mean_rough = float((weight * roughness).sum() / max(weight.sum(), 1e-9))
        if lobe is None:
            target += share[:, k, None] * [mean_f0, mean_rough]
            continue
        target += share[:, k, None] * [lobe.f0, np.sqrt(lobe.alpha)]
    gray = np.maximum(color.luminance(specular), 1e-6)
    new_specular = specular * (target[:, 0] / gray)[:, None]
    values = np.concatenate(
        [maps.normal[atlas.covered], maps.diffuse[atlas.covered], new_specular, target[:, 1:], seen[:, None]], axis=-1
    )
    return replace(on_atlas(atlas, values), albedo_sigma=maps.albedo_sigma)
