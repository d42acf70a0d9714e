"""F0, roughness and scale of the albedo per material, from the radiance in all views and from their maps together.

Each view shows a point of the surface under another half-angle, so all views together sample the lobe of the gloss,
which one view cannot. Texels of like albedo are taken for one material. Its radiance S0 under the flash is

    S0 = E ((g + c (1 − cos θ)) ρ_d D(n, l, v) + F0 S(n, l, v, α))

with the diffuse and the specular law of `optics/shade.py`, E the flash's light at the distance of the point, n, l, v
the normal and the directions to flash and lens, θ the zenith angle, g the factor on the baked albedo ρ_d (1 if it is
right), c the error of the diffuse law, and α the square of the roughness.

The flash's place near the lens is the one for which the half-angle explains the radiance best. The samples of a
material are averaged in bins of the half-angle, so that the few samples of a highlight count as much as the many
others. For each α, weighted least squares give F0, g and c; the α with the least misfit is the fit. Errors of the
normals widen the lobe: α² is less by twice their variance. Where a chart gives the scale of radiance, the albedo of a
material becomes that of its radiance without the gloss.

F0 and roughness of the views' maps have a weight in the fit, by their errors. They are medians over the views, because
the errors of one view are alike everywhere. Dielectrics of one object have nearly the same F0, so one F0 is fitted to
all materials, and each may deviate a little from it. The more the errors of the normals widen a highlight, the nearer
its gloss stays to that of the maps.

References
----------
Lensch et al., Image-based reconstruction of spatial appearance and geometric detail, ACM TOG 2003 (clusters of
materials, lobes from few views); Walter et al. 2007 (GGX).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from polcap.fusion import baking
from polcap.fusion.atlas import Atlas
from polcap.fusion.baking import AtlasMaps, VisibleTexels, visible_texels
from polcap.fusion.lobe_profiles import ALPHAS, LobeProfile, LobeSamples, flash_place, profile
from polcap.fusion.values import FusionView
from polcap.image_values import Floats
from polcap.optics import clusters, color, frames
from polcap.optics.point_light import irradiance
from polcap.stages import stage

_F0S = np.linspace(0.012, 0.09, 14)  # of all materials, tried first
_F0_ERROR = 0.0003  # at which the search between them ends
_LEAST_F0, _LEAST_F0_SIGMA = 0.005, 0.0005  # an F0 that would be less gets this one as its prior, with this 1σ
_SAMPLES = 6000  # of a material, at most
_LEAST_SAMPLES = 300  # of a material, below which its maps are left as they are
_LEAST_SHARE = 0.02  # of a view's maps that count: weight on a material, over that of the view that sees most of it
_LEAST_COSINE = 0.3  # between normal and view: flatter views show errors of the normals
# the numbers below: docs/benchmarks/fusion-choices.md, "Textures and gloss"
_GAIN_SIGMA, _LAW_SIGMA = 0.15, 0.1  # of g and c
_OWN_F0_SIGMA = 0.004  # of a material's F0 about the F0 of all
_BROAD_ALPHA, _BROAD_POWER = 0.35, 4  # beyond, a highlight is so like the shading that F0 stays near that of the maps
_NORMAL_FACING = 0.9  # cosine between surface and view, from which on views' and baked normals are compared
_NORMAL_ERROR = 1.3  # standard deviation over that of the views' differences; errors have longer tails


class MaterialSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the stage `material_fit` of the fusion."""

    materials: Annotated[int, Meta(ge=1, le=32, description="greatest number of materials, grouped by albedo [1]")] = 8
    f0_sigma: Annotated[
        float, Meta(gt=0, le=1, description="error of F0 in the views' maps, where highlights are narrow [1]")
    ] = 0.012
    roughness_sigma: Annotated[float, Meta(gt=0, le=1, description="error of roughness in the views' maps [1]")] = 0.06


@dataclass(frozen=True)
class Lobe:
    """Gloss of one material."""

    f0: float
    alpha: float
    gain: float  # g, by which the albedo agrees with the radiance if c = 0
    misfit: float  # sum of squared errors, in units of the expected ones


@stage(version=7)
def fit(views: tuple[FusionView, ...], atlas: Atlas, maps: AtlasMaps, settings: MaterialSettings) -> AtlasMaps:
    """Refine F0, roughness and albedo by the radiance in all views; without S0 the maps stay as they are."""
    lit = [view for view in views if view.s0 is not None]
    if not lit:
        return maps
    share = _cluster_materials(maps, atlas, settings.materials)  # (N, K)
    visible = visible_texels(lit, atlas)
    samples = _collect_samples(lit, visible, atlas, maps, share)
    flash = flash_place(list(samples.values()))
    profiles = {k: found for k, one in samples.items() if (found := profile(one, flash))}
    widening = 2 * _normal_sigma(lit, visible, atlas, maps) ** 2
    lobes = _fit_lobes(profiles, widening, settings)
    return _apply(atlas, maps, share, lobes, all(view.white_distance is not None for view in lit))


