"""Materials of the sample: groups of texels of like albedo, with the roughness and F0 that all of a group share.

Only few texels show a narrow highlight, each in few views. So every group gets the gloss that fits many of its texels
best: a few values of roughness are tried, and Newton steps on sums of the texels' normal equations start from each that
fits better than its neighbors. Diffuse reflection has a smooth or a rough interface, whichever fits better.
"""

from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from polcap.errors import CaptureError
from polcap.image_values import ArrayValue, Floats
from polcap.material import texel_fit, texel_grid
from polcap.material.coarse_relief import CoarseRelief
from polcap.material.stokes_view import PosedStokes
from polcap.material.texel_fit import LEAST_VIEWS, FitSettings, Measurements, TexelEstimate, TexelPrior
from polcap.material.texel_grid import FlashLight, TexelGrid, TexelViews
from polcap.material.texel_stokes import TexelStokes, measurements
from polcap.optics import body, clusters, color
from polcap.stages import stage

_ROUGHNESS = (0.1, 0.16, 0.25, 0.38, 0.55, 0.8)  # of a group, tried first
_SIDE = 70  # texels along the longer side of the sampled grid
_SAMPLES, _TRIED = 400, 120  # most texels of a group in its fit; in the trial of each `_ROUGHNESS`, about
_LEAST_SAMPLES = 40  # texels of a group that is fitted
_ROUNDS = 4  # Newton steps at most
_INDEPENDENT = 6.0  # texels: a whole group counts as so many, because light, pose and law err alike in all of them
_TIGHT = np.array([1e-3, 1e-4], np.float32)  # 1σ that ties roughness and F0 of a texel to those of its group
_F0, _F0_SIGMA = 0.042, 0.008  # prior of a group's F0
_TEXEL_F0_SIGMA = 0.01  # 1σ of the F0 of single texels about `_F0`, in the first fit
_ROUGH, _ROUGH_SIGMA = 0.45, 0.2  # roughness of texels before a fit, and of groups without one
_LOWEST, _HIGHEST = [0.06, 0.01], [1.0, 0.15]  # limits of a group's roughness and F0
LAWS = {"smooth": body.SMOOTH, "rough": body.Law(rough=1.0)}


class GlossSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the stage `gloss_groups`."""

    materials: Annotated[int, Meta(ge=1, le=32, description="greatest number of materials, grouped by albedo [1]")] = 6
    roughness_sigma: Annotated[float, Meta(gt=0, le=1, description="spread of roughness within a material [1]")] = 0.06
    f0_sigma: Annotated[float, Meta(gt=0, le=1, description="spread of F0 within a material [1]")] = 0.004
    fitting: FitSettings = FitSettings()


@dataclass(frozen=True, repr=False)
class GlossGroups(ArrayValue):
    """Materials of a sample."""

    center: Floats  # (G, 3) sRGB-encoded albedo
    spread: float  # rms distance of such albedos from their center
    roughness: Floats  # (G,)
    f0: Floats  # (G,)
    sigma: Floats  # (G, 2) 1σ of roughness and F0
    law: Literal["smooth", "rough"]

    def prior(self, albedo: Floats, settings: GlossSettings) -> TexelPrior:
        """Expected gloss of texels with albedos (N, 3)."""
        mean = self._mix(albedo, np.stack([self.roughness, self.f0], axis=-1))
        sigma = np.tile(np.array([settings.roughness_sigma, settings.f0_sigma], np.float32), (len(mean), 1))
        return TexelPrior(mean, sigma)

    def sigma_of(self, albedo: Floats) -> Floats:
        """1σ (N, 2) of the roughness and F0 that texels with albedos (N, 3) share with their material."""
        return self._mix(albedo, self.sigma)

    def _mix(self, albedo: Floats, value: Floats) -> Floats:
        """Means (N, ·) of the groups' values (G, ·), by the share of each albedo (N, 3) in each group."""
        share = clusters.soft_share(_encoded(albedo), self.center, self.spread)
        return np.asarray(share @ value, np.float32)


