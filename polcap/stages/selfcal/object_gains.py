"""The gains of the shots from the object itself, by three of its properties, each with its own doubt.

With h = 1/gain, hₖIₖ = ½(S0 + S1 cos 2θₖ + S2 sin 2θₖ) has to hold in every pixel:

* closure: K > 3 shots lie in a space of three dimensions, so K − 3 sums N·(h∘I) vanish;
* outline: where the surface turns edge-on the polarization points across the contour of azimuth φ, so the shots
  lie in the span of 1 and cos 2(θₖ − φ), and K − 2 sums vanish;
* facing pixels: a surface that faces the camera is unpolarized, so there hₖIₖ is the same in all shots.

The first two are least squares for the null vector h; their doubt is the scatter between parts of the object. The
third is a guess wherever nothing faces the camera, and more than one peak says so.

References
----------
Comaniciu & Meer, Mean shift, IEEE TPAMI 2002. Efron, The Jackknife, 1982. Birge, Phys. Rev. 1932 (combining).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap import parallel
from polcap.images import Bits, Floats
from polcap.optics import frames, mueller
from polcap.optics.robust import BIWEIGHT, MAD_TO_SIGMA

Bools = NDArray[np.bool_]

_KERNELS = (0.04, 0.02, 0.01, 0.007, 0.005)  # of the mean shift, of S1/S0; ended at .01 a vase errs 12 × (decision 6)
_KERNEL_REACH = 8.0  # widths; beyond, less one that a climb may have moved, a Gaussian is under 10⁻¹⁰
_STARTS = 12  # of the mean shift, beside the median and equal gains
_PEAK_WIDTH = 0.02  # kernel in which peaks are compared, of S1/S0; set by hand
_CELL_PX = 6  # of the blocks whose means the closure takes: three times the blur of `smoothed`
_PARTS = 12  # of the object, left out one at a time: knows a 1σ to a fifth
_ANGLE_ERROR = np.radians(0.5)  # 1σ of a ring set against its mark: half of what divides it, a degree; assumed
_LEAST_RIM, _MOST_RIM = 200, 20_000  # pixels of the outline
_FACING_ERROR = 0.003  # what facing pixels were wrong by on simulated objects, whatever their scatter (decision 6)
_ONE_SIDED = 0.02  # the same where slopes lie to one side of them alone, as a ridge's that leans (decision 6)
_RING = (0.006, 0.02)  # polarization of the slopes that are looked at for that
_OUTLINE_ERROR = 0.002  # of the outline, beside its own scatter
_OUTLINE_TIMES = 3.0  # its error over the scatter of its parts: what bends one bends its neighbours (decision 6)
_CLOSURE_ERROR = 0.001  # registration and interpolation; assumed, the angles' error is most of its doubt (decision 20)


@dataclass(frozen=True)
class Estimate:
    """Gains of the shots relative to the first."""

    gain: Floats  # (K,)
    sigma: Floats  # (K,) 1σ; inf: nothing is known


def combined(estimates: list[Estimate]) -> Estimate:
    """The mean of estimates by their inverse variances; where they differ by more than their doubt, that grows."""
    gain = np.stack([one.gain for one in estimates])
    sigma = np.stack([one.sigma for one in estimates])
    weight = 1 / np.maximum(sigma, 1e-6) ** 2
    total = weight.sum(0)
    known = total > 0
    mean = np.where(known, (weight * gain).sum(0) / np.maximum(total, 1e-12), 1.0)
    count = np.maximum((weight > 0).sum(0) - 1, 1)
    excess = (weight * (gain - mean) ** 2).sum(0) / count  # Birge's ratio, squared
    spread = np.where(known, np.sqrt(np.maximum(excess, 1) / np.maximum(total, 1e-12)), np.inf)
    spread[0] = 0
    return Estimate(mean, spread)


def unknown(shots: int) -> Estimate:
    """What is known of gains before anything is."""
    return Estimate(np.ones(shots), np.where(np.arange(shots) > 0, np.inf, 0.0))


def closure(light: Floats, usable: Bools, angle: Floats) -> Estimate:
    """Gains (K,) that let more than three shots agree; light (K, H, W), unknown for K = 3."""
    shots = len(angle)
    if shots < 4:
        return unknown(shots)
    means, at = cells(light, usable)
    if len(at) < 4 * _PARTS:
        return unknown(shots)
    part = (np.arange(len(at)) * _PARTS) // len(at)  # bands of the object, top to bottom
    means = (means / means.mean(0)).T  # (P, K)

    def rows(turned: Floats) -> Floats:
        null = np.linalg.svd(mueller.analyzer(turned).T)[2][3:]  # (K − 3, K), N A = 0
        return np.asarray(null[None] * means[:, None])

    return _null_vector(rows, angle, part, _CLOSURE_ERROR)


def outline(light: Floats, azimuth: Floats, sector: NDArray[np.int_], angle: Floats) -> Estimate:
    """Gains (K,) that let the polarization cross the contour.

    Parameters
    ----------
    light
        (K, N) of the rim.
    azimuth
        (N,) rad, outward direction of the outline.
    sector
        (N,) part of the outline that a pixel belongs to, for the doubt.
    angle
        (K,) rad, of the shots' polarizers.
    """
    shots = len(angle)
    parts = np.unique(sector)
    if len(azimuth) < _LEAST_RIM or len(parts) < _PARTS // 2:
        return unknown(shots)
    step = max(1, len(azimuth) // _MOST_RIM)
    light, azimuth, sector = light[:, ::step], azimuth[::step], sector[::step]
    light = (light / np.maximum(light.mean(0), 1e-12)).T  # (N, K)
    one = np.full((shots, shots), 1 / shots)

    def rows(turned: Floats) -> Floats:
        wave = np.cos(2 * (turned[:, None] - azimuth))  # (K, N)
        wave = wave - wave.mean(0)
        wave = wave / np.maximum(np.linalg.norm(wave, axis=0), 1e-9)
        project = np.eye(shots) - one - np.einsum("kn,ln->nkl", wave, wave)  # of rank K − 2
        return np.asarray(project * light[:, None])

    return _null_vector(rows, angle, np.searchsorted(parts, sector), _OUTLINE_ERROR, _OUTLINE_TIMES)


def facing(light: Floats, usable: Bools, angle: Floats) -> Estimate:
    """Gains (K,) at which the ratios of the shots pile up; light (K, H, W), angle (K,) rad for the doubt alone.

    Over a rounded object the density of (S1, S2)/S0 grows as 1/θ² towards its zero, whatever the albedo. Mean shift
    with a shrinking kernel climbs there from several places. The peak with most pixels is taken; others that hold
    nearly as many are what it may be wrong by: on flat faces, or under light from all sides, there are many. A ridge
    that leans has its peak where it leans least: slopes lie to one side of it alone, in whatever order the shots are.
    """
    shots = len(light)
    usable = usable & (light.sum(0) > np.quantile(light.sum(0)[usable], 0.2)) if usable.any() else usable
    if usable.sum() < 100:
        return unknown(shots)
    ratio = light[:, usable] / np.maximum(light[0, usable], 1e-12)  # (K, N)
    ratio = ratio[:, :: max(1, ratio.shape[1] // 40_000)]
    seeds = ratio[:, np.linspace(0, ratio.shape[1] - 1, _STARTS).astype(int)].T
    starts = (np.median(ratio, axis=1), np.ones(shots), *seeds)
    climbs = parallel.results(partial(_climb, ratio, start) for start in starts)
    away = np.stack([((ratio - path[-1][:, None]) ** 2).sum(0) for path in climbs])
    height = np.exp(-away / (2 * _PEAK_WIDTH**2)).mean(1)
    best = int(np.argmax(height))
    gain = climbs[best][-1]
    odds = (height / max(float(height[best]), 1e-12)) ** 4
    spread = np.sqrt((odds[:, None] * (np.stack([path[-1] for path in climbs]) - gain) ** 2).sum(0) / odds.sum())
    scatter = np.std(climbs[best][1:], axis=0)
    beside = _ONE_SIDED * _one_sided(ratio / gain[:, None], angle)
    sigma = np.sqrt(spread**2 + scatter**2 + beside**2 + _FACING_ERROR**2)
    return Estimate(gain, np.where(np.arange(shots) > 0, sigma, 0.0))


def _one_sided(ratio: Floats, angle: Floats) -> float:
    """How far the slopes about facing pixels all lie one way, 0…1, of the shots' ratios (K, N) without gains."""
    s0, s1, s2 = np.linalg.pinv(mueller.analyzer(angle)) @ ratio
    polarization = (s1 + 1j * s2) / np.maximum(s0, 1e-9)
    strength = np.abs(polarization)
    some = polarization[(strength > _RING[0]) & (strength < _RING[1])]
    return float(abs(np.mean(some / np.abs(some)))) if some.size else 1.0


