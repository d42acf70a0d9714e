"""Gains of the shots from the object: by closure, by its outline, and by pixels that face the camera.

With h = 1/gain, hₖIₖ = ½(S0 + S1 cos 2θₖ + S2 sin 2θₖ) holds in every pixel:

* closure: the h∘I of K > 3 shots are in a space of three dimensions, so K − 3 sums N·(h∘I) are 0;
* outline: at the outline, polarization is along the contour's normal of azimuth φ, so the h∘I are in the span of 1 and
  cos 2(θₖ − φ), and K − 2 sums are 0;
* facing pixels: a surface that faces the camera is unpolarized, so hₖIₖ is the same in all shots.

The first two find the null vector h by least squares; their error is the scatter between parts of the object. The third
fails if no surface faces the camera; then the ratios of the shots have several peaks. `integrability` is a fourth
method.

References
----------
Comaniciu & Meer, Mean shift, IEEE TPAMI 2002. Birge, Phys. Rev. 1932 (combining).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap import parallel
from polcap.image_values import Bits, Bools, Floats, Quality
from polcap.optics import frames, mueller
from polcap.optics.morphology import erode
from polcap.optics.outline import OutlineBand
from polcap.optics.robust import biweight, jackknife, spread
from polcap.optics.warp import warp
from polcap.stage_values import Alignment, AngleStack, ObjectMask

# widths of the mean shift, in S1/S0; with 0.01 as the last, a vase errs 12 × (decision 6)
_KERNELS = (0.04, 0.02, 0.01, 0.007, 0.005)
_STARTS = 12  # of the mean shift, besides the median and equal gains
_PEAK_WIDTH = 0.02  # width of the kernel that compares peaks, in S1/S0; set by hand
_CELL_PX = 6  # side of the blocks that closure averages: three times the blur of the light
_BLUR_PX = 2.0  # 1σ of the blur of the light
_PARTS = 12  # of the object, left out one at a time: gives 1σ to 20 %
_ANGLE_ERROR = np.radians(0.5)  # 1σ of each angle, half a degree, the step of the ring's scale; assumed
_LEAST_RIM, _MOST_RIM = 200, 20_000  # pixels of the outline
_FACING_ERROR = 0.003  # least error by facing pixels, from simulated objects (decision 6)
_ONE_SIDED = 0.02  # error by facing pixels if all slopes around them point to one side (decision 6)
_RING = (0.006, 0.02)  # DoLP of the slopes around facing pixels that are tested for that
_OUTLINE_ERROR = 0.002  # least error by the outline
_OUTLINE_TIMES = 3.0  # error by the outline over the scatter of its parts: neighbors have common errors (decision 6)
_CLOSURE_ERROR = 0.001  # least error by closure, from registration; assumed. The angles add more (decision 20)
_SURPRISE = 3.0  # σ; gains farther from 1 are not averaged with the prior
_CERTAIN = 10.0  # σ of the measured gain alone; a surprising gain farther from 1 is applied: the flash failed


@dataclass(frozen=True)
class GainEstimate:
    """Gains of the shots relative to the first shot."""

    gain: Floats  # (K,)
    sigma: Floats  # (K,) 1σ; inf: unknown


@dataclass(frozen=True)
class ObjectShots:
    """All shots on the crop around the object, registered by linear interpolation."""

    value: Floats  # (K, h, w, 3)
    light: Floats  # (K, h, w) sum over channels, blurred by 2 px
    quality: Bits  # (h, w) 0: unflagged in every shot
    mask: Bools  # (h, w)
    inside: Bools  # (h, w) the object's unflagged pixels, away from its edge if there are enough
    crop: tuple[int, int, int, int]  # x0, y0, x1, y1, merged px of the reference shot
    full: tuple[int, int]  # (H, W) of the merged picture


def register(radiance: AngleStack, alignment: Alignment, object_: ObjectMask) -> ObjectShots:
    """Resample all shots onto the reference shot, on the object's crop."""
    x0, y0, x1, y1 = crop = object_.crop
    value = np.stack([warp(v, t, crop, order=1) for v, t in zip(radiance.value, alignment.transform)])
    flagged = [warp(q.astype(np.float32), t, crop, order=1) > 0 for q, t in zip(radiance.quality, alignment.transform)]
    quality = np.where(np.any(flagged, axis=0), np.uint8(Quality.CLIPPED), np.uint8(0))
    light = np.stack([cv2.GaussianBlur(frames.total(v), (0, 0), _BLUR_PX) for v in value])
    mask = object_.mask[y0:y1, x0:x1]
    solid = erode(mask, 3)
    inside = np.asarray((solid if solid.sum() > 100 else mask) & (quality == 0))  # a thin object keeps its edge
    height, width = radiance.value.shape[1:3]
    return ObjectShots(value, light, quality, mask, inside, crop, (height, width))


