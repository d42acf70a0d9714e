"""Stage 6: solve each pixel's linear Stokes parameters from its K angles.

Gains and transforms are applied here and nowhere else, so every pixel is resampled once.
"""

from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta

from polcap.errors import CaptureError
from polcap.images import Alignment, AngleStack, Bits, Floats, Gains, ObjectMask, Quality, StokesImage, View
from polcap.optics import fresnel, mueller
from polcap.optics.warp import covered, warp
from polcap.stages import stage

_ROWS = 16


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    greatest_ior: Annotated[
        float,
        Meta(ge=1.2, le=3, description="a DoLP no dielectric up to this refractive index emits is flagged"),
    ] = 1.8
    dark_sigma: Annotated[
        float, Meta(ge=0, le=100, description="S0 below this many standard deviations is flagged dark")
    ] = 5.0


@stage(version=2)
def solve(
    radiance: AngleStack, alignment: Alignment, gains: Gains, object_: ObjectMask, settings: Settings
) -> StokesImage:
    """Weighted least squares s = (AᵀWA)⁻¹ AᵀW I per pixel and channel over the object's crop.

    Rows of A are `mueller.analyzer`, W the inverse variances; the covariance is (AᵀWA)⁻¹. Three angles
    are solved exactly; with more, the mean residual is kept as a check.

    Raises CaptureError where the angles leave a Stokes parameter undetermined.

    References
    ----------
    Collett, Polarized Light, ch. 5; Tyo, Design of optimal polarimeters, Applied Optics 2002.
    """
    weights_of = mueller.analyzer(radiance.angle)  # (K, 3)
    condition = np.linalg.cond(weights_of)
    if condition > 50:
        angles = ", ".join(f"{np.degrees(a):g}°" for a in radiance.angle)
        raise CaptureError(
            f"polarizer angles {angles} do not determine the Stokes parameters (condition {condition:.0f}, "
            "at most 50); shoot angles spread over 180°, such as 0°, 45°, 90°"
        )
    value, variance, quality = _registered(radiance, alignment, gains, object_.crop)
    stokes = np.empty((3, *value.shape[1:]), np.float32)
    covariance = np.empty((6, *value.shape[1:]), np.float32)
    residual = np.empty(quality.shape, np.float32) if len(radiance.angle) > 3 else None
    for top in range(0, len(quality), _ROWS):  # blocks whose float64 fits the cache
        rows = slice(top, top + _ROWS)
        solved, doubt = _weighted_least_squares(weights_of, value[:, rows], variance[:, rows])
        stokes[:, rows], covariance[:, rows] = solved, doubt
        quality[rows] = _judged(solved, doubt, quality[rows], settings)
        if residual is not None:
            fitted = np.einsum("kj,jhwc->khwc", weights_of, solved)
            difference = np.abs(value[:, rows] - fitted).sum(-1).mean(0)
            residual[rows] = difference / np.maximum(solved[0].sum(-1), 1e-9)
    x0, y0, x1, y1 = object_.crop
    mask = object_.mask[y0:y1, x0:x1]
    view = radiance.view
    return StokesImage(
        stokes=stokes,
        covariance=covariance,
        quality=quality,
        mask=np.array(mask),
        view=View(
            focal=view.focal,
            center=(view.center[0] - x0, view.center[1] - y0),
            scale=view.scale,
            origin=(view.origin[0] + x0, view.origin[1] + y0),
            known=view.known,
        ),
        residual=residual,
    )


def _registered(
    radiance: AngleStack, alignment: Alignment, gains: Gains, crop: tuple[int, int, int, int]
) -> tuple[Floats, Floats, Bits]:
    """Every shot's radiance over gain on the crop of the reference grid: (K, h, w, 3) twice, (h, w)."""
    values, variances = [], []
    x0, y0, x1, y1 = crop
    quality: Bits = np.zeros((y1 - y0, x1 - x0), np.uint8)
    mosaic = radiance.offset_px is not None
    part = alignment.transform[:, :2, 2] % 1
    shares = np.prod(part**2 + (1 - part) ** 2, axis=1).mean()  # alike for all, lest the sharpest shot counts least
    for k, transform in enumerate(alignment.transform):
        values.append(warp(radiance.value[k], transform, crop, order=1 if mosaic else 3) / gains.gain[k])
        spread = np.maximum(warp(radiance.variance[k], transform, crop, order=1), 1e-14)
        if mosaic:  # the mean of two or four neighbours, as is usual: splines ring at the edges of so coarse a grid
            spread = spread * shares
        variances.append(spread / gains.gain[k] ** 2)
        for bit in (Quality.CLIPPED, Quality.GHOST):
            flagged = warp((radiance.quality[k] & bit).astype(np.float32), transform, crop, order=1) > 0.01 * bit
            quality |= np.where(flagged, np.uint8(bit), np.uint8(0))
        inside = covered(radiance.value.shape[1:3], transform, crop)
        quality |= np.where(inside, np.uint8(0), np.uint8(Quality.OUTSIDE))
    return np.stack(values), np.stack(variances), quality


