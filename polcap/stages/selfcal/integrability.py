"""Gains of the shots from integrability: the slopes of any surface are derivatives of one height field.

Let q = (S1 + i S2)/S0 be the polarization of a pixel, and w = tan²θ e^{2iφ} the squared slope that follows from it.
Then z = √w = h_x + i h_y are the slopes of the height h, and the derivative z_ζ = ½(∂x − i∂y) z = ½ Δh is real. The
sign of the square root is unknown, so the law is used in the form

    Im(w_ζ² w*) = 0,   for w = z², w_ζ = 2 z z_ζ, w_ζ² w* = 4 |z|⁴ z_ζ².

An error of a gain adds the same wrong polarization to q in every pixel, and breaks the law. So each pixel with
curvature gives an equation for the gains. The effect is largest near facing pixels, where w is small. Neither an
outline nor a facing surface is needed. If the sum of w_ζ² w* is not positive, the polarization does not come from
diffuse reflection, and the gains are unknown. A common turn of the angles turns w_ζ² w* by the same angle in all
pixels. It is a free parameter here, and `ring_zero.by_slopes` measures it.

References
----------
Frankot and Chellappa, A method for enforcing integrability in shape from shading algorithms, IEEE PAMI 1988 (the law).
"""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats
from polcap.optics import fresnel, mueller
from polcap.optics.morphology import erode
from polcap.optics.robust import biweight, jackknife, spread
from polcap.stages.selfcal.object_gains import GainEstimate, unknown

_SHOTS = 3  # for which gains are computed
_SIDE = 110.0  # px; larger objects are averaged down to this root of their area, to average noise
BLUR = 2.0  # px of the reduced picture, 1σ of the Gaussian that the derivative uses
_LEAST = 300  # pixels of the reduced object, away from its edge
_IOR = 1.5
_STEEPEST = 0.25  # largest DoLP that is used: 64° for index 1.5
_LARGEST = (0.6, 0.6, 0.6, 0.3, 0.3, *[0.15] * 8)  # largest |w| of the pixels used, in each step
_NOISE = 0.012  # of w, 1σ by noise
_MODEL = 0.3  # of w, relative 1σ by highlights and other refractive indices
_SLOPE_NOISE = 0.15  # of w_ζ, 1σ relative to the median
_STEP = 1e-4  # of the unknowns, for derivatives
_MOST_STEP = 0.03  # largest change of an unknown in one step
COHERENT = 0.25  # least share of w_ζ² w* that is positive for diffuse reflection
_PARTS = 4  # to a side of the object, left out one at a time
_LEAST_SIGMA = 0.0013  # of a gain, from simulated objects (decision 6)
_SIGMA_FACTOR = 2.0  # 1σ over the scatter of the parts (decision 6)


def gains(light: Floats, usable: Bools, angle: Floats, start: Floats) -> GainEstimate:
    """Gains (K,) of three shots from integrability of the slopes; unknown unless K = 3.

    light (K, H, W) is registered and slightly blurred, usable (H, W) are the object's unflagged pixels, angle (K,) rad,
    start (K,) first guesses. With more than three shots, use `object_gains.closure`.
    """
    shots = len(angle)
    slopes = reduced_slopes(light, usable, angle) if shots == _SHOTS else None
    if slopes is None:
        return unknown(shots)
    unknowns: Floats = np.append(start[1:] / start[0], 0.0)
    for largest in _LARGEST:  # least squares by biweight, over ever smaller w
        found = linearize(slopes, unknowns, largest)
        if largest < _LARGEST[0]:
            step = found.step(found.weight)
        else:  # far from the solution the turn would absorb the error of the gains
            step = np.append(replace(found, rows=found.rows[:, :-1]).step(found.weight), 0.0)
        unknowns = unknowns + np.clip(step, -_MOST_STEP, _MOST_STEP)
        if largest == _LARGEST[-1] and np.abs(step).max() < _STEP / 10:
            break
    if found.coherence < COHERENT:
        return unknown(shots)
    part = part_of(slopes.inside)
    scatter = jackknife(np.stack([found.step(found.weight * (part != p)) for p in np.unique(part)]))
    sigma = np.hypot(_SIGMA_FACTOR * scatter[:-1], _LEAST_SIGMA) / found.coherence
    return GainEstimate(np.append(1.0, unknowns[:-1]), np.append(0.0, sigma))


@dataclass(frozen=True)
class SlopeField:
    """Reduced shots of about 110 px a side, from which the slopes and their derivatives are computed."""

    light: Floats  # (K, h, w)
    inside: Bools  # (h, w)
    angle: Floats  # (K,) rad

    def at(self, unknowns: Floats) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """Slope terms w_ζ² w*, w and w_ζ, (N,) each.

        `unknowns` (K,) are the gains of all shots but the first, then the common angle error [rad].
        """
        gain = np.concatenate([[1.0], unknowns[:-1]])
        solve = np.linalg.pinv(mueller.analyzer(self.angle))
        s0, s1, s2 = np.einsum("jk,khw->jhw", solve, self.light / gain[:, None, None])
        q = (s1 + 1j * s2) / np.maximum(s0, 1e-9)
        w = q * np.interp(np.abs(q), *_SLOPES_OF_DOLP)
        slope = _derivative(w)[self.inside]
        w = w[self.inside]
        return slope**2 * np.conj(w) * np.exp(-2j * unknowns[-1]), w, slope