def _climb(ratio: Floats, start: Floats) -> list[Floats]:
    """Mean shift over ratios (K, N): where each kernel of _KERNELS ends."""
    at: Floats = start.astype(np.float32)
    found: list[Floats] = []
    for width in _KERNELS:
        some, middle = _near(ratio, at, width), at
        for _ in range(50):
            if np.abs(at - middle).max() > width:
                some, middle = _near(ratio, at, width), at
            away = some - at[:, None]
            weight = np.exp(np.einsum("kn,kn->n", away, away) * np.float32(-0.5 / width**2))
            total = float(weight.sum())
            step = away @ weight / total if total > 1e-9 else np.zeros_like(at)
            at = at + step
            if np.abs(step).max() < 1e-5:
                break
        found.append(at.astype(np.float64))
    return found


def _near(ratio: Floats, at: Floats, width: float) -> Floats:
    """Those of the ratios (K, N) that a kernel within `width` of a place (K,) gives any weight, float32."""
    away = ratio - at[:, None]
    near = np.einsum("kn,kn->n", away, away) < (_KERNEL_REACH * width) ** 2
    return np.asarray(ratio[:, near], np.float32)


def cells(light: Floats, usable: Bools) -> tuple[Floats, NDArray[np.int_]]:
    """Means (K, P) of whole blocks inside the object, and the row of each (P,)."""
    height, width = (size // _CELL_PX for size in usable.shape)
    cut = np.s_[..., : height * _CELL_PX, : width * _CELL_PX]
    shape = (height, _CELL_PX, width, _CELL_PX)
    whole = usable[cut].reshape(shape).all((1, 3))
    means = light[cut].reshape(len(light), *shape).mean((2, 4))[:, whole]
    bright = (means > 0).all(0)
    return means[:, bright], np.nonzero(whole)[0][bright]


def _null_vector(
    rows_at: Callable[[Floats], Floats], angle: Floats, part: NDArray[np.int_], floor: float, times: float = 1.0
) -> Estimate:
    """The h with h₀ = 1 that rows (P, C, K) take nearest to zero, as gains 1/h, by biweight.

    Its doubt: the scatter between parts (jackknife) so many times, and what an error of each angle does to it.
    """
    rows = rows_at(angle)
    trust = np.ones(len(rows))
    h: Floats = np.ones(rows.shape[2])
    for _ in range(4):
        h = _solved(_square(rows, trust))
        residual = np.linalg.norm(rows @ h, axis=1)
        scale = MAD_TO_SIGMA * float(np.median(residual)) + 1e-9
        trust = np.maximum(0, 1 - (residual / (BIWEIGHT * scale)) ** 2) ** 2
    each = [_square(rows[part == p], trust[part == p]) for p in np.unique(part)]
    total = np.sum(each, axis=0)
    without = np.stack([_solved(total - one) for one in each])
    count = len(each)
    variance = times**2 * (count - 1) / count * ((without - without.mean(0)) ** 2).sum(0)
    for k in range(len(angle)):
        turned = angle + _ANGLE_ERROR * (np.arange(len(angle)) == k)
        variance = variance + (_solved(_square(rows_at(turned), trust)) - h) ** 2
    h = np.clip(h, 0.05, 20)
    sigma = np.hypot(np.sqrt(variance) / h**2, floor)
    return Estimate(1 / h, np.where(np.arange(len(h)) > 0, sigma, 0.0))


def _square(rows: Floats, trust: Floats) -> Floats:
    """Σ trust · rowᵀrow, (K, K) of rows (P, C, K)."""
    return np.asarray(np.einsum("p,pck,pcl->kl", trust, rows, rows, optimize=True))


def _solved(square: Floats) -> Floats:
    """h (K,) with h₀ = 1 of least hᵀQh."""
    size = len(square) - 1
    inner = square[1:, 1:] + 1e-9 * (np.trace(square) + 1e-12) * np.eye(size)
    return np.concatenate([[1.0], np.linalg.solve(inner, -square[1:, 0])])


def smoothed(value: Floats) -> Floats:
    """Sum over channels of shots (K, H, W, C), little blurred: (K, H, W)."""
    return np.stack([cv2.GaussianBlur(frames.total(v), (0, 0), 2.0) for v in value])


def inside(mask: Bools, quality: Bits) -> Bools:
    """The object's sound pixels (H, W), away from its edge where there are enough."""
    solid = cv2.erode(mask.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    return np.asarray((solid if solid.sum() > 100 else mask) & (quality == 0))