def _cluster_materials(maps: AtlasMaps, atlas: Atlas, count: int) -> Floats:
    """Soft share (N, K) of each texel in each material, by clusters of the encoded albedo."""
    encoded = color.encode_srgb(np.clip(maps.diffuse[atlas.covered], 0, 1)).astype(np.float32)
    center, spread = clusters.color_clusters(encoded[maps.seen[atlas.covered]], count)
    return clusters.soft_share(encoded, center, spread)


def _collect_samples(
    views: Sequence[FusionView], visible: Sequence[VisibleTexels], atlas: Atlas, maps: AtlasMaps, share: Floats
) -> dict[int, LobeSamples]:
    """Samples of each material that has enough of them, by its number."""
    normal, albedo = maps.normal[atlas.covered], color.luminance(maps.diffuse[atlas.covered])
    middle = atlas.position.mean(axis=0)
    parts = []
    for view, texels in zip(views, visible):
        assert view.s0 is not None
        use = np.flatnonzero(texels.cosine > _LEAST_COSINE)
        texel = texels.texel[use]
        point = view.pose.to_camera(atlas.position[texel])
        local = frames.to_ray_frame(normal[texel] @ view.pose.rotation.T, frames.unit(-point))
        distance = float(np.linalg.norm(view.pose.rotation @ middle + view.pose.translation))
        light = irradiance(point, np.zeros(2), 0.0) * (distance * (view.white_distance or 1)) ** 2
        radiance = color.luminance(texels.sample(view.s0))[use] / light
        parts.append((radiance, albedo[texel], local, point, texels.weight[use], texel))
    radiance, base, local, point, weight, texel = (np.concatenate(column) for column in zip(*parts))
    best = share.argmax(axis=1)
    found = {}
    for k, (f0, roughness) in enumerate(_typical_gloss(views, visible, best, share.shape[1])):
        mine = np.flatnonzero((best[texel] == k) & (weight > 0))
        if len(mine) >= _LEAST_SAMPLES:
            mine = mine[np.linspace(0, len(mine) - 1, min(len(mine), _SAMPLES)).astype(int)]
            samples = LobeSamples(radiance, base, local, point, weight, f0, max(roughness**2, ALPHAS[0]))
            found[k] = samples.take(mine)
    return found


def _typical_gloss(
    views: Sequence[FusionView], visible: Sequence[VisibleTexels], material: NDArray[np.intp], count: int
) -> list[tuple[float, float]]:
    """F0 and roughness of each material in the maps: medians over the views that see enough of it; else 0."""
    gloss, total = np.zeros((len(views), count, 2)), np.zeros((len(views), count))  # means of each view, their weight
    for mean, weight, view, texels in zip(gloss, total, views, visible):
        mine = material[texels.texel]
        weight[:] = np.bincount(mine, texels.weight, count)
        for k, value in enumerate((color.luminance(texels.sample(view.specular)), texels.sample(view.roughness))):
            mean[:, k] = np.bincount(mine, texels.weight * value, count) / np.maximum(weight, 1e-9)
    enough = total > _LEAST_SHARE * total.max(axis=0)
    return [
        tuple(np.median(gloss[enough[:, k], k], axis=0)) if enough[:, k].any() else (0.0, 0.0) for k in range(count)
    ]


def _normal_sigma(
    views: Sequence[FusionView], visible: Sequence[VisibleTexels], atlas: Atlas, maps: AtlasMaps
) -> float:
    """Error of the baked normals per axis [rad], from the angles between them and the views' normals."""
    normal, angles = maps.normal[atlas.covered], []
    for view, texels in zip(views, visible):
        facing = np.flatnonzero(texels.cosine > _NORMAL_FACING)
        own = frames.unit(texels.sample(view.normal)[facing]) @ view.pose.rotation
        angles.append(np.arccos(np.clip(frames.dot(own, normal[texels.texel[facing]]), -1, 1)))
    angle = np.concatenate(angles)
    return _NORMAL_ERROR * float(np.median(angle)) / np.sqrt(2 * np.log(2)) if len(angle) else 0.0  # Rayleigh's law


