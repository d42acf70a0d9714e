"""Error of the normals that errors of the shots' gains cause.

Wrong gains add one false polarization to all pixels. It tilts a normal that faces the camera, whose light is hardly
polarized, by far more than one whose light is well polarized, and the tilt grows more slowly than the error. So the
polarization of the pixels determines the cost (docs/benchmarks/gains-and-angles.md).
"""

import numpy as np

from polcap.image_values import Floats
from polcap.optics import fresnel, mueller
from polcap.stages.cues import NOMINAL_IOR

_DIRECTIONS = 8  # of the false polarization, evenly spread
_MOST_PIXELS = 5000
# error that false polarization adds to the network's normals, over the tilt by the law of diffuse reflection: 1.0 for
# tilts below 8°, 1.2 above 14° (docs/benchmarks/gains-and-angles.md)
_OF_NETWORK = 1.15


def normal_error_deg(ratio: Floats, angle: Floats, sigma: Floats) -> float:
    """Error of the normals [degrees] for errors of the gains, RMS over these errors, median over the pixels.

    `ratio` (2, N) is S1/S0 and S2/S0 of the pixels, `angle` (K,) rad, `sigma` (K,) the relative 1σ of each gain.
    """
    added = _polarization_per_gain(angle) * sigma  # (2, K)
    length, axes = np.linalg.eigh(added @ added.T)
    root = axes * np.sqrt(np.maximum(length, 0))  # (2, 2)
    turn = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    # (2, 8) with the covariance of the errors: x and y of the unit circle have the variance ½
    circle = np.sqrt(2) * root @ np.stack([np.cos(turn), np.sin(turn)])
    return _median_tilt_deg(ratio, circle)


def other_gains_deg(ratio: Floats, angle: Floats, change: Floats) -> float:
    """Error of the normals [degrees], median over the pixels, if the gains are wrong by a relative `change` (K,)."""
    return _median_tilt_deg(ratio, (_polarization_per_gain(angle) @ change)[:, None])


def _polarization_per_gain(angle: Floats) -> Floats:
    """False S1/S0 and S2/S0 (2, K) per relative error of each shot's gain; a shot has half of S0."""
    return np.asarray(np.linalg.pinv(mueller.analyzer(angle))[1:] / 2)


def _median_tilt_deg(ratio: Floats, added: Floats) -> float:
    """Error of the network's normals for M false polarizations (2, M), RMS over these, median over pixels (2, N)."""
    if not ratio.size:
        return float("nan")
    ratio = ratio[:, :: max(1, ratio.shape[1] // _MOST_PIXELS)]
    tilt = np.stack([_tilt(ratio, ratio + one[:, None]) for one in added.T])  # (M, N)
    return _OF_NETWORK * float(np.degrees(np.median(np.sqrt((tilt**2).mean(0)))))


def _tilt(true: Floats, false: Floats) -> Floats:
    """Angle (N,) [rad] between the normals of two polarizations (2, N): of their two sides, the nearer one."""
    (x, y, z), (other_x, other_y, other_z) = _normal(true), _normal(false)
    cosine = np.abs(x * other_x + y * other_y) + z * other_z
    return np.asarray(np.arccos(np.clip(cosine, -1, 1)))


def _normal(ratio: Floats) -> Floats:
    """Normals (3, N) of diffuse reflection with the polarization S1/S0, S2/S0 (2, N)."""
    cosine = np.asarray(fresnel.cos_zenith_from_dolp(np.hypot(*ratio), NOMINAL_IOR))
    azimuth, sine = np.arctan2(ratio[1], ratio[0]) / 2, np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine])
