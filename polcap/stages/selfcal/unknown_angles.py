"""Finds unknown polarizer angles from the object's outline and inside.

Unknown angles need four shots with well known gains. Shots at angles θ are I = A(θ) S, of rank three. Another A′ = A B
explains them equally well if its rows have the form (1, cos, sin): an affine map then takes points of the unit circle
to points of the unit circle. Five points determine an ellipse, so five shots determine θ up to a common turn and the
sense; with four shots one more parameter is free. The outline determines the rest: light there is polarized along the
contour's normal φ, so I is in the span of 1 and cos 2(φ − θ) in every part of it. `ring_zero.by_slopes` finds the
remaining common turn.
"""

import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Floats
from polcap.optics import outline
from polcap.optics.outline import OutlineBand
from polcap.optics.robust import jackknife

_BINS = 36  # of φ, 10° each
_LEAST_BINS = 24  # bins with light; fewer do not determine turn and sense
_STARTS = 20  # random starts, the same every time
_COARSE, _FINE = 1e-3, 1e-7  # relative change of the misfit that ends a fit: from all starts, from the best ones
_BEST = 4  # number of best starts
_AS_GOOD = 1.3  # of the least misfit; solutions with no more misfit are possible too
_OUTLINE = 0.012  # relative 1σ of the outline's light from ideal diffuse reflection
_OTHER_OUTLINES = (0.004, 0.03)  # the range of this 1σ: parts of an outline differ by up to 3 %
_SIDES = 8  # parts of the outline and of the inside, left out one at a time
_INSIDE = 0.0001  # relative 1σ inside, by interpolation and gains
_FLOOR = np.radians(0.3)  # least 1σ (200 simulated cases)


def find_angles(band: OutlineBand, cells: Floats, row: NDArray[np.int_]) -> tuple[Floats, float]:
    """Find the unknown polarizer angles (K,) in 0…π rad of four or more shots, and their common 1σ [rad].

    `band` is the object's outline; cells (K, P) are means of small blocks of its inside, row (P,) is the row of each
    block. All are divided by the gains. The outline is averaged over bins of φ. The residual of the inside is its
    distance from the column space of A(θ). Both are weighted by their scatter. The 1σ combines a jackknife over parts
    of outline and inside, the change with the assumed 1σ of the outline, and the distance to other solutions that fit
    equally well. It is π/2 if nothing is known.
    """
    shots = len(cells)
    rim, phi = _by_direction(band)
    lit = rim.min(axis=1) > 0
    if lit.sum() < _LEAST_BINS or cells.shape[1] < 10 * shots:
        return np.zeros(shots), np.pi / 2
    rim, phi = rim[lit], phi[lit]
    inside = _condensed(cells)
    random = np.random.default_rng(outline.SECTORS)
    fits = [_solve(rim, phi, inside, random.uniform(0, np.pi, shots), _COARSE) for _ in range(_STARTS)]
    fits = [_solve(rim, phi, inside, start, _FINE) for _, start in sorted(fits, key=lambda fit: fit[0])[:_BEST]]
    least, angle = min(fits, key=lambda fit: fit[0])
    ambiguity = max(float(np.abs(_difference(one, angle)).max()) for misfit, one in fits if misfit < _AS_GOOD * least)
    side = np.arange(len(phi)) * _SIDES // len(phi)
    part = np.argsort(np.argsort(row, kind="stable")) * _SIDES // len(row)
    by_side = [_solve(rim[side != s], phi[side != s], inside, angle, _FINE)[1] for s in range(_SIDES)]
    by_part = [_solve(rim, phi, _condensed(cells[:, part != s]), angle, _FINE)[1] for s in range(_SIDES)]
    by_sigma = [_difference(_solve(rim, phi, inside, angle, _FINE, sigma)[1], angle) for sigma in _OTHER_OUTLINES]
    variance = np.mean(np.square(by_sigma), axis=0)  # (K,)
    for without in (by_side, by_part):
        variance = variance + jackknife(np.array([_difference(one, angle) for one in without]), about=0.0) ** 2
    return angle % np.pi, min(float(np.sqrt(_FLOOR**2 + variance.max() + ambiguity**2)), np.pi / 2)


def _by_direction(band: OutlineBand) -> tuple[Floats, Floats]:
    """Light of the outline averaged in bins of its azimuth, (B, K), and the mean azimuth φ (B,) rad of each."""
    number = np.floor(band.azimuth / (2 * np.pi) * _BINS).astype(int) % _BINS
    light = np.stack([np.bincount(number, shot, _BINS) for shot in band.light], axis=1).astype(np.float64)
    weight = band.light.sum(axis=0)
    sums = [np.bincount(number, weight * wave, _BINS) for wave in (np.cos(band.azimuth), np.sin(band.azimuth))]
    return light, np.arctan2(sums[1], sums[0])


def _condensed(cells: Floats) -> Floats:
    """Condense cells (K, P) to a matrix (K, K) with the same sum of squared distances from any subspace.

    Each cell is divided by its mean light. The mean over all cells is subtracted, because errors of the gains change
    it.
    """
    relative = cells / cells.mean(axis=0)
    relative = relative - relative.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(relative @ relative.T / relative.shape[1])
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0)))


def _solve(
    rim: Floats, phi: Floats, inside: Floats, start: Floats, tolerance: float, outline_sigma: float = _OUTLINE
) -> tuple[float, Floats]:
    """Fit polarizer angles (K,) from a start to the light (B, K) of the rim at azimuths phi (B,) and of the inside.

    Returns the misfit and the angles. `tolerance` is the relative change of the misfit that ends the fit.

    Two solutions that differ by 90° fit equally well; the result is that of diffuse reflection.
    """
    relative = rim / rim.mean(axis=1, keepdims=True)
    from scipy.optimize import least_squares  # here: the import takes 0.3 s

    args = relative, phi, inside, outline_sigma
    fit = least_squares(_residual, start, args=args, method="lm", ftol=tolerance, max_nfev=150)
    along = np.cos(2 * (phi[:, None] - fit.x))
    along -= along.mean(axis=1, keepdims=True)
    angle = fit.x if float((along * relative).sum()) > 0 else fit.x + np.pi / 2
    return float(fit.cost), np.asarray(angle)


def _residual(angle: Floats, relative: Floats, phi: Floats, inside: Floats, outline_sigma: float) -> Floats:
    """Residuals for polarizer angles, over their 1σ: outline from the span of 1 and cos 2(φ − θ), inside from A(θ)."""
    ones = np.ones(len(angle)) / np.sqrt(len(angle))
    wave = np.cos(2 * (phi[:, None] - angle))
    wave = wave - (wave @ ones)[:, None] * ones
    wave = wave / np.maximum(np.linalg.norm(wave, axis=1, keepdims=True), 1e-9)
    left = relative - (relative @ ones)[:, None] * ones
    left = left - (left * wave).sum(axis=1, keepdims=True) * wave
    rows = np.stack([np.ones_like(angle), np.cos(2 * angle), np.sin(2 * angle)], axis=1)
    basis, _ = np.linalg.qr(rows)
    out = inside - basis @ (basis.T @ inside)
    return np.concatenate([left.ravel() / outline_sigma / np.sqrt(len(phi)), out.ravel() / _INSIDE])


def _difference(a: Floats, b: Floats) -> Floats:
    """Angle from axis b to axis a, −π/2…π/2 rad; axes have no sense."""
    return np.asarray((a - b + np.pi / 2) % np.pi - np.pi / 2)
