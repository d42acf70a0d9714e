"""Gains from the one law that every surface keeps: its slopes are those of a height, whatever its shape and color.

A gain that is off by one per cent adds the same wrong polarization δ to every pixel. Let q = (S1 + i S2)/S0, and
w = tan²θ e^{2iφ} what it says of the surface, so that z = √w = h_x + i h_y are the slopes of its height h. Then the
derivative z_ζ = ½(∂x − i∂y) z = ½ Δh is real, and without a square root, whose sign nobody knows,

    Im(w_ζ² w*) = 0,   for w = z², w_ζ = 2 z z_ζ, w_ζ² w* = 4 |z|⁴ z_ζ².

Each pixel with some curvature is an equation for the gains; near facing pixels, where w is small, δ weighs most. No
outline is needed, nothing has to face the camera, and a ridge that leans tells as much as a ball. Where the sum is not
positive, what is polarized there is no surface's body: nothing is told then. A common turn of the angles turns
w_ζ² w* by the same for all pixels: here it is left free, `ring_by_slopes` asks for it.

References
----------
Frankot and Chellappa, A method for enforcing integrability in shape from shading algorithms, IEEE PAMI 1988 (the law).
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
from polcap.optics import fresnel, mueller
from polcap.optics.robust import BIWEIGHT, MAD_TO_SIGMA
from polcap.stages.selfcal.object_gains import Bools, Estimate, unknown

_SHOTS = 3
_SIDE = 110.0  # px; the root of the object's area is reduced to it, where it is larger: noise is averaged before slopes
BLUR = 2.0  # px of the reduced picture, 1σ of the Gaussian whose derivative is taken
_LEAST = 300  # pixels of the reduced object
_IOR = 1.5
_STEEPEST = 0.25  # DoLP up to which the law of the body is believed: 64° for index 1.5
_NEAR = (0.6, 0.6, 0.6, 0.3, 0.3, *[0.15] * 8)  # |w| of the pixels that count, from step to step: from far starts too
_NOISE = 0.012  # of w, 1σ
_LAW = 0.3  # of w, relative: highlights and other indices
_SLOPE_NOISE = 0.15  # of w_ζ, relative to its median
_STEP = 1e-4
_MOST_STEP = 0.03  # in one go
COHERENT = 0.25  # share of w_ζ² w* that is positive, below which it is no body's
_PARTS = 4  # to a side of the object, left out one at a time
_ERROR = 0.0013  # what gains were wrong by on simulated objects, beside (decision 6)
_TIMES = 2.0  # their error over the scatter of the parts (decision 6)


def gains(light: Floats, usable: Bools, angle: Floats, start: Floats) -> Estimate:
    """Gains (K,) at which the slopes are those of a surface; unknown unless K = 3.

    Of more gains some leave S0, S1 and S2 as they are; those are told by `object_gains.closure`.

    Parameters
    ----------
    light
        (K, H, W) shots on the reference grid, little blurred.
    usable
        (H, W) pixels of the object that can be believed.
    angle
        (K,) rad, of the shots' polarizers.
    start
        (K,) gains to begin at.
    """
    shots = len(angle)
    if shots != _SHOTS:
        return unknown(shots)
    slopes = seen(light, usable, angle)
    if slopes is None:
        return unknown(shots)
    found = _settled(slopes, start)
    if found.coherence < COHERENT:
        return unknown(shots)
    sigma = np.hypot(_TIMES * found.scatter, _ERROR) / found.coherence
    return Estimate(found.gain, np.where(np.arange(shots) > 0, sigma, 0.0))


@dataclass(frozen=True)
class Slopes:
    """The shots (K, H, W), reduced, where they can be believed, and their angles (K,) rad."""

    light: Floats
    inside: Bools
    angle: Floats

    def at(self, unknowns: Floats) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """w_ζ² w*, w and w_ζ (N,) for gains after the first (K − 1,) and a common turn of the angles, rad."""
        gain = np.concatenate([[1.0], unknowns[:-1]])
        s0, s1, s2 = np.einsum(
            "jk,khw->jhw", np.linalg.pinv(mueller.analyzer(self.angle)), self.light / gain[:, None, None]
        )
        q = (s1 + 1j * s2) / np.maximum(s0, 1e-9)
        w = q * np.interp(np.abs(q), *_LAW_OF_BODY)
        slope = _derivative(w)[self.inside]
        w = w[self.inside]
        return slope**2 * np.conj(w) * np.exp(-2j * unknowns[-1]), w, slope


def seen(light: Floats, usable: Bools, angle: Floats) -> Slopes | None:
    """What is left of the shots where derivatives can be taken; None where that is next to nothing.

    light (K, H, W), usable (H, W) and angle (K,) as of `gains`.
    """
    less, inside = _reduced(light, usable)
    return Slopes(less, inside, angle) if inside.sum() >= _LEAST else None


@dataclass(frozen=True)
class _Found:
    gain: Floats  # (K,)
    scatter: Floats  # (K,) 1σ by leaving parts out
    coherence: float  # −1…1


def _settled(slopes: Slopes, start: Floats) -> _Found:
    """Least squares by biweight, over ever smaller w."""
    unknowns: Floats = np.append(start[1:] / start[0], 0.0)
    for near in _NEAR:
        residual, rows, trust, product = linearized(slopes, unknowns, near)
        step = _solved(rows, residual, trust) if near < _NEAR[0] else _untwisted(rows, residual, trust)
        unknowns = unknowns + np.clip(step, -_MOST_STEP, _MOST_STEP)
        if near == _NEAR[-1] and np.abs(step).max() < _STEP / 10:
            break
    part = part_of(slopes.inside)
    without = np.stack([_solved(rows, residual, trust * (part != p)) for p in np.unique(part)])
    count = len(without)
    scatter = np.sqrt((count - 1) / count * ((without - without.mean(0)) ** 2).sum(0))
    weight = trust * np.abs(product)
    coherence = float((trust * product.real).sum() / max(float(weight.sum()), 1e-30))
    return _Found(np.append(1.0, unknowns[:-1]), np.append(0.0, scatter[:-1]), coherence)


def linearized(slopes: Slopes, unknowns: Floats, near: float) -> tuple[Floats, Floats, Floats, NDArray[Any]]:
    """Residuals (N,), their derivatives (N, K), what each is trusted, and w_ζ² w*, all in units of their noise."""
    product, w, slope = slopes.at(unknowns)
    length, size = np.abs(slope), np.abs(w)
    noise = 2 * length * size * _SLOPE_NOISE * np.median(length), length**2 * (_NOISE + _LAW * size)
    scale = np.hypot(*noise) + 1e-12
    residual = product.imag / scale
    rows = [(slopes.at(unknowns + _STEP * one)[0].imag / scale - residual) / _STEP for one in np.eye(len(unknowns))]
    counted = size < near
    spread = MAD_TO_SIGMA * float(np.median(np.abs(residual[counted]))) + 1e-9 if counted.any() else 1.0
    trust = np.maximum(0, 1 - (residual / (BIWEIGHT * spread)) ** 2) ** 2 * counted
    return residual, np.stack(rows, axis=1), trust, product / scale


def _solved(rows: Floats, residual: Floats, trust: Floats) -> Floats:
    """The step (K,) that takes most of the residuals (N,) away."""
    square = rows.T @ (rows * trust[:, None])
    damped = square + (1e-9 * np.trace(square) + 1e-12) * np.eye(len(square))
    return np.asarray(np.linalg.solve(damped, -rows.T @ (residual * trust)))


def _untwisted(rows: Floats, residual: Floats, trust: Floats) -> Floats:
    """The same with the turn held: far from the answer it would take up what gains are wrong by."""
    return np.append(_solved(rows[:, :-1], residual, trust), 0.0)


def _reduced(light: Floats, usable: Bools) -> tuple[Floats, Bools]:
    """Means of blocks, and those far enough from what cannot be believed for a derivative."""
    block = max(1, round(float(np.sqrt(usable.sum())) / _SIDE))
    height, width = (size // block * block for size in usable.shape)
    shape = (height // block, block, width // block, block)
    means = light[:, :height, :width].reshape(len(light), *shape).mean((2, 4), dtype=np.float64)
    whole = usable[:height, :width].reshape(shape).all((1, 3)) & (means > 0).all(0)
    reach = 2 * int(2 * BLUR) + 1
    return means, cv2.erode(whole.astype(np.uint8), np.ones((reach, reach), np.uint8)) > 0


def _derivative(w: NDArray[Any]) -> NDArray[Any]:
    """½(∂x − i∂y) w, x right, y up, by the derivative of a Gaussian."""
    at = np.arange(-int(2 * BLUR), int(2 * BLUR) + 1)
    bell = np.exp(-(at**2) / (2 * BLUR**2))
    bell = bell / bell.sum()
    rise = at * bell / (at**2 * bell).sum()
    parts = np.ascontiguousarray(w.real), np.ascontiguousarray(w.imag)
    across, down = (
        [cv2.sepFilter2D(part, cv2.CV_64F, *kernels) for part in parts] for kernels in ((rise, bell), (bell, rise))
    )
    return np.asarray((across[0] + 1j * across[1] + 1j * (down[0] + 1j * down[1])) / 2)  # rows run down


def part_of(inside: Bools) -> NDArray[np.int_]:
    """Which of the parts each of the pixels (N,) is in."""
    y, x = np.nonzero(inside)
    rows, columns = ((axis - axis.min()) * _PARTS // (np.ptp(axis) + 1) for axis in (y, x))
    return np.asarray(rows * _PARTS + columns)


def _law_of_body() -> tuple[Floats, Floats]:
    """DoLP, and tan²θ over it; beyond _STEEPEST as there."""
    dolp = np.linspace(1e-4, _STEEPEST, 200)
    cosine = np.asarray(fresnel.cos_zenith_from_dolp(dolp, _IOR))
    return dolp, (1 / cosine**2 - 1) / dolp


_LAW_OF_BODY = _law_of_body()
