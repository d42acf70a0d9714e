"""Extinction ratio, zero and sense of a polarizer on its ring, from polarized light of a known axis.

At the ring angle θ the filter's axis is at s θ + z. The intensity of light polarized along α is then
I(θ) = a (1 + c cos 2(s θ + z − α)). The contrast c gives the extinction ratio E = (1 + c)/(1 − c), the phase gives the
zero z. To find the sense s = ±1, light of two axes is needed.

References
----------
Collett, Polarized Light, ch. 5 (law of Malus).
"""

from dataclasses import dataclass

import numpy as np

from polcap.calibrate.calibration_photographs import Photograph, exposed_center
from polcap.calibration_values import Polarizer
from polcap.errors import CaptureError
from polcap.image_values import Floats

_LEAST = 5  # angles of the ring, for three unknowns and a scatter
_LAMP = 1e-3  # relative 1σ of a steady lamp from frame to frame
_RING_DEG = 0.1  # 1σ of a ring's angle; lamp and ring give the weights of frames, their scatter gives the error
_SPAN_DEG = 90.0  # least range of ring angles
_LEAST_DIFFERENCE_DEG = 10.0  # between two axes, and between their mirror images, to find the sense


@dataclass(frozen=True)
class PolarizerShot:
    """One photograph of `polarizer/`: axis of the light, angle of the ring."""

    axis_deg: float  # of the light
    ring_deg: float  # as stated
    photograph: Photograph


@dataclass(frozen=True)
class _MalusFit:
    """Malus curve (cos²) fitted to the photographs in light of one axis: phase and contrast with 1σ."""

    axis_deg: float
    phase_deg: float  # ring angle of most light
    phase_sigma_deg: float
    contrast: Floats  # (C,)
    contrast_sigma: Floats  # (C,)


def measure(turned: list[PolarizerShot]) -> Polarizer:
    """Measure extinction ratio, zero and sense of a polarizer on its ring, from light of all known axes.

    Raises CaptureError for too few angles, unequal exposures, or light that is not polarized.
    """
    axes = sorted({shot.axis_deg for shot in turned})
    curves = [_fit_axis([shot for shot in turned if shot.axis_deg == axis]) for axis in axes]
    known = _shows_sense(curves)
    zeros = {sense: _zero(curves, sense) for sense in ((1, -1) if known else (1,))}
    sense, (zero, sigma, _) = min(zeros.items(), key=lambda one: one[1][2])  # least difference between the axes
    weight = np.array([1 / np.maximum(curve.contrast_sigma, 1e-9) ** 2 for curve in curves])
    contrast = (weight * np.array([curve.contrast for curve in curves])).sum(0) / weight.sum(0)
    contrast_sigma = 1 / np.sqrt(weight.sum(0))
    leak = np.maximum(1 - contrast, 1e-6)
    return Polarizer(
        zero_deg=round(zero, 3),
        zero_sigma_deg=sigma,
        sense=sense,
        sense_known=known,
        extinction=tuple(((1 + contrast) / leak).tolist()),
        extinction_sigma=tuple((2 * contrast_sigma / leak**2).tolist()),
        frames=len(turned),
    )


