"""Fits of all texels, in tiles that bound the memory, as maps with the doubt of every value."""

from dataclasses import dataclass

import cv2
import numpy as np

from polcap.images import ArrayValue, Bools, Floats
from polcap.material import texel_fit, texel_grid
from polcap.material.coarse_relief import CoarseRelief, measurements
from polcap.material.gloss_groups import LAWS, GlossGroups, GlossSettings
from polcap.material.stokes_view import PosedStokes
from polcap.material.texel_fit import (
    ALBEDO,
    GLOSS,
    LEAST_VIEWS,
    UNKNOWNS,
    Measurements,
    TexelEstimate,
    TexelPrior,
)
from polcap.material.texel_grid import FlashLight, TexelGrid, TexelViews
from polcap.material.texel_stokes import TexelStokes
from polcap.stages import stage

_TILE = 16_000  # texels
_AROUND = 3  # texels, 1σ, over which the misfit is averaged
_FIRST_ROUNDS = 3  # of the fits that give the albedo, by which the material is chosen


@dataclass(frozen=True, repr=False)
class TexelMaps(ArrayValue):
    """Estimates of all texels; arrays (H, W, …)."""

    value: Floats  # (H, W, 7) as in `texel_fit`
    sigma: Floats  # (H, W, 7) 1σ
    seen: Bools  # (H, W) measured in three views or more
    misfit: Floats  # (K,) rms error of each view over the expected one
    residual: Floats  # (K,) median of |measured − modelled| S0 over S0


@stage(version=3)
def estimate(
    views: tuple[PosedStokes, ...],
    light: FlashLight,
    relief: CoarseRelief,
    grid: TexelGrid,
    seen: TexelStokes,
    gloss: GlossGroups,
    settings: GlossSettings,
) -> TexelMaps:
    """Fit all texels of the sample."""  # fmt: skip
    width, height = grid.size
    value = np.zeros((height, width, UNKNOWNS), np.float32)
    sigma, common = np.full_like(value, np.inf), np.zeros_like(value)
    cost, residual = np.zeros((height, width), np.float32), np.zeros((len(views), height, width), np.float16)
    square: Floats = np.zeros((len(views), 2))  # sum of squared errors, number
    point, poses = grid.points(relief.height), [view.pose for view in views]
    rows = max(1, _TILE // width)
    for top in range(0, height, rows):
        strip = slice(top, min(top + rows, height))
        data = measurements(seen.rows(strip), views)
        geometry = texel_grid.geometry(point[strip].reshape(-1, 3), poses, light)
        found, own_sigma, shared_sigma = _fit(data, geometry, gloss, settings)
        shape = value[strip].shape
        value[strip], sigma[strip] = found.value.reshape(shape), own_sigma.reshape(shape)
        common[strip] = shared_sigma.reshape(shape)
        known = np.isfinite(data.noise[..., 0])
        cost[strip] = (found.cost / np.maximum(5 * known.sum(axis=0) - UNKNOWNS + 2, 5)).reshape(shape[:2])
        square += np.stack([(found.error**2).sum(axis=(1, 2)), 5.0 * known.sum(axis=1)], axis=-1)
        error = np.abs(data.radiance @ data.gray - found.model) / np.maximum(found.model, 1e-3)
        residual[:, strip] = np.where(known, error, np.nan).reshape(-1, *shape[:2])
    measured = np.isfinite(seen.noise[..., 0]).sum(axis=0) >= LEAST_VIEWS
    scale = np.sqrt(np.maximum(cv2.GaussianBlur(cost, (0, 0), _AROUND), 0.2))
    with np.errstate(all="ignore"):
        middle = np.nanmedian(residual[:, measured].astype(np.float32), axis=1)
    return TexelMaps(
        value=value,
        sigma=np.hypot(sigma * scale[..., None], common),
        seen=measured,
        misfit=np.sqrt(square[:, 0] / np.maximum(square[:, 1], 1)),
        residual=middle,
    )


def _fit(
    data: Measurements, geometry: TexelViews, gloss: GlossGroups, settings: GlossSettings
) -> tuple[TexelEstimate, Floats, Floats]:
    """Estimates of N texels, and their 1σ as of `_doubts`. Priors are those of the materials, chosen by the albedo.

    The albedo is better known at each step: median radiance of the views, fit of flat texels, fit of a few rounds.
    """
    law = LAWS[gloss.law]
    radiance = np.median(np.where(np.isfinite(data.noise[..., :1]), data.radiance, 0), axis=0)
    flat = texel_fit.start(data, geometry, gloss.prior(np.clip(radiance, 0, 1), settings), law)
    prior = gloss.prior(flat[:, ALBEDO], settings)
    few = texel_fit.fit(data, geometry, prior, flat, law, settings.fitting, _FIRST_ROUNDS).value
    prior = gloss.prior(few[:, ALBEDO], settings)
    found = texel_fit.fit(data, geometry, prior, few, law, settings.fitting)
    return found, *_doubts(found, prior, gloss.sigma_of(few[:, ALBEDO]))


def _doubts(found: TexelEstimate, prior: TexelPrior, shared: Floats) -> tuple[Floats, Floats]:
    """1σ (N, 7) of texels from their own data, and from the 1σ `shared` (N, 2) of their material's gloss."""
    covariance = np.linalg.inv(found.information.astype(np.float64))
    response = covariance[:, :, GLOSS] / prior.sigma[:, None, :] ** 2  # to a change of the prior's mean
    own = np.sqrt(np.maximum(np.einsum("nii->ni", covariance), 0))
    return own, np.linalg.norm(response * shared[:, None, :], axis=-1)
