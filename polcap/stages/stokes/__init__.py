"""Stage 6: linear Stokes parameters of each pixel from K polarizer angles.

Gains, registration, the photosite offsets of a mosaic's colors and the lens's distortion are applied here and nowhere
else, so every pixel is resampled once. The result is the picture of a pinhole camera.
"""

from dataclasses import dataclass, replace
from typing import Annotated

import cv2
import msgspec
import numpy as np
from msgspec import Meta

from polcap.errors import CaptureError
from polcap.image_values import Bits, Bools, Distortion, Floats, MaskedImage, Quality
from polcap.optics import crossing, distortion, frames, fresnel, mueller
from polcap.optics.warp import Box, covered, warp
from polcap.stage_values import Alignment, AngleStack, ObjectMask, SelfCalibration, StokesImage
from polcap.stages import stage
from polcap.stages.stokes.reference_detail import reference_detail

_MOST_CONDITION = 50.0  # of angles in steps of 12°: S1 then has 26 times a shot's noise; 0, 45, 90° have 2.4
# A pixel is metal if red and blue have this DoLP and their AoLPs differ by this angle, at this many σ. Set by hand,
# above the effects of noise and registration on a dielectric; not measured on metals.
_METAL_DOLP, _METAL_DEG, _METAL_SIGMA = 0.05, 10.0, 5.0
_LEAST_ROWS, _BLOCK = 64, 200_000  # rows and pixels of a block: its planes fit the cache, with few rows resampled twice
_LEAST_VARIANCE = np.float32(1e-14)  # so that weights are finite
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # Stokes indices of a covariance's six rows


class StokesSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Settings of the stage `stokes`, the section `stokes` of a settings file."""

    greatest_ior: Annotated[
        float, Meta(ge=1.2, le=3, description="greatest refractive index; a DoLP beyond it is flagged")
    ] = 1.8
    undistort: Annotated[
        bool, Meta(description="correct the distortion of a calibrated lens while the shots are resampled")
    ] = True
    dark_sigma: Annotated[
        float, Meta(ge=0, le=100, description="S0 below this many standard deviations is flagged dark")
    ] = 5.0


@stage(version=8)
def solve(
    radiance: AngleStack,
    alignment: Alignment,
    calibration: SelfCalibration,
    object_: ObjectMask,
    settings: StokesSettings,
) -> StokesImage:
    """Stokes parameters of the object's crop by weighted least squares, s = (AᵀWA)⁻¹ AᵀW I per pixel and channel.

    The rows of A are `mueller.analyzer`, W holds the inverse variances of the intensities I. The covariance is
    (AᵀWA)⁻¹. Three angles are solved exactly; with more, the mean residual is stored as a check.

    Raises CaptureError: the angles do not determine all Stokes parameters.

    References
    ----------
    Collett, Polarized Light, ch. 5; Tyo, Design of optimal polarimeters, Applied Optics 2002.
    """
    analyzers = mueller.analyzer(calibration.angle)  # (K, 3)
    _check_condition(analyzers, calibration.angle - calibration.ring.correction)
    lens = radiance.equipment.distortion if settings.undistort else None
    height, width = radiance.value.shape[1:3]
    crop = object_.crop if lens is None else distortion.pinhole_box(lens, object_.crop, (width, height))
    x0, y0, x1, y1 = crop
    shots = _Shots(radiance, alignment.transform, calibration.gains.gain, lens)
    stokes, covariance, quality, residual = _solve_in_blocks(shots, analyzers, crop, settings)
    mask = object_.mask[y0:y1, x0:x1]
    if lens is not None:
        mask = warp(object_.mask.astype(np.uint8), np.eye(3), crop, order=1, lens=lens) > 0.5
    view = radiance.view
    return StokesImage(
        stokes=stokes,
        covariance=covariance,
        quality=quality,
        mask=np.array(mask),
        view=replace(
            view,
            center=(view.center[0] - x0, view.center[1] - y0),
            origin=(view.origin[0] + x0, view.origin[1] + y0),
        ),
        residual=residual,
        body=_diffuse_reflection(shots, alignment.crossed, calibration.crossed, stokes, quality, crop),
        detail=None if radiance.mosaic is None else reference_detail(radiance.mosaic, crop, lens),
    )


def _check_condition(analyzers: Floats, angle: Floats) -> None:
    """Raise CaptureError for angles (K,) rad that do not determine S0, S1 and S2."""
    condition = np.linalg.cond(analyzers)
    if condition > _MOST_CONDITION:
        angles = ", ".join(f"{np.degrees(a):.4g}°" for a in angle)
        raise CaptureError(
            f"polarizer angles {angles} do not determine the Stokes parameters (condition {condition:.0f}, "
            f"at most {_MOST_CONDITION:g}); shoot angles spread over 180°, such as 0°, 45°, 90°"
        )


@dataclass(frozen=True)
class _Shots:
    """All shots with their gains and the mapping from the reference shot to each."""

    radiance: AngleStack
    transform: Floats  # (K, 3, 3)
    gain: Floats  # (K, 3)
    lens: Distortion | None


def _solve_in_blocks(
    shots: _Shots, analyzers: Floats, crop: Box, settings: StokesSettings
) -> tuple[Floats, Floats, Bits, Floats | None]:
    """Solve the Stokes parameters (3, h, w, 3) of the crop, block by block to limit memory.

    `crop` is in merged px of the reference shot. Also returns covariance (6, h, w, 3), quality (h, w) and, for K > 3,
    residual (h, w).
    """
    x0, y0, x1, y1 = crop
    size, count = (y1 - y0, x1 - x0), len(analyzers)
    stokes, covariance = np.empty((3, *size, 3), np.float32), np.empty((6, *size, 3), np.float32)
    quality = np.empty(size, np.uint8)
    residual = np.empty(size, np.float32) if count > 3 else None
    solve_ = _exact if count == 3 else _weighted_least_squares
    block = max(_LEAST_ROWS, _BLOCK // max(size[1], 1))
    flags = [_flagged(quality_) for quality_ in shots.radiance.quality]
    for top in range(y0, y1, block):
        rows = slice(top - y0, min(top + block, y1) - y0)
        value, variance, flagged = _register(shots, flags, (x0, top, x1, rows.stop + y0))
        solved, solved_covariance = stokes[:, rows], covariance[:, rows]
        solve_(analyzers, value, variance, solved, solved_covariance)
        if residual is not None:
            fitted = np.einsum("kj,jhwc->khwc", analyzers, solved)
            difference = np.abs(value - fitted).sum(3).mean(0)
            residual[rows] = difference / np.maximum(solved[0].sum(2), 1e-9)
        if shots.radiance.equipment.extinction is not None:
            _correct_extinction(solved, solved_covariance, shots.radiance.equipment.extinction)
        quality[rows] = _with_solution_flags(solved, solved_covariance, flagged, settings)
    return stokes, covariance, quality, residual


def _diffuse_reflection(
    shots: _Shots, transform: Floats | None, factor: Floats | None, stokes: Floats, quality: Bits, crop: Box
) -> MaskedImage | None:
    """Diffuse reflection S0 (h, w, 3) by `optics/crossing`, from the registered crossed shot times its factor (3,)."""
    crossed = shots.radiance.crossed
    if crossed is None or transform is None or factor is None:
        return None
    picture, factor = crossed.picture, factor.astype(np.float32)
    clipped = (quality & np.uint8(Quality.CLIPPED)) > 0  # p is unknown there, and small: highlights face the camera
    p = np.where(clipped[..., None], 0, crossing.polarization_along(stokes[1], stokes[2], crossed.angle))
    value = crossing.diffuse_light(_resampled(shots, picture.value, transform, crop) * factor, p)
    variance = np.maximum(warp(picture.variance, transform, crop, 1, shots.lens), _LEAST_VARIANCE) * factor**2
    height, width = picture.quality.shape
    defects = _defects(_flagged(picture.quality), (height, width), transform, crop, shots.lens)
    return MaskedImage(value.astype(np.float32), variance, defects)


def _flagged(quality: Bits) -> list[tuple[Quality, Bits]]:
    """Quality bits that occur in a shot (H, W) and have to be resampled, each with its mask."""
    planes = [(bit, quality & np.uint8(bit)) for bit in (Quality.CLIPPED, Quality.GHOST)]
    return [(bit, plane) for bit, plane in planes if plane.any()]


def _defects(
    flags: list[tuple[Quality, Bits]], shape: tuple[int, int], transform: Floats, box: Box, lens: Distortion | None
) -> Bits:
    """Quality bits (h, w) of a resampled shot of `shape` (H, W): OUTSIDE, and the bits of its flagged pixels.

    A bit is set where flagged pixels contribute more than 1 %.
    """
    quality: Bits = np.where(covered(shape, transform, box, lens=lens), np.uint8(0), np.uint8(Quality.OUTSIDE))
    for bit, plane in flags:
        quality |= np.where(warp(plane, transform, box, 1, lens) > 0.01 * bit, np.uint8(bit), np.uint8(0))
    return quality


def _register(shots: _Shots, flags: list[list[tuple[Quality, Bits]]], box: Box) -> tuple[Floats, Floats, Bits]:
    """Resample all shots on a box of the reference shot, divided by their gains.

    Returns values and variances (K, h, w, 3), and the quality (h, w).
    """
    radiance, lens, size = shots.radiance, shots.lens, (box[3] - box[1], box[2] - box[0])
    values, variances = (np.empty((len(shots.transform), *size, 3), np.float32) for _ in range(2))
    quality: Bits = np.zeros(size, np.uint8)
    height, width = radiance.quality.shape[1:]
    mosaic, offset = radiance.offset_px is not None, shots.transform[:, :2, 2] % 1
    # share of the variance after linear interpolation; the mean of all shots, or the sharpest had the least weight
    variance_share = np.prod(offset**2 + (1 - offset) ** 2, axis=1).mean() if mosaic else 1.0
    for k, transform in enumerate(shots.transform):
        gain = np.tile(shots.gain[k].astype(np.float32), size[1])
        if mosaic:  # mean of 2 or 4 neighbors, as usual for a mosaic: splines ring at edges of so coarse a grid
            resampled = warp(radiance.value[k], transform, box, 1, lens)
        else:
            resampled = _resampled(shots, radiance.value[k], transform, box)
        variance = np.maximum(warp(radiance.variance[k], transform, box, 1, lens), _LEAST_VARIANCE)
        np.divide(_rows(resampled), gain, out=_rows(values[k]))
        np.multiply(_rows(variance), np.float32(variance_share) / gain**2, out=_rows(variances[k]))
        quality |= _defects(flags[k], (height, width), transform, box, lens)
    return values, variances, quality


def _rows(picture: Floats) -> Floats:
    """View a picture (h, w, 3) as (h, 3 w) in the same memory, because NumPy is faster over long rows."""
    return picture.reshape(len(picture), -1)


def _resampled(shots: _Shots, picture: Floats, transform: Floats, box: Box) -> Floats:
    """Resample a shot (H, W, 3) on a box (h, w, 3) of the reference shot, each channel from its own photosites."""
    site_px = shots.radiance.sensor.site_px
    if site_px is None or not site_px.any():
        return warp(picture, transform, box, lens=shots.lens)
    planes = [
        warp(picture[..., c], np.array([[1, 0, -x], [0, 1, -y], [0, 0, 1]]) @ transform, box, lens=shots.lens)
        for c, (x, y) in enumerate(site_px)
    ]
    return np.asarray(cv2.merge(planes))


def _exact(analyzers: Floats, value: Floats, variance: Floats, stokes: Floats, covariance: Floats) -> None:
    """Solve Stokes parameters from three angles exactly: s = A⁻¹ I, with covariance A⁻¹ diag(var) A⁻ᵀ."""
    inverse = np.linalg.inv(analyzers)  # (3, K)
    squares = np.stack([inverse[i] * inverse[j] for i, j in _PAIRS])  # (6, K)
    np.matmul(inverse.astype(np.float32), value.reshape(3, -1), out=stokes.reshape(3, -1))
    np.matmul(squares.astype(np.float32), variance.reshape(3, -1), out=covariance.reshape(6, -1))


def _weighted_least_squares(
    analyzers: Floats, value: Floats, variance: Floats, stokes: Floats, covariance: Floats
) -> None:
    """Solve Stokes parameters (3, h, w, C) and covariance (6, h, w, C) from shots and variances (K, h, w, C)."""
    w = 1.0 / variance.astype(np.float64).reshape(len(value), -1)
    products = np.stack([analyzers[:, i] * analyzers[:, j] for i, j in _PAIRS])
    m00, m01, m02, m11, m12, m22 = products @ w  # the symmetric AᵀWA of every pixel; below, c are its cofactors
    right = analyzers.T @ (w * value.reshape(len(value), -1))
    c00, c01, c02 = m11 * m22 - m12**2, m02 * m12 - m01 * m22, m01 * m12 - m02 * m11
    determinant = m00 * c00 + m01 * c01 + m02 * c02
    c11, c12, c22 = m00 * m22 - m02**2, m01 * m02 - m00 * m12, m00 * m11 - m01**2
    inverse = np.stack([c00, c01, c02, c11, c12, c22]) / determinant
    i00, i01, i02, i11, i12, i22 = inverse
    covariance[:] = inverse.reshape(covariance.shape)
    for plane, (a, b, c) in zip(stokes, ((i00, i01, i02), (i01, i11, i12), (i02, i12, i22))):
        plane[:] = (a * right[0] + b * right[1] + c * right[2]).reshape(plane.shape)


def _correct_extinction(stokes: Floats, covariance: Floats, extinction: Floats) -> None:
    """Correct a finite extinction ratio E (C,) of the polarizer: divide S1 and S2 by (E − 1)/(E + 1), in place."""
    leak = 1 / np.asarray(extinction, np.float64)  # 1/E, finite for an ideal polarizer too
    contrast = (1 - leak) / (1 + leak)
    factor = (1 / np.stack([np.ones_like(contrast), contrast, contrast])).astype(np.float32)  # (3, C)
    stokes *= factor[:, None, None]
    covariance *= np.stack([factor[i] * factor[j] for i, j in _PAIRS])[:, None, None]


def _with_solution_flags(stokes: Floats, covariance: Floats, quality: Bits, settings: StokesSettings) -> Bits:
    """Add quality bits (h, w) that follow from the Stokes parameters: ILL_POSED, DARK, METAL."""
    s0, s1, s2 = (frames.total(plane) for plane in stokes)
    sigma0 = np.sqrt(frames.total(covariance[0]))
    sigma = np.sqrt((frames.total(covariance[3]) + frames.total(covariance[5])) / 2)
    limit = np.float32(fresnel.greatest_diffuse_dolp(settings.greatest_ior))
    ill = (s0 <= 0) | (cv2.magnitude(s1, s2) - 3 * sigma > limit * s0)
    dark = s0 < np.float32(settings.dark_sigma) * sigma0
    for where, bit in ((ill, Quality.ILL_POSED), (dark, Quality.DARK), (_metal(stokes, covariance), Quality.METAL)):
        quality |= where.view(np.uint8) * np.uint8(bit)
    return quality


def _metal(stokes: Floats, covariance: Floats) -> Bools:
    """Detect metal: pixels (H, W) where the AoLPs of red and blue differ more than in a dielectric, at 5σ.

    In a dielectric all channels have the same AoLP, and a highlight only lowers the DoLP. In a metal the complex
    refractive index changes with wavelength, and the AoLP with it.
    """
    (x0, y0, square0, noise0), (x1, y1, square1, noise1) = (_polarization(stokes, covariance, c) for c in (0, 2))
    polarized = np.minimum(square0, square1) > np.float32(_METAL_DOLP**2)
    limit = np.float32(np.sin(2 * np.radians(_METAL_DEG))) * np.sqrt(square0) * np.sqrt(square1)
    excess = np.abs(x0 * y1 - y0 * x1) - limit
    noise = np.sqrt(noise0 * square1 + noise1 * square0)
    return np.asarray(polarized & (excess > np.float32(_METAL_SIGMA) * noise))


def _polarization(stokes: Floats, covariance: Floats, channel: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Polarization of one channel: S1/S0, S2/S0, the sum of their squares, and their variance, each (H, W)."""
    s0, s1, s2, v1, v2 = (
        np.asarray(cv2.extractChannel(plane, channel)) for plane in (*stokes, covariance[3], covariance[5])
    )
    s0 = np.maximum(s0, np.float32(1e-9))
    x, y = s1 / s0, s2 / s0
    return x, y, x * x + y * y, (v1 + v2) / (2 * s0 * s0)