def unknown(shots: int) -> GainEstimate:
    """Gains of the shots when nothing is known: 1, with infinite 1σ."""
    return _relative_to_first(np.ones(shots), np.full(shots, np.inf))


def _relative_to_first(gain: Floats, sigma: Floats) -> GainEstimate:
    """Estimate of gains (K,) that refer to the first shot, which therefore has a 1σ of 0."""
    return GainEstimate(gain, np.where(np.arange(len(gain)) > 0, sigma, 0.0))


def combined(estimates: list[GainEstimate]) -> GainEstimate:
    """Weighted mean of several estimates of the shots' gains; unknown gains do not count."""
    mean, sigma = weighted_mean(*(np.stack([getattr(one, name) for one in estimates]) for name in ("gain", "sigma")))
    return _relative_to_first(np.where(np.isfinite(sigma), mean, 1.0), sigma)


def weighted_mean(value: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    """Mean (...,) of N measurements (N, ...), weighted by inverse variance, and its 1σ; inf if none has a finite 1σ.

    Differences beyond the errors of the measurements increase the error of the mean by Birge's ratio.
    """
    weight = 1 / np.maximum(sigma, 1e-6) ** 2
    total = np.maximum(weight.sum(0), 1e-12)
    mean = (weight * value).sum(0) / total
    excess = (weight * (value - mean) ** 2).sum(0) / np.maximum((weight > 0).sum(0) - 1, 1)
    return mean, np.where(weight.sum(0) > 0, np.sqrt(np.maximum(excess, 1) / total), np.inf)


def with_prior(measured: GainEstimate, prior: float) -> GainEstimate:
    """Average measured gains (K,) with a prior: gains of 1 with 1σ = `prior`.

    A gain far from 1 with a large error is replaced by 1, with its distance from 1 as the error.
    """
    sigma = np.where(np.isfinite(measured.sigma), measured.sigma, 1e6)
    distance = np.abs(measured.gain - 1)
    surprising = distance > _SURPRISE * np.hypot(sigma, prior)
    weight, prior_weight = 1 / np.maximum(sigma, 1e-6) ** 2, 1 / prior**2
    mean = (weight * measured.gain + prior_weight) / (weight + prior_weight)
    certain = distance > _CERTAIN * sigma
    gain = np.where(surprising, np.where(certain, measured.gain, 1.0), mean)
    doubtful = np.where(certain, sigma, np.maximum(distance, prior))
    error = np.where(surprising, doubtful, 1 / np.sqrt(weight + prior_weight))
    return _relative_to_first(np.append(1.0, gain[1:]), error)


def closure(light: Floats, usable: Bools, angle: Floats) -> GainEstimate:
    """Gains (K,) with which more than three shots (K, H, W) agree with three Stokes parameters; unknown for K = 3."""
    shots = len(angle)
    if shots < 4:
        return unknown(shots)
    means, row = cells(light, usable)
    if len(row) < 4 * _PARTS:
        return unknown(shots)
    part = (np.arange(len(row)) * _PARTS) // len(row)  # bands of the object, top to bottom
    means = (means / means.mean(0)).T  # (P, K)

    def equations(turned: Floats) -> Floats:
        null = np.linalg.svd(mueller.analyzer(turned).T)[2][3:]  # (K − 3, K), N A = 0
        return np.asarray(null[None] * means[:, None])

    return _null_vector(equations, angle, part, _CLOSURE_ERROR)


def outline(rim: OutlineBand, angle: Floats) -> GainEstimate:
    """Gains (K,) from the outline, whose diffuse light is polarized along its normal of azimuth α.

    Divided by the gains, the light of a pixel in shot k is a + b cos 2(θ_k − α), with any a and b. So 1/gain is the
    null vector of the matrices P diag(light), stacked over all pixels, where P removes a and b. `rim.light` is not yet
    divided by gains.
    """
    shots = len(angle)
    parts = np.unique(rim.sector)
    if len(rim.azimuth) < _LEAST_RIM or len(parts) < _PARTS // 2:
        return unknown(shots)
    step = max(1, len(rim.azimuth) // _MOST_RIM)
    light, azimuth, sector = rim.light[:, ::step], rim.azimuth[::step], rim.sector[::step]
    light = (light / np.maximum(light.mean(0), 1e-12)).T  # (N, K)
    one = np.full((shots, shots), 1 / shots)

    def equations(turned: Floats) -> Floats:
        wave = np.cos(2 * (turned[:, None] - azimuth))  # (K, N)
        wave = wave - wave.mean(0)
        wave = wave / np.maximum(np.linalg.norm(wave, axis=0), 1e-9)
        project = np.eye(shots) - one - np.einsum("kn,ln->nkl", wave, wave)  # of rank K − 2
        return np.asarray(project * light[:, None])

    return _null_vector(equations, angle, np.searchsorted(parts, sector), _OUTLINE_ERROR, _OUTLINE_TIMES)


def facing(light: Floats, usable: Bools, angle: Floats) -> GainEstimate:
    """Gains (K,) from pixels that face the camera: the ratios of the shots (K, H, W) that most pixels have.

    On a rounded object the density of (S1, S2)/S0 grows as 1/θ² towards 0, independent of the albedo. Mean shift with a
    shrinking kernel finds peaks from several starts, and the peak with most pixels is the result. Its error is larger
    if other peaks have nearly as many pixels (flat faces, light from all sides), or if all slopes around the peak point
    to one side (a tilted ridge). The angles (K,) rad affect only the error.
    """
    shots = len(light)
    usable = usable & (light.sum(0) > np.quantile(light.sum(0)[usable], 0.2)) if usable.any() else usable
    if usable.sum() < 100:
        return unknown(shots)
    ratio = light[:, usable] / np.maximum(light[0, usable], 1e-12)  # (K, N)
    ratio = ratio[:, :: max(1, ratio.shape[1] // 20_000)]
    seeds = ratio[:, np.linspace(0, ratio.shape[1] - 1, _STARTS).astype(int)].T
    starts = (np.median(ratio, axis=1), np.ones(shots), *seeds)
    climbs = parallel.results(partial(_climb, ratio, start) for start in starts)
    distance = np.stack([((ratio - path[-1][:, None]) ** 2).sum(0) for path in climbs])
    height = np.exp(-distance / (2 * _PEAK_WIDTH**2)).mean(1)
    best = int(np.argmax(height))
    gain = climbs[best][-1]
    weight = (height / max(float(height[best]), 1e-12)) ** 4  # lower peaks hardly count
    peaks = np.sqrt((weight[:, None] * (np.stack([path[-1] for path in climbs]) - gain) ** 2).sum(0) / weight.sum())
    scatter = np.std(climbs[best][1:], axis=0)
    one_sided = _ONE_SIDED * _one_sided(ratio / gain[:, None], angle)
    sigma = np.sqrt(peaks**2 + scatter**2 + one_sided**2 + _FACING_ERROR**2)
    return _relative_to_first(gain, sigma)


def _one_sided(ratio: Floats, angle: Floats) -> float:
    """Directional imbalance of weakly polarized pixels, 0…1, of ratios (K, N) without gains."""
    s0, s1, s2 = np.linalg.pinv(mueller.analyzer(angle)) @ ratio
    polarization = (s1 + 1j * s2) / np.maximum(s0, 1e-9)
    strength = np.abs(polarization)
    ring = polarization[(strength > _RING[0]) & (strength < _RING[1])]
    return float(abs(np.mean(ring / np.abs(ring)))) if ring.size else 1.0


def _climb(ratio: Floats, start: Floats) -> list[Floats]:
    """Mean shift over shot ratios (K, N) from a start (K,): the end point for each kernel width."""
    position, ends = start, []
    for width in _KERNELS:
        for _ in range(50):
            distance = ratio - position[:, None]
            weight = np.exp(np.einsum("kn,kn->n", distance, distance) / (-2 * width**2))
            step = distance @ weight / max(float(weight.sum()), 1e-9)
            position = position + step
            if np.abs(step).max() < 1e-5:
                break
        ends.append(position)
    return ends


def cells(light: Floats, usable: Bools) -> tuple[Floats, NDArray[np.int_]]:
    """Means (K, P) of light (K, H, W) over pixel blocks, and the block row (P,) of each.

    Blocks lie entirely in `usable` (H, W) and are positive in every shot.
    """
    height, width = (size // _CELL_PX for size in usable.shape)
    cut = np.s_[..., : height * _CELL_PX, : width * _CELL_PX]
    shape = (height, _CELL_PX, width, _CELL_PX)
    inside = usable[cut].reshape(shape).all((1, 3))
    means = light[cut].reshape(len(light), *shape).mean((2, 4))[:, inside]
    bright = (means > 0).all(0)
    return means[:, bright], np.nonzero(inside)[0][bright]


def _null_vector(
    equations: Callable[[Floats], Floats], angle: Floats, part: NDArray[np.int_], floor: float, times: float = 1.0
) -> GainEstimate:
    """Solve equations rows · h = 0 for h = 1/gain, with h₀ = 1, by least squares with biweights; returns the gains.

    `equations` gives the rows (P, C, K) for polarizer angles (K,). The error combines `times` the jackknife over the
    parts (P,), the effect of an error of each angle, and `floor`.
    """
    rows = equations(angle)
    weight: Floats = np.ones(len(rows))
    h: Floats = np.ones(rows.shape[2])
    for _ in range(4):
        h = _least(_squares(rows, weight))
        residual = np.linalg.norm(rows @ h, axis=1)
        weight = biweight(residual, spread(residual))
    total = _squares(rows, weight)
    without = [_least(total - _squares(rows[part == p], weight[part == p])) for p in np.unique(part)]
    variance = (times * jackknife(np.stack(without))) ** 2
    for k in range(len(angle)):
        turned = angle + _ANGLE_ERROR * (np.arange(len(angle)) == k)
        variance = variance + (_least(_squares(equations(turned), weight)) - h) ** 2
    h = np.clip(h, 0.05, 20)
    return _relative_to_first(1 / h, np.hypot(np.sqrt(variance) / h**2, floor))


def _squares(rows: Floats, weight: Floats) -> Floats:
    """Normal matrix Σ weight · rowᵀrow (K, K) of rows (P, C, K)."""
    return np.asarray(np.einsum("p,pck,pcl->kl", weight, rows, rows, optimize=True))


def _least(square: Floats) -> Floats:
    """Minimize hᵀQh for a matrix Q (K, K) under h₀ = 1; returns h (K,)."""
    size = len(square) - 1
    inner = square[1:, 1:] + 1e-9 * (np.trace(square) + 1e-12) * np.eye(size)
    return np.concatenate([[1.0], np.linalg.solve(inner, -square[1:, 0])])
