"""Which law of the body the cues speak for: how rough, how depolarized; and the zenith that a DoLP then means.

One law for the object, estimated among candidates: facets of several roughnesses, counted either way
(`optics/body.py`), with factors on top, even ones and such as fall towards the limb; the smooth interface is one of
them. A law is likely under which albedo does not depend on the zenith, for some flatness of the shading, the outline
turns away as a ball's, and the zeniths are those of a guide, where there is one. The answer is the mean over all
candidates, and their spread is part of its doubt.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise, product

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Cues, Floats, Quality
from polcap.optics import body, frames

_ALPHAS = (0.0, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5)
_KEPT = (1.0, 0.9, 0.8, 0.7, 0.5)
_LIMB = (0.0, 0.15, 0.3, 0.45, 0.6)  # share lost at the limb alone, sin²θ elsewhere: two real balls lose about .55
_FLAT = 0.2  # α of the body whose shading is the unit of flatness
_FLATTEST = 2.0  # in that unit: α = .4
_ZENITHS = np.radians(np.linspace(0, 88, 177))  # of the tables from DoLP to zenith
_SMOOTH_LIKELIER = 1.5  # in the logarithm, than any other one candidate: most captures so far
_DEPOLARIZED_LIKELIER = -8.0  # in the logarithm, times the share of the polarization that is lost everywhere
_PATCHES = 20  # independent ones that an object counts for, whatever its pixels
_SAMPLES = 2000  # pixels
_TENTHS = 10
_UNEVEN = 0.07  # 1σ of the logarithm of an even albedo's patches: shading is not known better
_OUTLINE_PX = 1.0  # from the border: nearer, pixels are mixed
_RINGS = (0.015, 0.05, 0.1, 0.16)  # distances from the border between which the outline is read, in radii of the disc
_RADII = np.exp(np.linspace(-0.5, 0.5, 21))  # of the ball that a round outline is like, by that of the disc
_RADIUS_SPREAD = 0.1  # 1σ of their logarithm
_OUTLINE_DEG = 2.5  # 1σ
_SHARP = 0.005  # probability that the outline is an edge, not round
_LEAST_LIGHT = 1e-3


@dataclass(frozen=True)
class Zeniths:
    """What the DoLP means under the laws that the object may follow."""

    angle: Floats  # (H, W) rad
    spread: Floats  # (H, W) rad, 1σ between laws
    alpha: float  # of the body, expected
    kept: float  # even factor on its polarization, expected
    smooth: float  # probability of the smooth interface
    _dolps: Floats  # (C, Z) of all laws
    _weights: Floats  # (C,)

    def at(self, dolp: Floats) -> Floats:
        """Zeniths, rad, that other DoLPs of any shape mean: expected over the laws."""
        return _mean(dolp, self._dolps, self._weights)[0]


@dataclass(frozen=True)
class _Laws:
    """All candidates, C of them, at `_ZENITHS`."""

    alpha: Floats  # (C,)
    kept: Floats  # (C,) even factor on the DoLP
    limb: Floats  # (C,) share of it that is lost at the limb, times sin²θ elsewhere
    prior: Floats  # (C,) logarithm
    dolp: Floats  # (C, Z), never falling
    shading: Floats  # (Z,) logarithm of S0 over albedo, of a smooth body
    flatter: Floats  # (Z,) logarithm of a rough one's over it


def zeniths(dolp: Floats, cues: Cues, ior: float, guide: tuple[Floats, Floats] | None = None) -> Zeniths:
    """Zeniths that DoLPs mean under the laws that the object may follow.

    Parameters
    ----------
    dolp
        (H, W), debiased.
    cues
        Light, mask and quality, by which the laws are weighed.
    ior
        Refractive index, the same for all laws.
    guide
        Zeniths (H, W) and their 1σ (H, W), rad, from elsewhere.
    """
    every = laws(ior)
    score = every.prior.copy()
    inside = cues.mask & ((cues.quality & Quality.CLIPPED) == 0) & (frames.total(cues.radiance) / 3 > _LEAST_LIGHT)
    some = _some(np.flatnonzero(inside))
    if len(some) > _PATCHES:
        angles = np.stack([np.interp(dolp.flat[some], row, _ZENITHS) for row in every.dolp])  # (C, N)
        score += _even_albedo(angles, (frames.total(cues.radiance) / 3).flat[some], every)
        score += _round_outline(dolp, cues, every)
        if guide is not None:
            deviation = (angles - guide[0].flat[some]) / np.maximum(guide[1].flat[some], np.radians(2.0))
            score -= _PATCHES / 2 * np.minimum(deviation**2, 9.0).mean(axis=1)
    weights = np.exp(score - score.max())
    weights /= weights.sum()
    angle, spread = _mean(dolp, every.dolp, weights)
    smooth = weights[(every.alpha == 0) & (every.kept == 1) & (every.limb == 0)].sum()
    return Zeniths(
        angle, spread, float(weights @ every.alpha), float(weights @ every.kept), float(smooth), every.dolp, weights
    )


@lru_cache(maxsize=4)
def laws(ior: float) -> _Laws:
    """All candidates of an index, made once."""
    cosine = np.cos(_ZENITHS)
    rows = []
    for local in (0.0, 1.0):
        for alpha in _ALPHAS:
            if alpha == 0 and local:
                continue
            plus, minus = body.leaving(cosine, alpha, ior, local)
            for kept, limb in product(_KEPT, _LIMB):
                smooth = alpha == 0 and kept == 1 and limb == 0
                prior = _DEPOLARIZED_LIKELIER * (1 - kept) + (_SMOOTH_LIKELIER if smooth else 0.0)
                left = kept * (1 - limb * (1 - cosine**2))
                rows.append((alpha, kept, limb, prior, np.maximum.accumulate(left * minus / plus)))
    plus, _ = body.leaving(cosine, 0.0, ior)
    shading = np.log(np.maximum(cosine * plus * plus, 1e-4))
    flatter = np.log(body.flatter(cosine, cosine, np.ones_like(cosine), _FLAT + 0 * cosine))
    alphas, keeps, limbs, priors, dolps = (np.array(column) for column in zip(*rows))
    return _Laws(alphas, keeps, limbs, priors, dolps, shading, flatter)


def _even_albedo(angles: Floats, light: Floats, laws: _Laws) -> Floats:
    """Log likelihood (C,) of the candidates: albedo is as light where zeniths are small as where they are large.

    The same tenths of the pixels, by DoLP, for all candidates; what albedo differs by within a tenth is what its means
    may differ by, divided by the patches that each holds. Rough bodies are flatter than smooth ones by some amount,
    whatever their polarization: the one that makes albedo most even. Where no candidate explains them (cast light,
    concave parts), all are trusted less.
    """
    order = np.argsort(angles.sum(axis=0), kind="stable")
    order = order[len(order) % _TENTHS :]
    zenith = angles[:, order]
    shading, flatter = (np.interp(zenith, _ZENITHS, values) for values in (laws.shading, laws.flatter))
    albedo = np.log(light[order]) - shading
    albedo, flatter = (x.reshape(len(zenith), _TENTHS, -1)[:, 1:] for x in (albedo, flatter))  # the first faces the
    within = albedo.std(axis=2).mean(axis=1)  # flash, where highlights are
    middle, flat = (x.mean(axis=2) for x in (albedo, flatter))  # (C, tenths)
    middle, flat = (x - x.mean(axis=1, keepdims=True) for x in (middle, flat))
    much = (middle * flat).sum(axis=1) / np.maximum((flat * flat).sum(axis=1), 1e-9)
    uneven = middle - np.clip(much, 0, _FLATTEST)[:, None] * flat
    misfit = _PATCHES * (uneven**2).mean(axis=1) / (within**2 + _UNEVEN**2)
    return np.asarray(-misfit / 2 / max(1.0, float(misfit.min())))


def _round_outline(dolp: Floats, cues: Cues, laws: _Laws) -> Floats:
    """Log likelihood (C,): inside its border a round object turns away as a ball does, cos θ = √(2x − x²).

    x is the distance from the border over a radius; the radius is about that of a disc of as many pixels, the same for
    all rings. Where half of a ring is nearer to an edge than to a ball, the law does not matter.
    """
    distance = cv2.distanceTransform(cues.mask.astype(np.uint8), cv2.DIST_L2, 5) - 0.5
    radius = float(np.sqrt(cues.mask.sum() / np.pi))
    edges = np.maximum(np.array(_RINGS) * radius, _OUTLINE_PX)
    high, middle = [], []
    for near, far in pairwise(edges):
        ring = cues.mask & (distance > near) & (distance < far)
        if ring.sum() >= _PATCHES and far - near > 1:
            high.append(np.median(dolp[ring]))
            middle.append((near + far) / 2)
    if len(middle) < 2:
        return np.zeros(len(laws.alpha))
    away = np.clip(np.array(middle) / (radius * _RADII[:, None]), 0, 1)  # (R, rings)
    ball = np.degrees(np.arccos(np.sqrt(away * (2 - away))))
    seen = np.degrees([np.interp(high, row, _ZENITHS) for row in laws.dolp])  # (C, rings)
    misfit = (((seen[:, None] - ball) / _OUTLINE_DEG) ** 2).sum(axis=-1) + (np.log(_RADII) / _RADIUS_SPREAD) ** 2
    return np.asarray(np.log(np.exp(-misfit.min(axis=1) / 2) + _SHARP))


def _some(places: NDArray[np.intp]) -> NDArray[np.intp]:
    """Some thousand of many places, evenly."""
    return places[:: max(1, len(places) // _SAMPLES)]


def _mean(dolp: Floats, dolps: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Mean and deviation (...,) of the zeniths that laws with dolps (C, Z) and weights (C,) read from a DoLP, rad."""
    grid = np.linspace(0, float(dolps.max()), 600)
    read = np.stack([np.interp(grid, row, _ZENITHS) for row in dolps])
    mean = weights @ read
    deviation = np.sqrt(np.maximum(weights @ read**2 - mean**2, 0))
    return np.interp(dolp, grid, mean), np.interp(dolp, grid, deviation)