def _fit_lobes(profiles: Mapping[int, LobeProfile], widening: float, settings: MaterialSettings) -> dict[int, Lobe]:
    """Lobes of the materials, with nearly the same F0; errors of the normals add `widening` to each α².

    The materials share their errors, so together they count as one: their misfits are averaged. The logarithm limits
    the misfit of a material that does not follow the law.
    """
    if not profiles:
        return {}
    found = list(profiles.values())
    weight = [one.weight for one in found]
    f0_of_maps = float(np.average([one.f0 for one in found], weights=weight))
    alpha_of_maps = float(np.average([one.alpha for one in found], weights=weight))
    sigma = settings.f0_sigma * min(1.0, (_BROAD_ALPHA / alpha_of_maps) ** _BROAD_POWER)

    def misfit(f0: float) -> float:
        each = [_fit_lobe(one, f0, _OWN_F0_SIGMA, settings.roughness_sigma, widening).misfit for one in found]
        robust = [len(one.radiance) * np.log1p(value / len(one.radiance)) for one, value in zip(found, each)]
        return float(np.average(robust, weights=weight)) + ((f0 - f0_of_maps) / sigma) ** 2

    best = int(np.argmin([misfit(float(f0)) for f0 in _F0S]))
    around = _F0S[max(best - 1, 0)], _F0S[min(best + 1, len(_F0S) - 1)]
    f0 = float(minimize_scalar(misfit, bounds=around, options={"xatol": _F0_ERROR}).x)
    lobes = {}
    for k, one in profiles.items():
        # a highlight that errors of the normals widen says less: F0 and roughness stay nearer to what is expected
        trust = 1 / (1 + widening / one.alpha**2)
        lobes[k] = _fit_lobe(one, f0, _OWN_F0_SIGMA * trust, settings.roughness_sigma * trust, widening)
    return lobes


def _fit_lobe(profile: LobeProfile, f0: float, f0_sigma: float, roughness_sigma: float, widening: float) -> Lobe:
    """The lobe that fits a profile best, near `f0` and near the roughness of the maps."""
    terms = np.empty((len(ALPHAS), len(profile.radiance), 3))  # of F0, g and c, in 1σ of the radiance
    terms[..., 0], terms[..., 1:] = profile.specular, profile.diffuse
    terms /= profile.error[:, None]
    radiance = profile.radiance / profile.error
    sigma = np.tile([f0_sigma, _GAIN_SIGMA, _LAW_SIGMA], (len(ALPHAS), 1))
    expected = np.tile([f0, 1.0, 0.0], (len(ALPHAS), 1))
    amplitude = _amplitudes(terms, radiance, expected, sigma)
    low = amplitude[:, 0] < _LEAST_F0
    expected[low, 0], sigma[low, 0] = _LEAST_F0, _LEAST_F0_SIGMA
    amplitude = _amplitudes(terms, radiance, expected, sigma)
    alphas = np.sqrt(np.maximum(ALPHAS**2 - widening, ALPHAS[0] ** 2))  # without the errors of the normals
    misfit = np.sum((radiance - np.einsum("abt,at->ab", terms, amplitude)) ** 2, axis=-1)
    misfit += np.sum(((amplitude - expected) / sigma) ** 2, axis=-1)
    misfit += ((np.sqrt(alphas) - np.sqrt(profile.alpha)) / roughness_sigma) ** 2
    best = int(np.clip(np.argmin(misfit), 1, len(ALPHAS) - 2))
    before, least, after = misfit[best - 1 : best + 2]
    bend = before - 2 * least + after
    place = best + float(np.clip((before - after) / (2 * bend), -1, 1) if bend > 0 else 0)  # vertex of a parabola
    own_f0, alpha = (float(np.interp(place, range(len(ALPHAS)), part)) for part in (amplitude[:, 0], alphas))
    diffuse = terms[best, :, 1]
    gain = float(diffuse @ (radiance - amplitude[best, 0] * terms[best, :, 0]) / (diffuse @ diffuse))
    return Lobe(own_f0, alpha, gain, float(least))


def _amplitudes(terms: Floats, radiance: Floats, expected: Floats, sigma: Floats) -> Floats:
    """F0, g and c (A, 3) by least squares, with their expected values (A, 3) as priors of 1σ `sigma` (A, 3)."""
    tie = sigma**-2
    normal = np.einsum("abs,abt->ast", terms, terms) + tie[..., None] * np.eye(3)
    right = np.einsum("abt,b->at", terms, radiance) + tie * expected
    return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0])


def _apply(atlas: Atlas, maps: AtlasMaps, share: Floats, lobes: Mapping[int, Lobe], scaled: bool) -> AtlasMaps:
    """Maps with F0 and roughness of the lobes and, if `scaled`, the albedo with which the radiance agrees.

    A material without a lobe has the means of its maps.
    """
    values = maps.texels(atlas.covered)
    specular, seen = values[:, baking.SPECULAR].astype(np.float64), values[:, baking.WEIGHT]
    materials = np.empty((share.shape[1], 3))  # F0, roughness, gain of the albedo
    for k, part in enumerate(share.T):
        if k in lobes:
            materials[k] = lobes[k].f0, np.sqrt(lobes[k].alpha), lobes[k].gain if scaled else 1
        else:
            weight = part * seen / max(float(part @ seen), 1e-9)
            materials[k] = weight @ color.luminance(specular), weight @ values[:, baking.ROUGHNESS], 1
    f0, values[:, baking.ROUGHNESS], gain = (share @ materials).T
    values[:, baking.SPECULAR] = specular * (f0 / np.maximum(color.luminance(specular), 1e-6))[:, None]
    values[:, baking.DIFFUSE] = gain[:, None] * values[:, baking.DIFFUSE]
    return baking.on_atlas(atlas, values)
