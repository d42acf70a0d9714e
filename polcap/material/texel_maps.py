"""Fits of all texels, in tiles that bound the memory, as maps with the doubt of every value."""

from dataclasses import dataclass

import cv2
import numpy as np

from polcap.image_values import ArrayValue, Bools, Floats
from polcap.material import texel_fit, texel_grid
from polcap.material.coarse_relief import CoarseRelief
from polcap.material.gloss_groups import LAWS, GlossGroups, GlossSettings
from polcap.material.stokes_view import PosedStokes
from polcap.material.texel_fit import KINDS, LEAST_VIEWS, UNKNOWNS, Measurements, TexelEstimate, TexelPrior
from polcap.material.texel_grid import FlashLight, TexelGrid, TexelViews
from polcap.material.texel_stokes import TexelStokes, measurements
from polcap.stages import stage

_TILE = 16_000  # texels
_AROUND = 3  # texels, 1σ, over which the misfit is averaged
_PRIOR_FREEDOM = 0.1  # degrees of freedom with errors as expected, added everywhere: three views may leave none
_FIRST_ROUNDS = 3  # of the fits that give the albedo, by which the material is chosen


@dataclass(frozen=True, repr=False)
class TexelMaps(ArrayValue):
    """Estimates of all texels; arrays (H, W, …)."""

    value: Floats  # (H, W, 7) as in `texel_fit`
    sigma: Floats  # (H, W, 7) 1σ
    seen: Bools  # (H, W) measured in three views or more
    misfit: Floats  # (K,) rms error of each view over the expected one
    residual: Floats  # (K,) median of |measured − modelled| S0 over S0


@stage(version=4)
def estimate(
    views: tuple[PosedStokes, ...],
    light: FlashLight,
    relief: CoarseRelief,
    grid: TexelGrid,
    stokes: TexelStokes,
    gloss: GlossGroups,
    settings: GlossSettings,
) -> TexelMaps:
    """Fit all texels of the sample."""
    width, height = grid.size
    value = np.zeros((height, width, UNKNOWNS), np.float32)
    variance = np.zeros((height, width, len(KINDS) + 1, UNKNOWNS), np.float32)
    squares, freedom = np.zeros((2, height, width, len(KINDS)), np.float32)
    residual = np.zeros((len(views), height, width), np.float16)
    error_squares, error_count = np.zeros((2, len(views)))
    point, poses = grid.points(relief.height), [view.pose for view in views]
    rows = max(1, _TILE // width)
    for top in range(0, height, rows):
        strip = slice(top, min(top + rows, height))
        data = measurements(stokes.rows(strip), views)
        geometry = texel_grid.geometry(point[strip].reshape(-1, 3), poses, light)
        found, by_cause = _fit(data, geometry, gloss, settings)
        parts = (found.value, by_cause, *texel_fit.misfit(data, found, settings.fitting))
        for target, part in zip((value, variance, squares, freedom), parts, strict=True):
            target[strip] = part.reshape(target[strip].shape)
        known = np.isfinite(data.noise[..., 0])
        error_squares += (found.error**2).sum(axis=(1, 2))
        error_count += 5 * known.sum(axis=1)  # of three colors, S1 and S2
        error = np.abs(data.radiance @ data.gray - found.model) / np.maximum(found.model, 1e-3)
        residual[:, strip] = np.where(known, error, np.nan).reshape(residual[:, strip].shape)
    measured = np.isfinite(stokes.noise[..., 0]).sum(axis=0) >= LEAST_VIEWS
    squares, freedom = (cv2.GaussianBlur(one, (0, 0), _AROUND) + _PRIOR_FREEDOM for one in (squares, freedom))
    variance[:, :, : len(KINDS)] *= (squares / freedom)[..., None]
    with np.errstate(all="ignore"):  # NaN for a view without any of these texels
        median = np.nanmedian(residual[:, measured].astype(np.float32), axis=1)
    return TexelMaps(
        value=value,
        sigma=np.sqrt(variance.sum(axis=2)),
        seen=measured,
        misfit=np.sqrt(error_squares / np.maximum(error_count, 1)),
        residual=median,
    )


def _fit(
    data: Measurements, geometry: TexelViews, gloss: GlossGroups, settings: GlossSettings
) -> tuple[TexelEstimate, Floats]:
    """Estimates of N texels, and their `variances`. The albedo of a texel gives its material, and so its prior.

    The albedo becomes more exact with each step: median radiance of the views, flat texels, fit of a few rounds.
    """
    law = LAWS[gloss.law]
    radiance = np.median(np.where(np.isfinite(data.noise[..., :1]), data.radiance, 0), axis=0)
    flat = texel_fit.start(data, geometry, gloss.prior(np.clip(radiance, 0, 1), settings), law)
    prior = gloss.prior(flat[:, texel_fit.ALBEDO], settings)
    few = texel_fit.fit(data, geometry, prior, flat, law, settings.fitting, _FIRST_ROUNDS).value
    prior = gloss.prior(few[:, texel_fit.ALBEDO], settings)
    found = texel_fit.fit(data, geometry, prior, few, law, settings.fitting)
    return found, variances(found, prior, gloss.sigma_of(few[:, texel_fit.ALBEDO]))


def variances(found: TexelEstimate, prior: TexelPrior, shared: Floats) -> Floats:
    """Variances (N, 3, 7) of texels by cause: expected errors of S0, those of S1 and S2, and priors.

    The third cause includes the 1σ `shared` (N, 2) of the roughness and F0 of the texels' material.
    """
    covariance = np.linalg.inv(found.information.astype(np.float64))
    response = covariance[:, :, texel_fit.GLOSS] / prior.sigma[:, None, :] ** 2  # to a change of the prior's mean
    data = np.einsum("knij,nij->nki", covariance @ found.by_kind, covariance)
    priors = np.maximum(np.einsum("nii->ni", covariance) - data.sum(axis=1), 0)
    priors += np.square(response * shared[:, None, :]).sum(axis=-1)
    return np.concatenate([data, priors[:, None]], axis=1)