@dataclass(frozen=True)
class Equations:
    """Integrability equations Im(w_ζ² w*) = 0, linearized about a guess, in units of their noise."""

    residual: Floats  # (N,)
    rows: Floats  # (N, K) derivatives by the unknowns
    weight: Floats  # (N,) 0…1, Tukey's
    product: NDArray[Any]  # (N,) w_ζ² w*

    def step(self, weight: Floats, prior: Floats | float = 0.0, moved: Floats | float = 0.0) -> Floats:
        """Least-squares step (K,) of the unknowns (gains and angle error).

        `prior` (K,) are the weights with which a prior pulls them back; `moved` (K,) is their distance from it.
        """
        square = self.rows.T @ (self.rows * weight[:, None]) + prior * np.eye(self.rows.shape[1])
        damped = square + (1e-9 * np.trace(square) + 1e-12) * np.eye(len(square))
        return np.asarray(np.linalg.solve(damped, -self.rows.T @ (self.residual * weight) - prior * moved))

    @property
    def coherence(self) -> float:
        """Weighted sum of Re(w_ζ² w*) over the weighted sum of |w_ζ² w*|, −1…1.

        It is near 1 for diffuse reflection, negative for specular reflection.
        """
        size = float((self.weight * np.abs(self.product)).sum())
        return float((self.weight * self.product.real).sum() / max(size, 1e-30))


def reduced_slopes(light: Floats, usable: Bools, angle: Floats) -> SlopeField | None:
    """Average the shots down to about 110 px a side, and find the pixels with derivatives; None for too few.

    light (K, H, W), usable (H, W) and angle (K,) as of `gains`.
    """
    block = max(1, round(float(np.sqrt(usable.sum())) / _SIDE))
    height, width = (size // block * block for size in usable.shape)
    shape = (height // block, block, width // block, block)
    means = light[:, :height, :width].reshape(len(light), *shape).mean((2, 4), dtype=np.float64)
    usable_blocks = usable[:height, :width].reshape(shape).all((1, 3)) & (means > 0).all(0)
    inside = erode(usable_blocks, int(2 * BLUR))
    return SlopeField(means, inside, angle) if inside.sum() >= _LEAST else None


def linearize(slopes: SlopeField, unknowns: Floats, largest: float) -> Equations:
    """Linearize Im(w_ζ² w*) = 0 about gains and angle error `unknowns` (K,), for pixels with |w| < `largest`."""
    product, w, slope = slopes.at(unknowns)
    length, size = np.abs(slope), np.abs(w)
    scale = 1e-12 + np.hypot(2 * length * size * _SLOPE_NOISE * np.median(length), length**2 * (_NOISE + _MODEL * size))
    residual = product.imag / scale
    rows = [(slopes.at(unknowns + _STEP * one)[0].imag / scale - residual) / _STEP for one in np.eye(len(unknowns))]
    used = size < largest
    sigma = spread(residual[used]) if used.any() else 1.0
    return Equations(residual, np.stack(rows, axis=1), biweight(residual, sigma) * used, product / scale)


def part_of(inside: Bools) -> NDArray[np.int_]:
    """Divide the object into 4 × 4 parts: part 0…15 of each pixel inside, (N,)."""
    y, x = np.nonzero(inside)
    rows, columns = ((axis - axis.min()) * _PARTS // (np.ptp(axis) + 1) for axis in (y, x))
    return np.asarray(rows * _PARTS + columns)


def _derivative(w: NDArray[Any]) -> NDArray[Any]:
    """Complex derivative ½(∂x − i∂y) w of a map, x right, y up, by the derivative of a Gaussian."""
    at = np.arange(-int(2 * BLUR), int(2 * BLUR) + 1)
    bell = cv2.getGaussianKernel(len(at), BLUR)[:, 0]
    slope = at * bell / (at**2 * bell).sum()
    parts = w.view(np.float64).reshape(*w.shape, 2)
    across, down = (
        cv2.sepFilter2D(parts, -1, *kernels).view(np.complex128)[..., 0] for kernels in ((slope, bell), (bell, slope))
    )
    return np.asarray((across + 1j * down) / 2)  # rows run down


def _slopes_of_dolp() -> tuple[Floats, Floats]:
    """Table to convert a DoLP of diffuse reflection to a squared slope: DoLPs, and tan²θ / DoLP for each."""
    dolp = np.linspace(1e-4, _STEEPEST, 200)
    cosine = np.asarray(fresnel.cos_zenith_from_dolp(dolp, _IOR))
    return dolp, (1 / cosine**2 - 1) / dolp


_SLOPES_OF_DOLP = _slopes_of_dolp()
