"""Normal, albedo, roughness and F0 of each texel from its Stokes parameters in all views, by least squares.

The light at the camera is E (ρ_d D(n) + F0 S(n, roughness)), with the diffuse and the specular law of `optics/shade.py`
and the irradiance E. Unknown are two slopes, roughness, F0 and three albedos. Data are S0 of three colors, S1 and S2 in
every view. Priors of roughness and F0 are those of the texel's material. Levenberg-Marquardt steps are taken for many
texels at once; a view that contradicts the others, as in a shadow, gets less weight (Cauchy).
"""

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from polcap.image_values import ArrayValue, Bools, Floats, Indices
from polcap.material.texel_grid import TexelViews
from polcap.optics import body, frames, shade

IOR = 1.5  # of the diffuse law and of Fresnel's terms; F0 is free
UNKNOWNS = 7  # slopes to the right and up, roughness, F0, albedo of three colors; their places:
SLOPES, ROUGHNESS, F0, GLOSS, ALBEDO = slice(0, 2), 2, 3, slice(2, 4), slice(4, 7)
KINDS = slice(0, 3), slice(3, 5)  # places of S0 and of S1 and S2 in a view's data
LEAST_VIEWS = 3
_ROUNDS = 9
_STEP = np.array([2e-3, 2e-3, 4e-3], np.float32)  # of the derivatives: slopes, roughness
_LOW = np.array([-1.5, -1.5, 0.06, 0.004, 0.002, 0.002, 0.002], np.float32)  # limits of the unknowns
_HIGH = np.array([1.5, 1.5, 1.0, 0.25, 1.3, 1.3, 1.3], np.float32)
_MOST_STEP = np.array([0.2, 0.2, 0.15, 0.02, 0.3, 0.3, 0.3], np.float32)  # in a round
_SLOPE_SIGMA = 0.5  # 1σ of slopes about 0, prior
_CAUCHY = 2.0  # rms error of a view, in standard deviations, from which its weight falls
_LEAST_DESCENT = 0.01  # of the sum of squared errors; a texel whose next step promises less is finished
_DAMPING = 1e-3  # at the start, relative to the diagonal


class FitSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the stage `texel_fit`."""

    radiance_error: Annotated[
        float, Meta(gt=0, le=0.5, description="error of a view's radiance against the law, besides noise [1]")
    ] = 0.012
    polarization_error: Annotated[
        float,
        Meta(gt=0, le=1, description="error of S1 and S2 over S0, besides noise; 1: polarization is not used [1]"),
    ] = 0.003


@dataclass(frozen=True, repr=False)
class Measurements(ArrayValue):
    """Stokes parameters of N texels in K views."""

    radiance: Floats  # (K, N, 3) S0, linear Rec.709
    polarized: Floats  # (K, N, 2)
    noise: Floats  # (K, N, 2) as in `TexelStokes`
    gray: Floats  # (3,) weights of the colors in `polarized`

    def take(self, index: Indices | slice) -> "Measurements":
        """The data of some of the texels."""
        return Measurements(self.radiance[:, index], self.polarized[:, index], self.noise[:, index], self.gray)


@dataclass(frozen=True, repr=False)
class TexelPrior(ArrayValue):
    """Expected roughness and F0 of N texels, with their 1σ."""

    mean: Floats  # (N, 2)
    sigma: Floats  # (N, 2)

    @classmethod
    def alike(cls, mean: Floats | tuple[float, float], sigma: Floats | tuple[float, float], count: int) -> "TexelPrior":
        """The same prior for `count` texels; mean and 1σ (2,)."""
        return cls(*(np.tile(np.asarray(one, np.float32), (count, 1)) for one in (mean, sigma)))

    def take(self, index: Indices | slice) -> "TexelPrior":
        """The priors of some of the texels."""
        return TexelPrior(self.mean[index], self.sigma[index])


@dataclass(frozen=True, repr=False)
class TexelEstimate(ArrayValue):
    """Values of N texels, and the least-squares problem linearized there."""

    value: Floats  # (N, 7)
    information: Floats  # (N, 7, 7) of data and priors
    by_kind: Floats  # (2, N, 7, 7) information of S0 alone, and of S1 and S2
    gradient: Floats  # (N, 7) half the negative gradient of `total`
    cost: Floats  # (N,) of the data, robust
    total: Floats  # (N,) of data and priors
    error: Floats  # (K, N, 5) measured minus modelled, in standard deviations; 0 where not measured
    model: Floats  # (K, N) modelled S0, gray

    @property
    def normal(self) -> Floats:
        """Unit normals (N, 3) in the plane's frame."""
        return normals(self.value)

    def replace_texels(self, index: Indices, other: "TexelEstimate", chosen: Bools) -> None:
        """Overwrite the texels at `index` by the chosen ones of another estimate."""
        for name, array in vars(self).items():
            first = (slice(None),) if name in ("by_kind", "error", "model") else ()  # axis before that of the texels
            array[*first, index] = getattr(other, name)[*first, chosen]


