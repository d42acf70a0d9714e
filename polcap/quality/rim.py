"""Polarization and brightness along the object's outline, for the gates on angles, polarization and other light.

At the outline the surface is seen edge-on, so its azimuth φ is the outline's direction. A shot at the angle θ records
½ S₀ (1 + ρ cos 2(θ − φ)), with two unknowns per pixel. Three shots leave one residual per pixel. Its pattern along the
outline shows which stated angle is wrong, or that a second light shone from one side. The method needs a mask that
follows the true outline. Pixels at the picture's border are left out.
"""

import itertools
from dataclasses import dataclass, replace

import numpy as np

from polcap.image_values import Bools, Floats
from polcap.optics import outline
from polcap.optics.morphology import masked_mean
from polcap.optics.robust import jackknife

_INNER_PX, _DEPTH = 3.0, 0.08  # the band: px from the outline, and up to this share of the object's radius
_SMOOTH_PX = 1.0  # 1σ
_BORDER_PX = 3  # along the picture's border, where the mask ends without an outline
_LEAST_SECTORS = 8  # of 24: a third of the outline
_LAMP = 0.4  # least part of a lamp's one-sided light that polarization along φ leaves: .41 in tests; at a book .13
_STEP_DEG, _MOST_DEG = 3.0, 48.0  # step and limit of the angles tried; larger errors mean a wrong order or sense


@dataclass(frozen=True)
class Rim(outline.OutlineBand):
    """The N pixels of a band inside the outline; `light` (K, N) is each shot over the mean of the shots."""

    total: Floats  # (N,) mean of the shots, relative to the object's mean


@dataclass(frozen=True)
class AngleError:
    """The error of one shot's polarizer angle, or of all angles, that fits the outline best."""

    shot: int | None  # None: no error of one shot fits better than one that all shots share
    angle: float  # rad, true minus stated angle
    misfit: float  # residual with this error, relative to that with the best error that all shots share
    sigmas: float  # significance of the error by a jackknife over the outline's sectors


@dataclass(frozen=True)
class RimFigures:
    """Polarization and brightness of the whole outline."""

    dolp: float  # median degree of linear polarization
    dolp_most: float  # 90th percentile: a flat object is polarized at some parts of its outline only
    along: float  # −1…1: mean of cos 2(AoLP − φ); 1 is diffuse, −1 is specular reflection
    concentration: float  # 0…1, of the AoLP relative to φ, after removal of the common turn
    turned: float  # rad, common turn of the AoLP relative to φ
    turned_sigma: float  # rad
    brightness: float  # median light of the rim over the object's mean; below 1 under a flash


def sample(light: Floats, mask: Bools, usable: Bools) -> Rim:
    """Sample the light in a band just inside the object's outline, smoothed and divided by the mean of the shots.

    `light` (K, H, W) is the light at each polarizer angle, computed from the Stokes parameters. `mask` (H, W) is the
    object, `usable` (H, W) are the pixels without defects.
    """
    ok = mask & usable
    smooth = np.stack([masked_mean(shot, ok, _SMOOTH_PX) for shot in light])
    depth = outline.depth(mask)
    reach = max(_DEPTH * outline.disc_radius(mask), _INNER_PX + 3)  # a band of 3 px at least
    out, slope = outline.outward(mask.astype(np.float32), max(3.0, reach / 2))
    band = off_border((depth > _INNER_PX) & (depth < reach) & ok & (slope > 1e-4))
    inside = smooth[:, band]
    total = inside.mean(0)
    level = float(smooth.mean(0)[ok].mean()) if ok.any() else 1.0
    return Rim(
        inside / np.maximum(total, 1e-9),
        np.arctan2(out[1], out[0])[band],
        outline.sectors(band),
        total / max(level, 1e-9),
    )


def off_border(band: Bools) -> Bools:
    """A band (H, W) along the outline without the pixels at the picture's border, which is no outline."""
    inner = np.zeros_like(band)
    middle = slice(_BORDER_PX, -_BORDER_PX)
    inner[middle, middle] = band[middle, middle]
    return inner


