"""An object's outline: how deep a pixel lies inside it, which way is out, and how the light there is polarized.

Where a closed surface turns edge-on its normal points out across the outline; that is what order,
handedness and half-turns are settled by.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
from polcap.optics import mueller

SECTORS = 24  # of an outline, 15° each as seen from the object's middle; their scatter is the doubt
DOLP_CAP = 0.4  # weights end here: edge-on, a smooth body of index 1.5 emits 0.385 and none more (optics.fresnel)


@dataclass(frozen=True)
class Rim:
    """The band inside the outline."""

    light: Floats  # (K, N) of the registered shots, gains taken out
    azimuth: Floats  # (N,) rad, outward direction of the outline, from image x towards image up
    sector: NDArray[np.int_]  # (N,) part of the outline, 0…23, seen from the object's middle


def disc_radius(mask: NDArray[np.bool_]) -> float:
    """Radius √(N/π) of a disc with as many pixels as the mask (H, W), px: the size of an object."""
    return float(np.sqrt(mask.sum() / np.pi))


def depth(mask: NDArray[np.bool_]) -> Floats:
    """Distance of each pixel of the mask to the outline (H, W), px; the picture's edge counts as one."""
    return np.asarray(cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1])


def outward(inside: Floats, blur_px: float) -> tuple[Floats, Floats]:
    """The way out, and how clear it is.

    Parameters
    ----------
    inside
        (H, W), a mask as floats or its `depth`: larger further in. The mask tells the way near the outline
        alone, the depth everywhere.
    blur_px
        1σ of the Gaussian that rounds its pixels off first.

    Returns
    -------
    direction
        (2, H, W) unit vectors, x right, y up; zero where nothing tells.
    slope
        (H, W) of the blurred `inside` per px, times 8 (Sobel's weights).
    """
    smooth = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), blur_px)
    dx, dy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    slope = np.hypot(dx, dy)
    return np.stack([-dx, dy]) / (slope + 1e-6), slope  # rows run down


def sectors(band: NDArray[np.bool_]) -> NDArray[np.int_]:
    """The sector 0…23 of each pixel of the band (H, W), (N,)."""
    y, x = np.nonzero(band)
    around = np.arctan2(y - y.mean(), x - x.mean()) if len(y) else np.zeros(0)
    return np.floor((around + np.pi) / (2 * np.pi) * SECTORS).astype(int) % SECTORS


def polarization(at: Rim, angle: Floats) -> NDArray[Any]:
    """(S1 + i S2)/S0 along the rim, (N,), of shots through polarizers at angle (K,) rad."""
    s0, s1, s2 = np.linalg.lstsq(mueller.analyzer(angle), at.light, rcond=None)[0]
    return np.asarray((s1 + 1j * s2) / np.maximum(s0, 1e-9))


def phasor(at: Rim, angle: Floats) -> tuple[NDArray[Any], Floats]:
    """How the polarization lies to the contour, sector by sector.

    Parameters
    ----------
    at
        The rim's light.
    angle
        (K,) rad, of the shots' polarizers.

    Returns
    -------
    total
        (24,) Σ w e^{2i(φ − φ_contour)}, φ the AoLP; real and positive where it crosses the contour as a body's does.
    weight
        (24,) Σ w, w the DoLP up to what a body has.
    """
    along = polarization(at, angle)
    weight = np.minimum(np.abs(along), DOLP_CAP)
    lying = weight * along / np.maximum(np.abs(along), 1e-12) * np.exp(-2j * at.azimuth)
    real, imaginary = (np.bincount(at.sector, part, SECTORS) for part in (lying.real, lying.imag))
    return real + 1j * imaginary, np.asarray(np.bincount(at.sector, weight, SECTORS), np.float64)


def mean_and_doubt(total: NDArray[Any], weight: Floats) -> tuple[complex, float]:
    """The mean of what `phasor` gives, (24,) each, and 1σ of half its argument: the common turn of all angles, rad."""
    mean = complex(total.sum() / max(float(weight.sum()), 1e-9))
    used = weight > 0
    across = (total[used] / weight[used] * np.exp(-1j * np.angle(mean))).imag
    sigma = float(across.std() / np.sqrt(max(len(across), 1)) / max(2 * abs(mean), 1e-3)) if len(across) else np.pi / 2
    return mean, min(sigma, np.pi / 2)