def normals(value: Floats) -> Floats:
    """Unit normals (..., 3) in the plane's frame, from slopes in the first two columns."""
    return np.asarray(frames.unit(np.concatenate([-value[..., SLOPES], np.ones_like(value[..., :1])], axis=-1)))


def responses(slope: Floats, roughness: Floats, views: TexelViews, law: body.Law) -> Floats:
    """Stokes parameters (3, K, N, 2) of texels in K views: diffuse reflection for albedo 1, gloss for F0 1."""
    normal = (views.normal_to_ray @ normals(slope)[:, :, None])[..., 0]
    albedo, f0 = (np.array(v, np.float32) for v in ((1, 0), (0, 1)))
    rough, ior = np.broadcast_to(roughness, normal.shape[:2]), np.full((1, 1), IOR, np.float32)
    return np.asarray(shade.stokes(normal, albedo, f0, rough, ior, views.to_light, views.irradiance, law))


def start(data: Measurements, views: TexelViews, prior: TexelPrior, law: body.Law) -> Floats:
    """First values (N, 7): flat texels with the prior's gloss, and the albedo of the median view."""
    flat = np.zeros((data.radiance.shape[1], 2), np.float32)
    diffuse, specular = np.moveaxis(responses(flat, prior.mean[:, 0], views, law)[0], -1, 0)
    albedo = (data.radiance - (specular * prior.mean[:, 1])[..., None]) / np.maximum(diffuse, 1e-6)[..., None]
    known = np.isfinite(data.noise[..., :1])
    albedo = np.nan_to_num(np.nanmedian(np.where(known, albedo, np.nan), axis=0), nan=0.2)  # 0.2: not seen
    return np.clip(np.concatenate([flat, prior.mean, albedo], axis=-1).astype(np.float32), _LOW, _HIGH)


def fit(
    data: Measurements,
    views: TexelViews,
    prior: TexelPrior,
    value: Floats,
    law: body.Law,
    settings: FitSettings,
    rounds: int = _ROUNDS,
) -> TexelEstimate:
    """Estimate all unknowns of N texels from first values (N, 7)."""
    sigma = _sigma(data, settings)
    best = _linearize(data, views, prior, value.copy(), law, sigma)
    damping = np.full(len(value), _DAMPING, np.float32)
    eye = np.eye(UNKNOWNS, dtype=np.float32)
    active = np.arange(len(value))  # texels that are not finished
    for _ in range(rounds):
        information, gradient, first = best.information[active], best.gradient[active], best.value[active]
        diagonal = np.einsum("nii->ni", information)
        system = information + (damping[active, None] * diagonal + 1e-6)[:, :, None] * eye
        step = np.clip(np.linalg.solve(system, gradient[..., None])[..., 0], -_MOST_STEP, _MOST_STEP)
        second = np.clip(first + step, _LOW, _HIGH)
        unfinished = ((second - first) * gradient).sum(axis=-1) > _LEAST_DESCENT
        active, second = active[unfinished], second[unfinished]
        if len(active) == 0:
            break
        some = data.take(active), views.take(active), prior.take(active)
        trial = _linearize(*some, second, law, sigma[:, active])
        better = trial.total < best.total[active]
        damping[active] = np.clip(np.where(better, damping[active] / 4, damping[active] * 8), 1e-6, 1e4)
        best.replace_texels(active[better], trial, better)
    return best


def _sigma(data: Measurements, settings: FitSettings) -> Floats:
    """1σ (K, N, 5) of three colors, S1 and S2: noise, and errors in proportion to S0."""
    level = np.maximum(data.radiance, 0) @ data.gray
    # three colors share the errors of light and geometry, so each counts by a third; a dark one errs like 0.3 of gray
    colors = np.sqrt(3) * np.hypot(
        data.noise[..., :1], settings.radiance_error * np.maximum(data.radiance, 0.3 * level[..., None])
    )
    polarized = np.hypot(data.noise[..., 1], settings.polarization_error * level)
    sigma = np.concatenate([colors, np.repeat(polarized[..., None], 2, axis=-1)], axis=-1)
    return np.where(np.isfinite(sigma), np.maximum(sigma, 1e-6), np.inf).astype(np.float32)


