"""Zenith angles from the DoLP, by the law of diffuse polarization that the object follows.

The whole object has one law, which is one of many candidates: rough interfaces of several roughnesses and two kinds
(`optics/body.py`), or the smooth one, times a factor on the polarization that may fall towards the outline. A candidate
is probable if

* the albedo that follows from its zeniths does not depend on the zenith,
* its zeniths near the outline are those of a ball, and
* its zeniths agree with those of another estimator, if one is given.

The result is the mean over all candidates, weighted by their probability. Their spread is part of its error.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise, product

import cv2
import numpy as np

from polcap.image_values import Floats, Quality
from polcap.optics import body, frames
from polcap.optics.outline import disc_radius
from polcap.stage_values import Cues

_ALPHAS = (0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5)
_FACTORS = (1.0, 0.9, 0.8, 0.7, 0.5)  # on the polarization, everywhere
_EDGE_LOSSES = (0.0, 0.15, 0.3, 0.45, 0.6)  # share lost edge-on, times sin²θ elsewhere: two real balls lose about .55
_ZENITHS = np.radians(np.linspace(0, 88, 177))  # of the tables from DoLP to zenith
_GRID = 600  # DoLPs of the mean table
_SMOOTH_LIKELIER = 1.5  # log prior of the smooth interface over any other candidate: most captures so far
_DEPOLARIZED_LIKELIER = -8.0  # log prior, times the share of the polarization that is lost everywhere

_PATCHES = 20  # independent ones in an object, however many pixels it has
_SAMPLES = 2000  # pixels
_LEAST_LIGHT = 1e-3  # S0
_LEAST_GUIDE_SIGMA = np.radians(2.0)
_MOST_MISFIT = 9.0  # of a pixel against the guide, σ²

_TENTHS = 10
_UNEVEN = 0.07  # 1σ of the logarithm of an even albedo's patches: shading is not known better
_FLAT = 0.2  # α of the rough body with the flatness 1
_FLATTEST = 2.0  # greatest flatness: α = .4

_OUTLINE_PX = 1.0  # from the outline: nearer, pixels mix with the backdrop
_RINGS = (0.015, 0.05, 0.1, 0.16)  # distances from the outline between which the DoLP is read, in radii of the disc
_RADII = np.exp(np.linspace(-0.5, 0.5, 21))  # of the ball that a round outline resembles, over that of the disc
_RADIUS_SPREAD = 0.1  # 1σ of their logarithm
_OUTLINE_DEG = 2.5  # 1σ of a ring's zenith
_SHARP = 0.005  # probability that the outline is an edge, not round


@dataclass(frozen=True)
class ZenithEstimate:
    """Zenith angles, averaged over the laws of diffuse polarization that the object may follow."""

    angle: Floats  # (H, W) rad
    spread: Floats  # (H, W) rad, 1σ between laws
    _dolps: Floats  # (G,) grid of DoLPs
    _means: Floats  # (G,) rad, mean zenith for each

    def at(self, dolp: Floats) -> Floats:
        """Zeniths [rad] for DoLPs of any shape, averaged over the candidate laws."""
        return np.interp(dolp, self._dolps, self._means).astype(np.float32)


@dataclass(frozen=True)
class DiffuseLaws:
    """C candidate laws of diffuse polarization, each at the Z zeniths of `_ZENITHS`."""

    prior: Floats  # (C,) logarithm
    dolp: Floats  # (C, Z), never falling
    shading: Floats  # (Z,) logarithm of S0 over albedo, of a smooth body
    flatter: Floats  # (Z,) logarithm of the shading of a rough body over that of a smooth one


def estimate_zenith(dolp: Floats, cues: Cues, ior: float, guide: tuple[Floats, Floats] | None = None) -> ZenithEstimate:
    """Estimate zenith angles (H, W) from DoLPs (H, W) without their noise bias.

    `guide` are zeniths (H, W) of another estimator and their 1σ (H, W), rad.
    """
    laws = candidate_laws(ior)
    score = laws.prior.copy()
    light = frames.total(cues.radiance) / 3
    inside = cues.mask & ((cues.quality & Quality.CLIPPED) == 0) & (light > _LEAST_LIGHT)
    pixels = np.flatnonzero(inside)
    sample = pixels[:: max(1, len(pixels) // _SAMPLES)]  # evenly spread
    if len(sample) > _PATCHES:
        angles = np.stack([np.interp(dolp.flat[sample], row, _ZENITHS) for row in laws.dolp])  # (C, N)
        score += _even_albedo(angles, light.flat[sample], laws)
        score += _round_outline(dolp, cues, laws)
        if guide is not None:
            deviation = (angles - guide[0].flat[sample]) / np.maximum(guide[1].flat[sample], _LEAST_GUIDE_SIGMA)
            score -= _PATCHES / 2 * np.minimum(deviation**2, _MOST_MISFIT).mean(axis=1)  # −χ²/2 of independent patches
    weights = np.exp(score - score.max())
    weights /= weights.sum()
    grid = np.linspace(0, float(laws.dolp.max()), _GRID)
    zenith = np.stack([np.interp(grid, row, _ZENITHS) for row in laws.dolp])  # (C, G)
    means = weights @ zenith
    spreads = np.sqrt(np.maximum(weights @ zenith**2 - means**2, 0))
    angle, spread = (np.interp(dolp, grid, values).astype(np.float32) for values in (means, spreads))
    return ZenithEstimate(angle, spread, grid, means)


@lru_cache(maxsize=4)
def candidate_laws(ior: float) -> DiffuseLaws:
    """All candidate laws of diffuse polarization for a refractive index; cached."""
    cosine = np.cos(_ZENITHS)
    rows = []
    for local, alpha in [(0.0, 0.0), *product((0.0, 1.0), _ALPHAS)]:
        plus, minus = body.leaving(cosine, alpha, ior, local)
        for factor, loss in product(_FACTORS, _EDGE_LOSSES):
            smooth = alpha == 0 and factor == 1 and loss == 0
            prior = _DEPOLARIZED_LIKELIER * (1 - factor) + (_SMOOTH_LIKELIER if smooth else 0.0)
            remaining = factor * (1 - loss * (1 - cosine**2))
            rows.append((prior, np.maximum.accumulate(remaining * minus / plus)))
    plus, _ = body.leaving(cosine, 0.0, ior)
    shading = np.log(np.maximum(cosine * plus * plus, 1e-4))
    flatter = np.log(body.flattening(cosine, cosine, np.ones_like(cosine), _FLAT + 0 * cosine))
    priors, dolps = (np.array(column) for column in zip(*rows))
    return DiffuseLaws(priors, dolps, shading, flatter)


def _even_albedo(angles: Floats, light: Floats, laws: DiffuseLaws) -> Floats:
    """Log likelihood (C,) of each diffuse law from an albedo that is equal at small and at large zeniths.

    `angles` (C, N) are the zeniths of N pixels by each law, `light` (N,) their S0. The pixels are sorted by DoLP into
    the same ten parts for all laws. The error of a part's mean albedo is its scatter over the root of its number of
    patches. Rough surfaces shade flatter than smooth ones. The amount is fitted to the albedo, independently of the
    polarization. If no law fits (reflected light, concave parts), all differences count less.
    """
    order = np.argsort(angles.sum(axis=0), kind="stable")
    order = order[len(order) % _TENTHS :]
    zenith = angles[:, order]
    shading, flatter = (np.interp(zenith, _ZENITHS, values) for values in (laws.shading, laws.flatter))
    albedo = np.log(light[order]) - shading
    # without the first part, which faces the flash: highlights
    albedo, flatter = (x.reshape(len(zenith), _TENTHS, -1)[:, 1:] for x in (albedo, flatter))
    within = albedo.std(axis=2).mean(axis=1)
    middle, flat = (x.mean(axis=2) for x in (albedo, flatter))  # (C, tenths)
    middle, flat = (x - x.mean(axis=1, keepdims=True) for x in (middle, flat))
    amount = (middle * flat).sum(axis=1) / np.maximum((flat * flat).sum(axis=1), 1e-9)
    uneven = middle - np.clip(amount, 0, _FLATTEST)[:, None] * flat
    misfit = _PATCHES * (uneven**2).mean(axis=1) / (within**2 + _UNEVEN**2)
    return np.asarray(-misfit / 2 / max(1.0, float(misfit.min())))


def _round_outline(dolp: Floats, cues: Cues, laws: DiffuseLaws) -> Floats:
    """Log likelihood (C,) of each diffuse law from the outline, where a round object has sin θ = 1 − x.

    x is the distance from the outline over the radius of a ball. The zenith of the ball is compared with that of the
    median DoLP, in a few rings inside the outline. The radius is fitted, near that of a disc with the object's area. If
    the outline is a sharp edge, it favors no law.
    """
    distance = cv2.distanceTransform(cues.mask.astype(np.uint8), cv2.DIST_L2, 5) - 0.5
    radius = disc_radius(cues.mask)
    dolps, distances = [], []
    for near, far in pairwise(np.maximum(np.array(_RINGS) * radius, _OUTLINE_PX)):
        ring = cues.mask & (distance > near) & (distance < far)
        if ring.sum() >= _PATCHES and far - near > 1:
            dolps.append(np.median(dolp[ring]))
            distances.append((near + far) / 2)
    if len(distances) < 2:
        return np.zeros(len(laws.prior))
    away = np.clip(np.array(distances) / (radius * _RADII[:, None]), 0, 1)  # (R, rings)
    ball = np.degrees(np.arccos(np.sqrt(away * (2 - away))))
    zeniths = np.degrees([np.interp(dolps, row, _ZENITHS) for row in laws.dolp])  # (C, rings)
    misfit = (((zeniths[:, None] - ball) / _OUTLINE_DEG) ** 2).sum(axis=-1) + (np.log(_RADII) / _RADIUS_SPREAD) ** 2
    return np.asarray(np.log(np.exp(-misfit.min(axis=1) / 2) + _SHARP))