def _fit_axis(shots: list[PolarizerShot]) -> _MalusFit:
    """Fit a Malus curve to the light of one axis. Raises CaptureError: exposures, angles or contrast do not suffice."""
    folder = shots[0].photograph.path.parent.parent
    if len({shot.photograph.setting for shot in shots}) > 1:
        raise CaptureError(f"{folder}: frames of unequal exposure; take all angles of the ring with one setting")
    ring = np.radians([shot.ring_deg for shot in shots])
    angles = np.unique(np.round(np.degrees(ring) % 180, 2))
    if len(angles) < _LEAST or np.ptp(angles) < _SPAN_DEG:
        raise CaptureError(
            f"{folder}: {len(angles)} angles of the ring over {np.ptp(angles):.0f}°; take {_LEAST} or more over 180°, "
            "best every 15°"
        )
    light = [exposed_center(shot.photograph) for shot in shots]
    solved = [_fit_wave(ring, channel) for channel in np.array(light).T]
    wave, covariance = (np.array(values) for values in zip(*solved))  # (C, 3), (C, 3, 3)
    length = np.hypot(wave[:, 1], wave[:, 2])
    contrast = length / wave[:, 0]
    if contrast.max() < 0.2:
        raise CaptureError(f"{folder}: the light hardly changes with the ring ({contrast.max():.2f}); is it polarized?")
    # derivatives (C, 3) of contrast and phase
    contrast_by_wave = np.stack([-contrast, wave[:, 1] / length, wave[:, 2] / length], axis=1) / wave[:, :1]
    phase_by_wave = np.stack([0 * length, -wave[:, 2], wave[:, 1]], axis=1) / (2 * length**2)[:, None]
    sigma = np.sqrt(np.einsum("ci,cij,cj->c", contrast_by_wave, covariance, contrast_by_wave))
    phase_sigma = np.sqrt(np.einsum("ci,cij,cj->c", phase_by_wave, covariance, phase_by_wave))
    phase = np.arctan2((wave[:, 2] / phase_sigma**2).sum(), (wave[:, 1] / phase_sigma**2).sum()) / 2
    # all channels share the error of the ring's angles, so their average has no smaller one
    return _MalusFit(shots[0].axis_deg, float(np.degrees(phase)), float(np.degrees(phase_sigma.min())), contrast, sigma)


def _fit_wave(ring: Floats, light: Floats) -> tuple[Floats, Floats]:
    """Fit a Malus curve of phase φ: a, a c cos 2φ, a c sin 2φ, and covariance (3, 3) by the scatter of the frames."""
    matrix = np.stack([np.ones_like(ring), np.cos(2 * ring), np.sin(2 * ring)], axis=1)
    weight = np.ones_like(light)
    for _ in range(6):  # the weights follow from the curve
        normal = (matrix * weight[:, None]).T @ matrix
        wave = np.linalg.solve(normal, (matrix * weight[:, None]).T @ light)
        slope = 2 * (wave[2] * np.cos(2 * ring) - wave[1] * np.sin(2 * ring))
        variance = (_LAMP * matrix @ wave) ** 2 + (np.radians(_RING_DEG) * slope) ** 2
        weight = 1 / np.maximum(variance, (1e-5 * wave[0]) ** 2)
    residual = light - matrix @ wave
    chi2 = float(np.sum(weight * residual**2)) / max(len(light) - 3, 1)
    return wave, np.linalg.inv(normal) * max(chi2, 0.1)  # 1σ is at least 0.3 of that by `_LAMP` and `_RING_DEG`


def _shows_sense(curves: list[_MalusFit]) -> bool:
    """Whether the light's axes can show the sense of the ring: the two senses predict different phases."""
    return any(
        _LEAST_DIFFERENCE_DEG < (one.axis_deg - other.axis_deg) % 90 < 90 - _LEAST_DIFFERENCE_DEG
        for one in curves
        for other in curves
    )


def _zero(curves: list[_MalusFit], sense: int) -> tuple[float, float, float]:
    """Zero of the ring z = α − s ψ from all axes, −90…90°, its 1σ, and the rms difference between the axes."""
    zeros = np.array([curve.axis_deg - sense * curve.phase_deg for curve in curves])
    weight = np.array([1 / curve.phase_sigma_deg**2 for curve in curves])
    vector = np.sum(weight * np.exp(2j * np.radians(zeros))) / weight.sum()
    zero = float(np.degrees(np.angle(vector)) / 2)
    difference = (zeros - zero + 90) % 180 - 90
    misfit = float(np.sqrt(np.sum(weight * difference**2) / weight.sum()))
    between = misfit / np.sqrt(max(len(curves) - 1, 1)) if len(curves) > 1 else 0.0
    return zero, float(np.hypot(1 / np.sqrt(weight.sum()), between)), misfit
