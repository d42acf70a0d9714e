"""F0, roughness and scale of the albedo per material, from the radiance in all views and from their maps together.

Each view shows a point of the surface under another half-angle, so all views together sample the lobe of the gloss,
which one view cannot. Texels of like albedo are taken for one material. Its radiance S0 under the flash is

    S0 = E ((g + c (1 − cos θ)) ρ_d D(n, l, v) + F0 S(n, l, v, α))

with the diffuse and the specular law of `optics/shade.py`, E the flash's light at the distance of the point, n, l, v
the normal and the directions to flash and lens, θ the zenith angle, g the factor on the baked albedo ρ_d (1 if it is
right), c the error of the diffuse law, and α the square of the roughness. The samples of a material are averaged in
bins of the half-angle, so that the few samples of a highlight count as much as the many others. For each α, weighted
least squares give F0, g and c; the α with the least misfit is the fit. Errors of the normals widen the lobe: α² is less
by twice their variance, which follows from the differences between the views' normals and the baked ones.

F0 and roughness of the views' maps have a weight in the fit, by their errors. They are medians over the views, because
the errors of one view are alike everywhere. Dielectrics of one object have nearly the same F0, so one F0 is fitted to
all materials, and each may deviate a little from it. The more the errors of the normals widen a highlight, the nearer
its gloss stays to that of the maps. The flash's place near the lens is found first, as the one for
which the half-angle explains the radiance best. Where a chart gives the scale of radiance, the albedo of a material
becomes that of its radiance without the gloss.

References
----------
Lensch et al., Image-based reconstruction of spatial appearance and geometric detail, ACM TOG 2003 (clusters of
materials, lobes from few views); Walter et al. 2007 (GGX).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from polcap.fusion.atlas import Atlas
from polcap.fusion.baking import AtlasMaps, VisibleTexels, on_atlas, visible_texels
from polcap.fusion.lobe_profiles import ALPHAS, LobeProfile, LobeSamples, flash_place, profile
from polcap.fusion.values import FusionView
from polcap.image_values import Floats
from polcap.optics import clusters, color, frames
from polcap.optics.point_light import irradiance
from polcap.stages import stage

_F0S = np.linspace(0.012, 0.09, 14)
_F0_ERROR = 0.0003
_LEAST_F0, _FIXED_SIGMA = 0.005, 0.0005  # where the fit has less, F0 is held there
_SAMPLES = 6000  # of a material, at most
_LEAST_SAMPLES = 300  # of a material, below which its maps are left as they are
_LEAST_SHARE = 0.02  # of the weight in the view that sees most of a material, for a view's maps to count
_LEAST_COSINE = 0.3  # between normal and view: flatter views show errors of the normals
# the numbers below: docs/benchmarks/fusion.md, "Gloss from the highlights of all views"
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
    gain: float  # of the albedo, with which the radiance agrees
    misfit: float  # sum of squared errors, in units of the expected ones


@stage(version=7)
def fit(views: tuple[FusionView, ...], atlas: Atlas, maps: AtlasMaps, settings: MaterialSettings) -> AtlasMaps:
    """Refine F0, roughness and albedo by the radiance in all views; without S0 the maps stay as they are."""
    lit = [view for view in views if view.s0 is not None]
    if not lit:
        return maps
    share = _materials(maps, atlas, settings.materials)  # (N, K)
    visible = visible_texels(lit, atlas)
    samples = _samples(lit, visible, atlas, maps, share)
    flash = flash_place([one for one in samples if one is not None])
    profiles = [None if one is None else profile(one, flash) for one in samples]
    widening = 2 * _normal_sigma(lit, visible, atlas, maps) ** 2
    lobes = _lobes(profiles, widening, settings)
    return _blend(atlas, maps, share, lobes, all(view.white_distance is not None for view in lit))


def _materials(maps: AtlasMaps, atlas: Atlas, count: int) -> Floats:
    """Soft share (N, K) of each texel in each material, by clusters of the encoded albedo."""
    encoded = color.encode_srgb(np.clip(maps.diffuse[atlas.covered], 0, 1)).astype(np.float32)
    seen = maps.seen[atlas.covered]
    center, spread = clusters.color_clusters(encoded[seen], count)
    return clusters.soft_share(encoded, center, spread)


def _samples(
    views: Sequence[FusionView], visible: Sequence[VisibleTexels], atlas: Atlas, maps: AtlasMaps, share: Floats
) -> list[LobeSamples | None]:
    """Samples of each material; None where it has too few."""
    normal, albedo = maps.normal[atlas.covered], color.luminance(maps.diffuse[atlas.covered])
    parts = []
    middle = atlas.position.mean(axis=0)
    for view, texels in zip(views, visible):
        assert view.s0 is not None
        steep = np.flatnonzero(texels.cosine > _LEAST_COSINE)
        point = view.pose.to_camera(atlas.position[texels.texel[steep]])
        to_lens = frames.unit(-point)
        local = frames.to_ray_frame(normal[texels.texel[steep]] @ view.pose.rotation.T, to_lens)
        far = float(np.linalg.norm(view.pose.rotation @ middle + view.pose.translation))
        light = irradiance(point, view.light[:2], 0.0) * (far * (view.white_distance or 1)) ** 2
        radiance = color.luminance(texels.sample(view.s0))[steep] / light
        parts.append((radiance, albedo[texels.texel[steep]], local, point, texels.weight[steep], texels.texel[steep]))
    radiance, base, local, point, weight, texel = (np.concatenate(column) for column in zip(*parts))
    best = share.argmax(axis=1)
    material, gloss = best[texel], _typical_gloss(views, visible, best, share.shape[1])
    found: list[LobeSamples | None] = []
    for k, (f0, rough) in enumerate(gloss):
        mine = np.flatnonzero((material == k) & (weight > 0))
        if len(mine) < _LEAST_SAMPLES:
            found.append(None)
            continue
        mine = mine[np.linspace(0, len(mine) - 1, min(len(mine), _SAMPLES)).astype(int)]
        found.append(LobeSamples(radiance, base, local, point, weight, f0, max(rough**2, ALPHAS[0])).take(mine))
    return found


def _typical_gloss(
    views: Sequence[FusionView], visible: Sequence[VisibleTexels], material: NDArray[np.intp], count: int
) -> list[tuple[float, float]]:
    """F0 and roughness of each material in the maps: medians over the views that see enough of it."""
    rows = np.zeros((len(views), count, 3))  # means of F0 and roughness, weight
    for row, view, texels in zip(rows, views, visible):
        gloss = (
            color.luminance(texels.sample(view.specular)),
            texels.sample(view.roughness)[:, 0],
            np.ones(len(texels.texel)),
        )
        row[:] = np.stack([np.bincount(material[texels.texel], texels.weight * x, count) for x in gloss], axis=-1)
        row[:, :2] /= np.maximum(row[:, 2:], 1e-9)
    enough = rows[..., 2] > _LEAST_SHARE * rows[..., 2].max(axis=0)
    return [tuple(np.median(rows[enough[:, k], k, :2], axis=0)) if enough[:, k].any() else (0.0, 0.0)
            for k in range(count)]  # fmt: skip


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


def _lobes(profiles: Sequence[LobeProfile | None], widening: float, settings: MaterialSettings) -> list[Lobe | None]:
    """Lobe of each material that has a profile, with nearly the same F0.

    Errors of all materials are alike, so together they count as one: their misfits are averaged. A material whose law
    is another adds little.
    """
    known = [one for one in profiles if one is not None]
    if not known:
        return [None] * len(profiles)
    weight = [one.weight for one in known]
    of_maps, alpha = (float(np.average(part, weights=weight)) for part in zip(*((one.f0, one.alpha) for one in known)))
    sigma = settings.f0_sigma * min(1.0, (_BROAD_ALPHA / alpha) ** _BROAD_POWER)

    def misfit(f0: float) -> float:
        each = [_lobe(one, f0, widening, settings.roughness_sigma).misfit for one in known]
        robust = [len(one.radiance) * np.log1p(value / len(one.radiance)) for one, value in zip(known, each)]
        return float(np.average(robust, weights=weight)) + ((f0 - of_maps) / sigma) ** 2

    best = int(np.argmin([misfit(float(f0)) for f0 in _F0S]))
    around = _F0S[max(best - 1, 0)], _F0S[min(best + 1, len(_F0S) - 1)]
    f0 = float(minimize_scalar(misfit, bounds=around, options={"xatol": _F0_ERROR}).x)
    return [None if one is None else _final_lobe(one, f0, widening, settings) for one in profiles]


def _final_lobe(profile: LobeProfile, f0: float, widening: float, settings: MaterialSettings) -> Lobe:
    """The lobe of a material; the more the errors of the normals widen it, the nearer it stays to the maps and `f0`."""
    trust = 1 / (1 + widening / profile.alpha**2)
    return _lobe(profile, f0, widening, settings.roughness_sigma * trust, _OWN_F0_SIGMA * trust)


def _lobe(
    profile: LobeProfile, f0: float, widening: float, roughness_sigma: float, f0_sigma: float = _OWN_F0_SIGMA
) -> Lobe:
    """The lobe that fits a profile best, with an F0 near `f0`; `widening`: of α² by the errors of the normals."""
    terms = np.empty((len(ALPHAS), len(profile.radiance), 3))
    terms[..., 0], terms[..., 1:] = profile.gloss, profile.diffuse
    terms /= profile.error[:, None]
    radiance = profile.radiance / profile.error
    sigma = np.tile([f0_sigma, _GAIN_SIGMA, _LAW_SIGMA], (len(ALPHAS), 1))
    expected = np.tile([f0, 1.0, 0.0], (len(ALPHAS), 1))
    amplitude = _amplitudes(terms, radiance, expected, sigma)
    low = amplitude[:, 0] < _LEAST_F0
    expected[low, 0], sigma[low, 0] = _LEAST_F0, _FIXED_SIGMA
    amplitude = _amplitudes(terms, radiance, expected, sigma)
    narrower = np.sqrt(np.maximum(ALPHAS**2 - widening, ALPHAS[0] ** 2))  # without the errors of the normals
    misfit = np.sum((radiance - np.einsum("abt,at->ab", terms, amplitude)) ** 2, axis=-1)
    misfit += np.sum(((amplitude - expected) / sigma) ** 2, axis=-1)
    misfit += ((np.sqrt(narrower) - np.sqrt(profile.alpha)) / roughness_sigma) ** 2
    best = int(np.clip(np.argmin(misfit), 1, len(ALPHAS) - 2))
    before, least, after = misfit[best - 1 : best + 2]
    bend = before - 2 * least + after
    place = best + float(np.clip((before - after) / (2 * bend), -1, 1) if bend > 0 else 0)  # between steps of α
    f0_there, alpha = (float(np.interp(place, range(len(ALPHAS)), part)) for part in (amplitude[:, 0], narrower))
    diffuse = terms[best, :, 1]
    gain = float(diffuse @ (radiance - amplitude[best, 0] * terms[best, :, 0]) / (diffuse @ diffuse))
    return Lobe(f0_there, alpha, gain, float(least))


def _amplitudes(terms: Floats, radiance: Floats, expected: Floats, sigma: Floats) -> Floats:
    """F0, g and c (A, 3) by least squares around the expected values."""
    tie = sigma**-2
    normal = np.einsum("abs,abt->ast", terms, terms) + tie[..., None] * np.eye(3)
    right = np.einsum("abt,b->at", terms, radiance) + tie * expected
    return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0])


def _blend(atlas: Atlas, maps: AtlasMaps, share: Floats, lobes: Sequence[Lobe | None], scaled: bool) -> AtlasMaps:
    """Maps with F0 and roughness of the lobes and, if `scaled`, the albedo with which the radiance agrees.

    A material without a lobe has the means of its maps.
    """
    specular, roughness = maps.specular[atlas.covered].astype(np.float64), maps.roughness[atlas.covered]
    seen = maps.weight[atlas.covered]
    each = np.empty((len(lobes), 3))  # F0, roughness, gain of the albedo
    for row, part, lobe in zip(each, share.T, lobes):
        weight = part * seen / max(float(part @ seen), 1e-9)
        row[:] = weight @ color.luminance(specular), weight @ roughness, 1
        if lobe is not None:
            row[:] = lobe.f0, np.sqrt(lobe.alpha), lobe.gain if scaled else 1
    f0, rough, gain = (share @ each).T[..., None]
    specular *= f0 / np.maximum(color.luminance(specular), 1e-6)[:, None]
    values = [maps.normal[atlas.covered], gain * maps.diffuse[atlas.covered], specular, rough, seen[:, None]]
    return on_atlas(atlas, np.concatenate(values, axis=-1))