def _encoded(albedo: Floats) -> Floats:
    """Albedo (N, 3), sRGB-encoded, in which groups are formed."""
    return np.asarray(color.encode_srgb(np.clip(albedo, 0, 1)), np.float32)


@stage(version=4)
def find(
    views: tuple[PosedStokes, ...],
    light: FlashLight,
    relief: CoarseRelief,
    grid: TexelGrid,
    stokes: TexelStokes,
    settings: GlossSettings,
) -> GlossGroups:
    """Group texels on an even grid by the albedo of a first fit, and fit the gloss of each group.

    Raises CaptureError: fewer than `LEAST_VIEWS` views show the sample.
    """
    step = max(1, round(max(grid.size) / _SIDE))
    sampled = (slice(step // 2, None, step),) * 2  # rows, columns
    some = TexelStokes(*(part[:, *sampled] for part in (stokes.radiance, stokes.polarized, stokes.noise)))
    data = measurements(some, views)
    known = np.flatnonzero(np.isfinite(data.noise[..., 0]).sum(axis=0) >= LEAST_VIEWS)
    if len(known) < _LEAST_SAMPLES:
        raise CaptureError(
            f"{len(known)} of {data.radiance.shape[1]} sampled texels are seen by {LEAST_VIEWS} views or more, "
            f"{_LEAST_SAMPLES} are needed; expose darker, or name the sample's part with --region"
        )
    point = grid.points(relief.height)[sampled].reshape(-1, 3)[known]
    geometry = texel_grid.geometry(point, [view.pose for view in views], light)
    data = data.take(known)
    prior = TexelPrior.alike((_ROUGH, _F0), (_ROUGH_SIGMA, _TEXEL_F0_SIGMA), len(known))
    first = texel_fit.start(data, geometry, prior, body.SMOOTH)
    fitted = texel_fit.fit(data, geometry, prior, first, body.SMOOTH, settings.fitting, rounds=4)
    return group(data, geometry, fitted.value[:, texel_fit.ALBEDO], settings)


def group(data: Measurements, views: TexelViews, albedo: Floats, settings: GlossSettings) -> GlossGroups:
    """Group sampled texels by their albedo (N, 3), and fit the gloss of each group."""
    encoded, fitting = _encoded(albedo), settings.fitting
    center, spread = clusters.color_clusters(encoded, settings.materials)
    member = clusters.soft_share(encoded, center, spread).argmax(axis=1)
    found: dict[str, tuple[float, Floats, Floats]] = {}  # cost, gloss and its 1σ, by law
    for name, law in LAWS.items():
        gloss = np.tile([_ROUGH, _F0], (len(center), 1))  # of groups with too few texels
        sigma = np.tile([_ROUGH_SIGMA, _F0_SIGMA], (len(center), 1))
        cost = 0.0
        for k in range(len(center)):
            mine = np.flatnonzero(member == k)
            if len(mine) >= _LEAST_SAMPLES:
                some = mine[np.linspace(0, len(mine) - 1, min(len(mine), _SAMPLES)).astype(int)]
                gloss[k], sigma[k], misfit = _fit_shared(data.take(some), views.take(some), law, fitting)
                cost += misfit * len(mine)
        found[name] = cost, gloss, sigma
    law_name: Literal["smooth", "rough"] = "smooth" if found["smooth"][0] <= found["rough"][0] else "rough"
    _, gloss, sigma = found[law_name]
    return GlossGroups(center, spread, gloss[:, 0], gloss[:, 1], sigma, law_name)


def _fit_shared(
    data: Measurements, views: TexelViews, law: body.Law, fitting: FitSettings
) -> tuple[Floats, Floats, float]:
    """Roughness and F0 (2,) that all texels share, their 1σ (2,), and the mean cost of a texel."""
    few = slice(None, None, max(1, data.radiance.shape[1] // _TRIED))
    some, some_views = data.take(few), views.take(few)
    starts = [np.array([rough, _F0]) for rough in _ROUGHNESS]
    costs = [np.inf, *(_fit_texels(some, some_views, gloss, law, fitting)[0] for gloss in starts), np.inf]
    minima = [k for k in range(len(starts)) if costs[k + 1] < min(costs[k], costs[k + 2])]
    return min((_descend(data, views, starts[k], law, fitting) for k in minima), key=lambda found: found[2])


def _descend(
    data: Measurements, views: TexelViews, gloss: Floats, law: body.Law, fitting: FitSettings
) -> tuple[Floats, Floats, float]:
    """Shared gloss (2,) after Newton steps from `gloss`, its 1σ (2,), and the mean cost of a texel."""
    cost, estimate = _fit_texels(data, views, gloss, law, fitting)
    for _ in range(_ROUNDS):
        step, _ = _newton(estimate, gloss)
        for share in (1.0, 0.3):  # a shorter step where the whole one is too long
            trial = np.clip(gloss + share * step, _LOWEST, _HIGHEST)
            trial_cost, trial_estimate = _fit_texels(data, views, trial, law, fitting, estimate.value)
            if trial_cost < cost:
                gloss, cost, estimate = trial, trial_cost, trial_estimate
                break
        else:
            break
    return gloss, _newton(estimate, gloss)[1], cost


def _fit_texels(
    data: Measurements,
    views: TexelViews,
    gloss: Floats,
    law: body.Law,
    fitting: FitSettings,
    first: Floats | None = None,
) -> tuple[float, TexelEstimate]:
    """Estimates of texels that all have one gloss (2,), and their mean cost with the prior of F0."""
    prior = TexelPrior.alike(gloss, _TIGHT, data.radiance.shape[1])
    if first is None:
        first = texel_fit.start(data, views, prior, law)
    else:
        first = np.concatenate([first[:, texel_fit.SLOPES], prior.mean, first[:, texel_fit.ALBEDO]], axis=-1)
    estimate = texel_fit.fit(data, views, prior, first, law, fitting, rounds=5)
    return float(estimate.cost.mean()) + ((gloss[1] - _F0) / _F0_SIGMA) ** 2 / _INDEPENDENT, estimate


def _newton(estimate: TexelEstimate, gloss: Floats) -> tuple[Floats, Floats]:
    """Newton step (2,) of the shared gloss, and its 1σ (2,), from texels that were fitted with it.

    A texel's information matrix I has blocks of gloss (g) and of the other unknowns (u). The information on the gloss
    alone is I_gg − I_gu I_uu⁻¹ I_ug (Schur complement). The gradient is that of the prior that tied the texel's gloss:
    in the texel's optimum it balances that of the data. F0 has a prior for the group, roughness almost none.
    """
    g, u = np.r_[texel_fit.GLOSS], np.r_[texel_fit.SLOPES, texel_fit.ALBEDO]
    information = estimate.information.astype(np.float64)  # (N, 7, 7)
    information[:, g, g] -= _TIGHT.astype(float) ** -2  # that of the prior
    cross = information[:, g[:, None], u]
    inverse = np.linalg.inv(information[:, u[:, None], u] + 1e-6 * np.eye(len(u)))
    of_gloss = information[:, g[:, None], g] - cross @ inverse @ np.swapaxes(cross, 1, 2)
    gradient = (estimate.value[:, texel_fit.GLOSS] - gloss) / _TIGHT.astype(float) ** 2
    total = _INDEPENDENT * of_gloss.mean(axis=0) + np.diag([1e-6, _F0_SIGMA**-2])
    right = _INDEPENDENT * gradient.mean(axis=0) + np.array([0, (_F0 - gloss[1]) / _F0_SIGMA**2])
    covariance = np.linalg.inv(total)
    return np.asarray(covariance @ right), np.sqrt(np.diag(covariance))