def _weighted_least_squares(weights_of: Floats, value: Floats, variance: Floats) -> tuple[Floats, Floats]:
    """Stokes (3, H, W, C) and covariance (6, H, W, C) from value and variance (K, H, W, C), A (K, 3)."""
    w = 1.0 / variance.astype(np.float64)
    pairs = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    m00, m01, m02, m11, m12, m22 = (
        np.tensordot(weights_of[:, i] * weights_of[:, j], w, axes=1) for i, j in pairs
    )  # the symmetric AᵀWA of every pixel
    right = [np.tensordot(weights_of[:, i], w * value, axes=1) for i in range(3)]
    c00, c01, c02 = m11 * m22 - m12**2, m02 * m12 - m01 * m22, m01 * m12 - m02 * m11
    determinant = m00 * c00 + m01 * c01 + m02 * c02
    c11, c12, c22 = m00 * m22 - m02**2, m01 * m02 - m00 * m12, m00 * m11 - m01**2
    covariance = np.stack([c00, c01, c02, c11, c12, c22]) / determinant
    i00, i01, i02, i11, i12, i22 = covariance
    stokes = np.stack(
        [
            i00 * right[0] + i01 * right[1] + i02 * right[2],
            i01 * right[0] + i11 * right[1] + i12 * right[2],
            i02 * right[0] + i12 * right[1] + i22 * right[2],
        ]
    )
    return stokes, covariance


def _judged(stokes: Floats, covariance: Floats, quality: Bits, settings: Settings) -> Bits:
    """Quality bits with what the solution itself betrays."""
    s0, s1, s2 = stokes.sum(-1)
    sigma0 = np.sqrt(covariance[0].sum(-1))
    sigma = np.sqrt((covariance[3] + covariance[5]).sum(-1) / 2)
    length = np.hypot(s1, s2)
    limit = fresnel.greatest_diffuse_dolp(settings.greatest_ior)
    ill = (s0 <= 0) | (length - 3 * sigma > limit * s0)
    dark = s0 < settings.dark_sigma * sigma0
    bits = quality | np.where(ill, np.uint8(Quality.ILL_POSED), np.uint8(0))
    bits |= np.where(dark, np.uint8(Quality.DARK), np.uint8(0))
    return bits | np.where(_metal(stokes, covariance), np.uint8(Quality.METAL), np.uint8(0))


def _metal(stokes: Floats, covariance: Floats) -> Floats:
    """(H, W) bool: channels whose polarization vectors point apart by more than a body's can.

    In a dielectric every channel has the same azimuth and a highlight only shortens the vectors; in a
    conductor the complex index changes with wavelength. Red and blue are compared at 5σ.
    """
    s0 = np.maximum(stokes[0], 1e-9)
    ratio = stokes[1:] / s0  # (2, H, W, C)
    sigma2 = (covariance[3] + covariance[5]) / 2 / s0**2
    turned = ratio[0, ..., 0] * ratio[1, ..., 2] - ratio[1, ..., 0] * ratio[0, ..., 2]
    strength = np.hypot(*ratio)
    spread = np.sqrt(sigma2[..., 0] * strength[..., 2] ** 2 + sigma2[..., 2] * strength[..., 0] ** 2)
    enough = np.minimum(strength[..., 0], strength[..., 2]) > 0.05
    across = strength[..., 0] * strength[..., 2] * np.sin(np.radians(20.0))  # 10° between the AoLPs
    return np.asarray(enough & (np.abs(turned) - 5 * spread > across))
