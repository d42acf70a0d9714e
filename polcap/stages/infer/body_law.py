"""Which law of the body the cues speak for: how rough, how depolarized; and the zenith that a DoLP then means.

One law for the object, estimated among candidates: facets of several roughnesses, counted either way, and factors on
top (`optics/body.py`); the smooth interface is one of them. A law is likely under which albedo does not depend on the
zenith, the outline turns away from the camera, and the zeniths are those of a guide, where there is one. The answer is
the mean over all candidates, and their spread is part of its doubt.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Cues, Floats, Quality
from polcap.optics import body

_ALPHAS = (0.0, 0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5)
_KEPT = (1.0, 0.85, 0.7, 0.5)
_ZENITHS = np.radians(np.linspace(0, 88, 177))  # of the tables from DoLP to zenith
_SMOOTH_LIKELIER = 1.5  # in the logarithm, than any other one candidate: most captures so far
_DEPOLARIZED_LIKELIER = -1.0  # each step of `_KEPT`
_PATCHES = 20  # independent ones that an object counts for, whatever its pixels
_SAMPLES = 4000  # pixels
_TENTHS = 10
_UNEVEN = 0.07  # 1σ of the logarithm of an even albedo's patches: shading is not known better
_OUTLINE_PX = (1.5, 3.5)  # distance from the border of pixels that show the outline
_OUTLINE_SHARE = 0.5  # of them turn away as a ball's do, where the object is round
_OUTLINE_DEG = 2.5  # 1σ
_SHARP = 0.005  # probability that the outline is an edge, not round
_LEAST_LIGHT = 1e-3


@dataclass(frozen=True)
class Zeniths:
    """What the DoLP means under the laws that the object may follow."""

    angle: Floats  # (H, W) rad
    spread: Floats  # (H, W) rad, 1σ between laws
    alpha: float  # of the body, expected
    kept: float  # factor on its polarization, expected
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
    kept: Floats  # (C,)
    prior: Floats  # (C,) logarithm
    dolp: Floats  # (C, Z), never falling
    shading: Floats  # (C, Z) logarithm of S0 over albedo


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
    laws = _laws(ior)
    score = laws.prior.copy()
    inside = cues.mask & ((cues.quality & Quality.CLIPPED) == 0) & (cues.radiance.mean(-1) > _LEAST_LIGHT)
    some = _some(np.flatnonzero(inside))
    if len(some) > _PATCHES:
        angles = np.stack([np.interp(dolp.flat[some], row, _ZENITHS) for row in laws.dolp])  # (C, N)
        score += _even_albedo(angles, cues.radiance.mean(-1).flat[some], laws)
        score += _round_outline(dolp, cues, laws)
        if guide is not None:
            deviation = (angles - guide[0].flat[some]) / np.maximum(guide[1].flat[some], np.radians(2.0))
            score -= _PATCHES / 2 * np.minimum(deviation**2, 9.0).mean(axis=1)
    weights = np.exp(score - score.max())
    weights /= weights.sum()
    angle, spread = _mean(dolp, laws.dolp, weights)
    smooth = weights[(laws.alpha == 0) & (laws.kept == 1)].sum()
    return Zeniths(
        angle, spread, float(weights @ laws.alpha), float(weights @ laws.kept), float(smooth), laws.dolp, weights
    )


def _laws(ior: float) -> _Laws:
    cosine = np.cos(_ZENITHS)
    rows = []
    for local in (0.0, 1.0):
        for alpha in _ALPHAS:
            if alpha == 0 and local:
                continue
            plus, minus = body.leaving(cosine, alpha, ior, local)
            flat = 1 + local * (body.flatter(cosine, cosine, np.ones_like(cosine), alpha + 0 * cosine) - 1)
            shading = np.log(np.maximum(cosine * plus * plus * flat, 1e-4))
            for step, kept in enumerate(_KEPT):
                prior = _DEPOLARIZED_LIKELIER * step + (_SMOOTH_LIKELIER if alpha == 0 and kept == 1 else 0.0)
                rows.append((alpha, kept, prior, np.maximum.accumulate(kept * minus / plus), shading))
    return _Laws(*(np.array(column) for column in zip(*rows)))


def _even_albedo(angles: Floats, light: Floats, laws: _Laws) -> Floats:
    """Log likelihood (C,) of the candidates: albedo is as light where zeniths are small as where they are large.

    The same tenths of the pixels, by DoLP, for all candidates; what albedo differs by within a tenth is what its means
    may differ by, divided by the patches that each holds. Where no candidate explains them (cast light, concave parts),
    all are trusted less.
    """
    order = np.argsort(angles.sum(axis=0))
    tenths = np.array_split(order, _TENTHS)[1:]  # the first faces the flash, where highlights are
    misfit = np.zeros(len(angles))
    for k, (angle, shading) in enumerate(zip(angles, laws.shading)):
        albedo = np.log(light) - np.interp(angle, _ZENITHS, shading)
        middle = np.array([np.mean(albedo[tenth]) for tenth in tenths])
        within = np.mean([np.std(albedo[tenth] - m) for tenth, m in zip(tenths, middle)])
        deviation = np.mean((middle - middle.mean()) ** 2)
        misfit[k] = _PATCHES * deviation / (within**2 + _UNEVEN**2)
    return -misfit / 2 / max(1.0, float(misfit.min()))


def _round_outline(dolp: Floats, cues: Cues, laws: _Laws) -> Floats:
    """Log likelihood (C,): just inside its border a round object turns away as a ball of its area does."""
    distance = cv2.distanceTransform(cues.mask.astype(np.uint8), cv2.DIST_L2, 5)
    rim = (distance > _OUTLINE_PX[0]) & (distance < _OUTLINE_PX[1])
    radius = float(np.sqrt(cues.mask.sum() / np.pi))
    if rim.sum() < _PATCHES or radius < 4 * _OUTLINE_PX[1]:
        return np.zeros(len(laws.alpha))
    ball = np.degrees(np.arccos(np.sqrt((2 * np.mean(_OUTLINE_PX) - 1) / radius)))
    high = np.quantile(dolp[rim], _OUTLINE_SHARE)
    seen = np.degrees([np.interp(high, row, _ZENITHS) for row in laws.dolp])
    return np.asarray(np.log(np.exp(-0.5 * ((seen - ball) / _OUTLINE_DEG) ** 2) + _SHARP))


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
