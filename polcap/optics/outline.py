"""The outline of an object: distance of pixels to it, its outward direction, and the polarization along it.

At the outline of a closed surface the normal is perpendicular to the view and points outward. This decides the order
and sense of the polarizer angles, and the half-turns of normals.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats
from polcap.optics import mueller

SECTORS = 24  # parts of an outline, 15° each from the object's center; their scatter gives the error
_MATTE_PX = 1.2  # 1σ; halves the error of the mask on lines and on discs of 8 px radius and more
DOLP_CAP = 0.4  # largest weight: the DoLP of a smooth body of index 1.5 is 0.385 edge-on (optics.fresnel)


@dataclass(frozen=True)
class OutlineBand:
    """Light, outward azimuth and sector of the pixels just inside the object's outline."""

    light: Floats  # (K, N) registered shots, divided by their gains
    azimuth: Floats  # (N,) rad, outward direction of the outline, from image x towards image up
    sector: NDArray[np.int_]  # (N,) 0…23, part of the outline by direction from the object's center


def disc_radius(mask: Bools) -> float:
    """Radius √(N/π) of a disc with as many pixels as the mask (H, W), px: the size of an object."""
    return float(np.sqrt(mask.sum() / np.pi))


def depth(mask: Bools) -> Floats:
    """Distance [px] of each object pixel to the outline (H, W); the picture's edge counts as outline."""
    return np.asarray(cv2.distanceTransform(np.pad(mask.astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1])


def matte(mask: Bools) -> Floats:
    """Share 0…1 of each pixel that the object covers, from its mask (H, W), for pictures with a soft outline.

    Blurred by a Gaussian, a straight outline has the slope 1/(σ √2π) per px. Divided by it, the outline blends over one
    pixel, and the steps of the mask are gone. The picture's border is no outline.
    """
    smooth = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), _MATTE_PX, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(np.clip(0.5 + np.sqrt(2 * np.pi) * _MATTE_PX * (smooth - 0.5), 0, 1), np.float32)


def fill_outward(value: Any, known: Bools) -> Any:
    """Fill unknown pixels of an image (H, W, C) with the value of the nearest known pixel."""
    if known.all() or not known.any():
        return value
    label = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )[1].ravel()
    inside, missing = np.flatnonzero(known), np.flatnonzero(~known)  # indices take half the time of a mask
    source = np.empty(int(label.max()) + 1, np.intp)
    source[label[inside]] = inside  # every known pixel is the nearest to itself
    out = value.reshape(-1, value.shape[-1]).copy()
    out[missing] = out.take(source[label[missing]], axis=0)
    return out.reshape(value.shape)


def outward(inside: Floats, blur_px: float) -> tuple[Floats, Floats]:
    """Direction out of an object: unit vectors (2, H, W), x right, y up, and the length (H, W) of the gradient.

    `inside` (H, W) is a mask as floats, for directions near the outline only, or its `depth`, for directions
    everywhere. It is blurred by a Gaussian of 1σ = `blur_px` first. Sobel's weights make the gradient 8 times the slope
    per px. Where it is 0, the vector is 0.
    """
    smooth = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), blur_px)
    dx, dy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    slope = np.hypot(dx, dy)
    return np.stack([-dx, dy]) / (slope + 1e-6), slope  # rows run down


def sectors(band: Bools) -> NDArray[np.int_]:
    """Sector 0…23 (N,) of each of the N pixels of a band (H, W) along the outline, by direction from its center."""
    y, x = np.nonzero(band)
    around = np.arctan2(y - y.mean(), x - x.mean()) if len(y) else np.zeros(0)
    return np.floor((around + np.pi) / (2 * np.pi) * SECTORS).astype(int) % SECTORS


def polarization(band: OutlineBand, angle: Floats) -> NDArray[Any]:
    """Complex polarization (S1 + i S2)/S0 of the outline's pixels, (N,), from polarizer angles (K,) rad."""
    s0, s1, s2 = np.linalg.lstsq(mueller.analyzer(angle), band.light, rcond=None)[0]
    return np.asarray((s1 + 1j * s2) / np.maximum(s0, 1e-9))


def phasor(band: OutlineBand, angle: Floats) -> tuple[NDArray[Any], Floats]:
    """Sum the polarization relative to the contour by sector: Σ w e^{2i(φ − φ_contour)} (24,) and Σ w (24,).

    φ is the AoLP from polarizer angles (K,) rad, φ_contour the outward direction, w the DoLP up to DOLP_CAP. The sum is
    real and positive for diffuse reflection, which is polarized across the contour.
    """
    polarized = polarization(band, angle)
    weight = np.minimum(np.abs(polarized), DOLP_CAP)
    relative = weight * polarized / np.maximum(np.abs(polarized), 1e-12) * np.exp(-2j * band.azimuth)
    real, imaginary = (np.bincount(band.sector, part, SECTORS) for part in (relative.real, relative.imag))
    return real + 1j * imaginary, np.asarray(np.bincount(band.sector, weight, SECTORS), np.float64)


def mean_and_sigma(total: NDArray[Any], weight: Floats) -> tuple[complex, float]:
    """Mean polarization of the outline from the sums of `phasor`, (24,) each, and 1σ [rad] of its angle.

    The angle, half the argument of the mean, is a common error of all polarizer angles.
    """
    mean = complex(total.sum() / max(float(weight.sum()), 1e-9))
    used = weight > 0
    across = (total[used] / weight[used] * np.exp(-1j * np.angle(mean))).imag
    sigma = float(across.std() / np.sqrt(max(len(across), 1)) / max(2 * abs(mean), 1e-3)) if len(across) else np.pi / 2
    return mean, min(sigma, np.pi / 2)
