"""Robust statistics: spread from medians, Tukey's biweight, the jackknife, a sensor's noise line."""

from dataclasses import dataclass

import numpy as np

from polcap.image_values import Floats

MAD_TO_SIGMA = 1.4826  # 1/Φ⁻¹(¾): median absolute deviation → standard deviation of a normal distribution
MEDIAN_SE = float((np.pi / 2) ** 0.5)  # standard error of a median over that of a mean, of normal scatter
BIWEIGHT = 4.685  # σ at which Tukey's biweight ends: 95 % as efficient as least squares (Holland & Welsch, 1977)
_NEVER_ZERO = 1e-9  # added to a spread before something is divided by it
_OUTLIER = 2.5  # σ beyond which a variance counts less in a noise line
_ALL_ALIKE = 1e-10  # relative determinant below which signals of one level determine no line


def spread(residual: Floats) -> float:
    """Standard deviation (1σ) of residuals (N,) about 0 by their median absolute value, never 0."""
    return MAD_TO_SIGMA * float(np.median(np.abs(residual))) + _NEVER_ZERO


def biweight(residual: Floats, sigma: float) -> Floats:
    """Tukey's biweight (1 − (r/4.685σ)²)² of residuals of any shape; 0 beyond 4.685σ."""
    return np.asarray(np.maximum(0, 1 - (residual / (BIWEIGHT * sigma)) ** 2) ** 2)


def jackknife(without: Floats, about: Floats | float | None = None) -> Floats:
    """Error (1σ) of an estimate, (...,), from P estimates (P, ...), each made without one of P parts of the data.

    `about` is the estimate from all parts; without it their mean is taken.

    References
    ----------
    Efron, The Jackknife, the Bootstrap and Other Resampling Plans, 1982, eq. (3.6).
    """
    without = np.asarray(without)
    count = len(without)
    middle = without.mean(axis=0) if about is None else about
    return np.asarray(np.sqrt((count - 1) / count * ((without - middle) ** 2).sum(axis=0)))


@dataclass(frozen=True)
class NoiseFit:
    """A fitted noise line, variance = slope · signal + floor; NaN where all signals are alike."""

    slope: float
    floor: float
    covariance: Floats  # (2, 2) of both, as expected from the number of differences


def fit_noise_line(
    signal: Floats,
    variance: Floats,
    freedom: Floats | float,
    *,
    least: float,
    edges: Floats | None = None,
    least_floor: float = -np.inf,
    outliers: bool = False,
) -> NoiseFit:
    """Fit a sensor's noise line (variance over signal) by iterated least squares of relative errors.

    A variance that was measured from n differences (`freedom`) has a relative error √(2/n). So each variance (N,) has
    the weight n/2 over the square of the line's value, which counts as at least `least`. `edges` (N,) is a second cause
    of variance, fitted as well. `least_floor` is the variance of rounding. With `outliers`, variances more than 2.5σ
    from the line have less weight.

    References
    ----------
    Janesick, Photon Transfer, SPIE 2007, ch. 5.
    """
    columns = [signal, np.ones_like(signal), *([] if edges is None else [edges])]
    matrix = np.stack(columns, axis=1).astype(np.float64)  # (N, 2 or 3)
    model = np.full(len(signal), float(np.mean(variance)))
    for _ in range(8):
        model = np.maximum(model, least)
        weight = np.broadcast_to(np.asarray(freedom) / 2, model.shape) / model**2
        if outliers:
            error = np.abs(variance - model) * np.sqrt(weight)
            weight = weight / np.maximum(1, error / (_OUTLIER * max(1.0, spread(error)))) ** 2
        normal, right = (matrix * weight[:, None]).T @ matrix, (matrix * weight[:, None]).T @ variance
        scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
        scaled = normal * scale[:, None] * scale
        if np.linalg.det(scaled) < _ALL_ALIKE:
            return NoiseFit(np.nan, np.nan, np.full((2, 2), np.nan))
        inverse = np.linalg.inv(scaled) * scale[:, None] * scale
        found = inverse @ right
        if found[1] < least_floor:  # the slope that fits best with the least floor
            found[0] += normal[0, 1] / normal[0, 0] * (found[1] - least_floor)
            found[1] = least_floor
        model = matrix @ found
    return NoiseFit(float(found[0]), float(found[1]), inverse[:2, :2])