def misfit(data: Measurements, found: TexelEstimate, settings: FitSettings) -> tuple[Floats, Floats]:
    """Sums of squared errors (N, 2) of S0 and of S1 and S2, in expected 1σ, and their degrees of freedom (N, 2).

    S0 is gray: its colors share the errors of light and geometry, and noise of color hardly changes a normal.
    """
    known = np.isfinite(data.noise[..., 0])
    level = np.maximum(data.radiance, 0) @ data.gray
    expected = np.where(known, np.hypot(data.noise[..., 0], settings.radiance_error * level), np.inf)
    gray = np.where(known, data.radiance @ data.gray - found.model, 0) / np.maximum(expected, 1e-6)
    squares = np.stack([gray**2, (found.error[..., KINDS[1]] ** 2).sum(axis=-1)], axis=-1)
    used = np.einsum("nij,knji->nk", np.linalg.inv(found.information.astype(np.float64)), found.by_kind)
    used = np.maximum(used - [2, 0], 0)  # unknowns that each kind of data determines; two of the albedo are not gray
    freedom = np.maximum(known.sum(axis=0)[:, None] * [1, 2] - used, 0)
    return (_robust_weight(found.error)[..., None] * squares).sum(axis=0), freedom


def _linearize(
    data: Measurements, views: TexelViews, prior: TexelPrior, value: Floats, law: body.Law, sigma: Floats
) -> TexelEstimate:
    """Errors and normal equations at values (N, 7); derivatives of slopes and roughness are differences."""
    slope, rough, f0, albedo = value[:, SLOPES], value[:, ROUGHNESS], value[:, F0], value[:, ALBEDO]
    gray = data.gray.astype(np.float32)
    gray_albedo = albedo @ gray

    def light(response: Floats) -> Floats:  # (K, N, 5): three colors of S0, gray S1 and S2
        s0, polarized = response[0], response[1:]
        colors = s0[..., :1] * albedo + (s0[..., 1] * f0)[..., None]
        s1_s2 = polarized[..., 0] * gray_albedo + polarized[..., 1] * f0
        return np.concatenate([colors, np.moveaxis(s1_s2, 0, -1)], axis=-1)

    response = responses(slope, rough, views, law)
    across, up = _STEP[0] * np.array([[1, 0], [0, 1]], np.float32)
    changed = (slope + across, rough), (slope + up, rough), (slope, rough + _STEP[2])
    model, measured = light(response), np.concatenate([data.radiance, data.polarized], axis=-1)
    jacobian = np.empty((*model.shape, UNKNOWNS), np.float32)
    for k, (values, step) in enumerate(zip(changed, _STEP, strict=True)):
        jacobian[..., k] = (light(responses(*values, views, law)) - model) / step
    jacobian[..., :3, F0] = response[0, ..., 1:]
    jacobian[..., 3:, F0] = np.moveaxis(response[1:, ..., 1], 0, -1)
    jacobian[..., :3, ALBEDO] = response[0, ..., 0, None, None] * np.eye(3, dtype=np.float32)
    jacobian[..., 3:, ALBEDO] = np.moveaxis(response[1:, ..., 0], 0, -1)[..., None] * gray
    known = np.isfinite(sigma)
    weight = np.where(known, 1 / sigma, 0).astype(np.float32)
    error = np.where(known, measured - model, 0) * weight
    mean_square = (error**2).sum(axis=-1) / 5
    root = np.sqrt(_robust_weight(error))[..., None]
    jacobian *= (weight * root)[..., None]
    by_kind, gradient = np.empty((len(KINDS), len(value), UNKNOWNS, UNKNOWNS), np.float32), np.zeros_like(value)
    for part, kind in zip(by_kind, KINDS, strict=True):
        rows = np.moveaxis(jacobian[:, :, kind], 0, 1).reshape(len(value), -1, UNKNOWNS)  # (N, 3K or 2K, 7)
        errors = np.moveaxis((error * root)[..., kind], 0, 1).reshape(len(value), -1, 1)
        transposed = np.swapaxes(rows, 1, 2)
        part[:] = transposed @ rows
        gradient += (transposed @ errors)[..., 0]
    information = by_kind.sum(axis=0)
    cost = 5 * _CAUCHY**2 * np.log1p(mean_square / _CAUCHY**2).sum(axis=0)
    pull, tie = _priors(prior, value)
    information[:, range(4), range(4)] += tie
    gradient[:, :4] += pull * tie
    total = cost + (pull**2 * tie).sum(axis=-1)
    return TexelEstimate(value, information, by_kind, gradient, cost, total, error, model[..., :3] @ gray)


def _robust_weight(error: Floats) -> Floats:
    """Weight (K, N) of each view, from its errors (K, N, 5) in standard deviations (Cauchy)."""
    return np.asarray(1 / (1 + (error**2).mean(axis=-1) / _CAUCHY**2))


def _priors(prior: TexelPrior, value: Floats) -> tuple[Floats, Floats]:
    """Distance (N, 4) from the priors of slopes, roughness and F0, and their inverse variances."""
    mean = np.concatenate([np.zeros_like(prior.mean), prior.mean], axis=-1)
    sigma = np.concatenate([np.full_like(prior.mean, _SLOPE_SIGMA), prior.sigma], axis=-1)
    return (mean - value[:, :4]).astype(np.float32), (sigma**-2).astype(np.float32)
