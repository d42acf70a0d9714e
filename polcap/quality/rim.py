"""What the object's outline message of the polarizer: where it turns edge-on, the polarization is known.

There the surface's azimuth φ is the outline's own direction, so a shot at θ sees ½ S₀ (1 + ρ cos 2(θ − φ)) with
two unknowns per pixel. Three shots leave one residual per pixel, and its pattern along the outline tells which
angle was not what it is called, or that another light shone from one side. How well it tells depends on how
much of the outline is a contour of shape, and how well the mask follows it.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
from polcap.optics import outline
from polcap.optics.robust import jackknife

Bools = NDArray[np.bool_]

_INNER_PX, _DEPTH = 3.0, 0.08  # the band: px from the outline, and up to this share of the object's radius
_SMOOTH_PX = 1.0
_LEAST_SECTORS = 8  # a third of the outline
_STEP_DEG, _MOST_DEG = 3.0, 48.0  # of the angles tried; beyond, order and sense are in question


@dataclass(frozen=True)
class Rim(outline.OutlineBand):
    """The band inside the outline; `light` is relative to the mean of the shots."""

    total: Floats  # (N,) mean of the shots, of the object's mean


@dataclass(frozen=True)
class Turn:
    """The turn of one shot, or of all, that explains the rim best."""

    shot: int | None  # None: all alike
    angle: float  # rad, true minus stated
    misfit: float  # residual with that turn, relative to the residual without; 1: nothing is better
    sigmas: float  # the turn that the outline's sectors ask for, this way round, over its scatter between them


@dataclass(frozen=True)
class Body:
    """The rim as a whole."""

    dolp: float  # median degree of linear polarization
    dolp_lit: float  # of its brighter half
    along: float  # −1…1: mean of cos 2(φ − φ_contour); 1 a body's light, −1 light reflected off it from around
    concentration: float  # 0…1, of the AoLP about the contour, turned as it may be
    turned: float  # rad, the common turn of the AoLP against the contour
    turned_sigma: float  # rad
    brightness: float  # median light of the rim over the object's mean; under a flash a body dims where it turns away
    one_sided: float  # amplitude of the rim's light going once round, relative; under a flash by the lens about 0


def take(light: Floats, mask: Bools, usable: Bools) -> Rim:
    """The rim of registered shots (K, H, W) of equal gain; usable: pixels to be believed."""
    ok = (mask & usable).astype(np.float32)
    weight = cv2.GaussianBlur(ok, (0, 0), _SMOOTH_PX) + 1e-6
    smooth = np.stack([cv2.GaussianBlur(shot.astype(np.float32) * ok, (0, 0), _SMOOTH_PX) / weight for shot in light])
    depth = outline.depth(mask)
    reach = max(_DEPTH * float(np.sqrt(mask.sum() / np.pi)), _INNER_PX + 3)
    out, slope = outline.outward(mask.astype(np.float32), max(3.0, reach / 2))
    band = (depth > _INNER_PX) & (depth < reach) & (ok > 0) & (slope > 1e-4)
    for edge in (band[:3], band[-3:], band[:, :3], band[:, -3:]):  # where a picture ends is no contour
        edge[:] = False
    inside = smooth[:, band]
    total = inside.mean(0)
    level = float(smooth.mean(0)[ok > 0].mean()) if (ok > 0).any() else 1.0
    return Rim(
        inside / np.maximum(total, 1e-9),
        np.arctan2(out[1], out[0])[band],
        outline.sectors(band),
        total / max(level, 1e-9),
    )


def turn(at: Rim, angle: Floats, least: float) -> Turn:
    """The best of all turns of one shot, or of all, by at least `least` rad; angle (K,) rad as stated."""
    middle = float(np.median(_misfit(at, angle))) + 1e-9
    best = Turn(None, 0.0, 1.0, 0.0)
    steps = np.radians(np.arange(_STEP_DEG, _MOST_DEG + 1, _STEP_DEG))
    for step in (s for size in steps if size >= least for s in (-size, size)):
        for shot in (*range(len(angle)), None):
            misfit = float(np.median(_misfit(at, angle + step * _whose(shot, angle)))) / middle
            if misfit < best.misfit:
                best = Turn(shot, float(step), misfit, 0.0)
    return replace(best, sigmas=_sigmas(at, angle, np.sign(best.angle) * _whose(best.shot, angle)))


def _whose(shot: int | None, angle: Floats) -> Floats:
    """(K,) 1 for the shot that turns, 0 for the others; None: 1 for all."""
    return np.ones(len(angle)) if shot is None else (np.arange(len(angle)) == shot).astype(float)


def _misfit(at: Rim, angle: Floats) -> Floats:
    """What 1 and cos 2(θ − φ) leave of the shots' light, (N,)."""
    wave = np.cos(2 * (angle[:, None] - at.azimuth))
    wave = wave - wave.mean(0)
    light = at.light - at.light.mean(0)
    share = (wave * light).sum(0) / np.maximum((wave * wave).sum(0), 1e-9)
    return np.asarray(np.linalg.norm(light - share * wave, axis=0))


def _sigmas(at: Rim, angle: Floats, way: Floats) -> float:
    """The turn that the sectors ask for along `way` (K,), over its scatter when each of them is left out.

    Linear in the turn, and signed: what is wrong with the outline turns some sectors one way and some the other.
    """
    away = 2 * (angle[:, None] - at.azimuth)
    wave, slope, light = (part - part.mean(0) for part in (np.cos(away), -2 * np.sin(away) * way[:, None], at.light))
    power = np.maximum((wave * wave).sum(0), 1e-9)
    share = (wave * light).sum(0) / power
    slope = slope - (wave * slope).sum(0) / power * wave
    asked = np.bincount(at.sector, (slope * (light - share * wave)).sum(0))
    room = np.bincount(at.sector, (slope * slope).sum(0)) * float(np.median(share))
    used = np.flatnonzero(room)
    if len(used) < _LEAST_SECTORS:
        return 0.0
    without = (asked.sum() - asked[used]) / (room.sum() - room[used])
    return float(asked.sum() / room.sum() / max(float(jackknife(without)), 1e-9))


def body(at: Rim, angle: Floats) -> Body:
    """How the rim is polarized, and how its light is spread; angle (K,) rad."""
    mean, turned_sigma = outline.mean_and_sigma(*outline.phasor(at, angle))
    dolp = np.abs(outline.polarization(at, angle))
    basis = np.stack([np.ones_like(at.azimuth), np.cos(at.azimuth), np.sin(at.azimuth)], axis=1)
    found = np.linalg.lstsq(basis, at.total, rcond=None)[0]
    return Body(
        dolp=float(np.median(dolp)),
        dolp_lit=float(np.median(dolp[at.total >= np.median(at.total)])),
        along=mean.real,
        concentration=abs(mean),
        turned=float(np.angle(mean) / 2),
        turned_sigma=turned_sigma,
        brightness=float(np.median(at.total)),
        one_sided=float(np.hypot(found[1], found[2]) / max(float(found[0]), 1e-9)),
    )


def side_light(at: Rim) -> Floats:
    """How much brighter one side of the rim is than the other in each shot, against all shots together, (K,).

    Polarization is the same on opposite sides, a lamp is not: the amplitude of the first harmonic in φ.
    """
    phi = at.azimuth
    basis = np.stack([np.ones_like(phi), *(f(n * phi) for n in (1, 2) for f in (np.cos, np.sin))], axis=1)
    found = np.linalg.lstsq(basis, at.light.T, rcond=None)[0]  # (5, K)
    return np.asarray(np.hypot(found[1], found[2]))