def fit_angle_error(band: Rim, angle: Floats, least: float) -> AngleError:
    """Fit an angle error to the outline, of all shots or of at least `least` rad of one; angle (K,) rad as stated.

    An error of one shot imitates a smaller one of all, which fits worse.
    """
    sizes = np.radians(np.arange(_STEP_DEG, _MOST_DEG + 1, _STEP_DEG))
    steps = np.sort([*-sizes, 0.0, *sizes])

    def misfit(shot: int | None, step: float) -> float:
        return float(np.median(_misfit(band, angle + step * _pattern(shot, angle)))) + 1e-9

    shared, step = min((misfit(None, step), step) for step in steps)
    best = AngleError(None, float(step), 1.0, 0.0)
    for shot, step in itertools.product(range(len(angle)), steps[np.abs(steps) >= least]):
        if (ratio := misfit(shot, step) / shared) < best.misfit:
            best = AngleError(shot, float(step), ratio, 0.0)
    return replace(best, sigmas=_significance(band, angle, np.sign(best.angle) * _pattern(best.shot, angle)))


def _pattern(shot: int | None, angle: Floats) -> Floats:
    """Pattern (K,) of an angle error: 1 for the shot with the error, 0 for the others; None: 1 for all."""
    return np.ones(len(angle)) if shot is None else (np.arange(len(angle)) == shot).astype(float)


def _misfit(band: Rim, angle: Floats) -> Floats:
    """Residual (N,) of the shots' light along the outline after a fit of 1 and cos 2(θ − φ)."""
    return np.asarray(np.linalg.norm(_unpolarized(band, angle), axis=0))


def _unpolarized(band: Rim, angle: Floats) -> Floats:
    """Light (K, N) of the shots along the outline that 1 and cos 2(θ − φ) do not explain."""
    wave = np.cos(2 * (angle[:, None] - band.azimuth))
    wave = wave - wave.mean(0)
    light = band.light - band.light.mean(0)
    share = (wave * light).sum(0) / np.maximum((wave * wave).sum(0), 1e-9)
    return np.asarray(light - share * wave)


def _significance(band: Rim, angle: Floats, pattern: Floats) -> float:
    """Significance of an angle error: its linear estimate over the jackknife error of that estimate.

    The estimate is Σ s r / (m Σ s²), r the residual, m the median amplitude of the wave, s `slope` without the wave.
    `pattern` (K,) is that of the error over the shots (`_pattern`), times its sign. The estimate keeps its sign, so
    errors of the outline, which differ in sign from sector to sector, cancel.
    """
    away = 2 * (angle[:, None] - band.azimuth)
    parts = np.cos(away), -2 * np.sin(away) * pattern[:, None], band.light
    wave, slope, light = (part - part.mean(0) for part in parts)  # slope: derivative of the wave by the error
    power = np.maximum((wave * wave).sum(0), 1e-9)
    share = (wave * light).sum(0) / power
    slope = slope - (wave * slope).sum(0) / power * wave
    moment = np.bincount(band.sector, (slope * (light - share * wave)).sum(0))
    weight = np.bincount(band.sector, (slope * slope).sum(0)) * float(np.median(share))
    used = np.flatnonzero(weight)
    if len(used) < _LEAST_SECTORS:
        return 0.0
    without = (moment.sum() - moment[used]) / (weight.sum() - weight[used])  # the estimate without each sector
    return float(moment.sum() / weight.sum() / max(float(jackknife(without)), 1e-9))


def summarize(band: Rim, angle: Floats) -> RimFigures:
    """Summarize polarization and brightness of the outline; angle (K,) rad."""
    mean, turned_sigma = outline.mean_and_sigma(*outline.phasor(band, angle))
    dolp = np.abs(outline.polarization(band, angle))
    return RimFigures(
        dolp=float(np.median(dolp)),
        dolp_most=float(np.quantile(dolp, 0.9)),
        along=mean.real,
        concentration=abs(mean),
        turned=float(np.angle(mean) / 2),
        turned_sigma=turned_sigma,
        brightness=float(np.median(band.total)),
    )


def side_light(band: Rim, angle: Floats) -> Floats:
    """Measure one-sided extra light in each shot (K,): amplitude of the first harmonic of its relative light in φ.

    Polarization changes opposite sides of a rounded outline equally. A lamp that was on during one shot does not.
    One side of a box may be polarized more than the other. Polarization along φ explains all of that, but leaves
    `_LAMP` or more of a lamp's light.
    """
    phi = band.azimuth
    basis = np.stack([np.ones_like(phi), *(f(n * phi) for n in (1, 2) for f in (np.cos, np.sin))], axis=1)

    def uneven(light: Floats) -> Floats:
        harmonics = np.linalg.lstsq(basis, light.T, rcond=None)[0]  # (5, K)
        return np.asarray(np.hypot(harmonics[1], harmonics[2]))

    return np.asarray(np.minimum(uneven(band.light), uneven(_unpolarized(band, angle)) / _LAMP))
