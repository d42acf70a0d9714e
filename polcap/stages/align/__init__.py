"""Stage 3: find where each polarizer shot sees what the reference shot sees.

Turning the polarizer changes brightness smoothly over the object, a nudge of the camera moves its
texture. So the shots are compared in the logarithm of radiance with everything coarser than a few
pixels taken out: what remains is texture, chart and outline, which polarization hardly touches, and
a robust loss drops the pixels where it does. The transform is refined by Gauss–Newton steps with the
mean of both images' gradients, coarse to fine.

References
----------
Benhimane & Malis, Homography-based 2D visual tracking and servoing, IJRR 2007 (second-order steps).
Huber & Ronchetti, Robust Statistics, 2009 (biweight and scale).
"""

from typing import Annotated, Literal

import cv2
import msgspec
import numpy as np
from msgspec import Meta

from polcap.errors import AlignmentError
from polcap.images import Alignment, AngleStack, ColorCalibration, Floats, Quality
from polcap.optics.robust import MAD_TO_SIGMA
from polcap.optics.warp import warp
from polcap.stages import stage

_ALIASING_PX2 = 0.05**2  # variance of an edge's place between two samplings of it
_FLOOR_PX = 0.02  # what aliasing leaves of an error on rendered captures, whatever the noise
_MOST_PIXELS = 1.5e6  # a larger image is averaged down first: it has detail to spare


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    model: Annotated[
        Literal["none", "translation", "similarity", "homography"],
        Meta(description="how a shot may have moved; none: trust a locked camera"),
    ] = "similarity"
    max_shift_px: Annotated[
        float, Meta(ge=0.5, le=500, description="greatest accepted movement of any shot [grid px]")
    ] = 40.0
    min_correlation: Annotated[
        float, Meta(ge=0, le=1, description="least correlation of detail after registration")
    ] = 0.5
    detail_px: Annotated[
        float,
        Meta(ge=1, le=50, description="structure coarser than this Gaussian sigma is ignored [grid px]"),
    ] = 4.0


@stage(version=2)
def register(radiance: AngleStack, color: ColorCalibration, settings: Settings) -> Alignment:
    """One transform per shot, reference grid px → shot grid px.

    Raises AlignmentError naming the shot that moved too far or shows another scene.
    """
    shots = len(radiance.angle)
    if radiance.offset_px is not None:
        return _as_known(radiance.offset_px)
    step = int(np.ceil(np.sqrt(radiance.value[0, ..., 0].size / _MOST_PIXELS)))
    detail = [_Detail.of(radiance, k, settings.detail_px, step) for k in range(shots)]
    transform = np.tile(np.eye(3), (shots, 1, 1))
    residual = np.zeros(shots)
    correlation = np.ones(shots)
    height, width = radiance.value.shape[1:3]
    corners = np.array([[0, 0, 1], [width - 1, 0, 1], [0, height - 1, 1], [width - 1, height - 1, 1]], float).T
    for k in range(1, shots):
        if settings.model == "none":
            continue
        start = np.eye(3)
        start[:2, 2] = _coarse_shift(detail[0], detail[k])
        transform[k], residual[k] = _refine(detail[0], detail[k], start, settings.model)
        correlation[k] = _correlation(detail[0], detail[k], transform[k])
        transform[k] = _to_full_grid(transform[k], step)
        residual[k] *= step
        moved = transform[k] @ corners
        shift = np.abs(moved[:2] / moved[2] - corners[:2]).max()
        name = f"shot {np.degrees(radiance.angle[k]):g}°"
        if not np.isfinite(shift) or correlation[k] < settings.min_correlation:
            raise AlignmentError(
                f"{name} shows another scene than the first shot: correlation {correlation[k]:.2f}, "
                f"less than align.min_correlation = {settings.min_correlation:g}; "
                "check its files, or reshoot with the camera and the object held still"
            )
        if shift > settings.max_shift_px:
            raise AlignmentError(
                f"{name} moved by {shift:.1f} px, more than align.max_shift_px = {settings.max_shift_px:g}; "
                "reshoot, or raise it"
            )
    return Alignment(transform=transform, residual_px=residual, correlation=correlation)


def _as_known(offset_px: Floats) -> Alignment:
    """Shots cut from one mosaic stand where its pixels stand."""
    transform = np.tile(np.eye(3), (len(offset_px), 1, 1))
    transform[:, :2, 2] = -offset_px
    return Alignment(transform, np.zeros(len(offset_px)), np.ones(len(offset_px)))


class _Detail(msgspec.Struct, frozen=True):
    """Fine structure of one shot's log radiance, its weight, and the blurred copies for coarse steps."""

    value: Floats  # (H, W)
    weight: Floats  # (H, W) 1/variance, 0 where clipped

    @staticmethod
    def of(radiance: AngleStack, k: int, detail_px: float, step: int) -> "_Detail":
        total = _averaged(radiance.value[k].sum(-1, dtype=np.float32), step)
        sigma = np.sqrt(_averaged(radiance.variance[k].sum(-1, dtype=np.float32), step)) / step
        # The floor keeps the logarithm of a dark background from amplifying its noise.
        floor = max(float(np.percentile(total, 99)) * 0.01, 2 * float(np.median(sigma)), 1e-9)
        log = np.log(np.maximum(total, 0) + floor).astype(np.float32)
        smooth = cv2.GaussianBlur(log, (0, 0), 0.7)  # both shots need one resolution; cubic warps change it
        value = smooth - cv2.GaussianBlur(log, (0, 0), detail_px)
        relative = sigma / (np.maximum(total, 0) + floor)
        weight = 1.0 / (relative**2 + 0.003**2)
        clipped = (_averaged((radiance.quality[k] & Quality.CLIPPED).astype(np.float32), step) > 0).astype(np.uint8)
        reach = int(np.ceil(2 * detail_px)) | 1
        weight[cv2.dilate(clipped, np.ones((reach, reach), np.uint8)) > 0] = 0
        return _Detail(value, weight)

    def shrunk(self, step: int) -> "_Detail":
        """The same of an image averaged down."""
        if step == 1:
            return self
        return _Detail(_averaged(self.value.astype(np.float32), step), _averaged(self.weight, step))


def _averaged(image: Floats, step: int) -> Floats:
    """Means of step × step blocks; an incomplete last block is dropped."""
    if step == 1:
        return image
    height, width = image.shape[0] // step, image.shape[1] // step
    blocks = image[: height * step, : width * step].reshape(height, step, width, step)
    return np.asarray(blocks.mean((1, 3), dtype=np.float32))


def _to_full_grid(transform: Floats, step: float) -> Floats:
    """A transform of a grid averaged by `step` on the grid it was averaged from (1/step: the other way)."""
    up = np.array([[step, 0, (step - 1) / 2], [0, step, (step - 1) / 2], [0, 0, 1.0]])
    return np.asarray(up @ transform @ np.linalg.inv(up))


def _coarse_shift(reference: _Detail, shot: _Detail) -> Floats:
    """Whole-image translation by phase correlation, (2,) px."""
    window = cv2.createHanningWindow(reference.value.shape[::-1], cv2.CV_32F)
    shift, _ = cv2.phaseCorrelate(
        reference.value * np.sqrt(reference.weight), shot.value * np.sqrt(shot.weight), window
    )
    return np.array(shift)


def _refine(reference: _Detail, shot: _Detail, start: Floats, model: str) -> tuple[Floats, float]:
    """Coarse-to-fine robust Gauss–Newton; the transform and its 1σ at the weighted pixels, px."""
    transform = start
    error = np.inf
    for shrink in (4, 2, 1):
        a, b = reference.shrunk(shrink), shot.shrunk(shrink)
        height, width = a.value.shape
        level = _to_full_grid(transform, 1 / shrink)
        coarse = "translation" if shrink == 4 and model != "translation" else model
        shared = 1 / (1 / np.maximum(a.weight, 1e-12) + 1 / np.maximum(warp(b.weight, level, order=1), 1e-12))
        for _ in range(15):
            step, error = _step(a.value, b.value, shared, level, coarse)
            level = level @ step
            level = level / level[2, 2]
            if np.abs(step - np.eye(3))[:2].dot([width / 2, height / 2, 1]).max() < 0.004:
                break
        transform = _to_full_grid(level, shrink)
    return transform, float(np.hypot(error, _FLOOR_PX))


def _step(a: Floats, b: Floats, weight: Floats, transform: Floats, model: str) -> tuple[Floats, float]:
    """One compositional update (3, 3) that brings b∘transform closer to a, and its 1σ, px."""
    warped = warp(b, transform)
    gx_a, gy_a = _gradient(a)
    gx_b, gy_b = _gradient(warped)
    gx, gy = (gx_a + gx_b) / 2, (gy_a + gy_b) / 2
    height, width = a.shape
    size = max(height, width) / 2
    x = ((np.arange(width) - width / 2) / size)[None, :]
    y = ((np.arange(height) - height / 2) / size)[:, None]
    margin = np.zeros_like(a, dtype=bool)
    margin[4:-4, 4:-4] = True
    information = weight * (gx * gx + gy * gy)  # what a pixel says of the movement; most say nothing
    use = margin & (weight > 1e-9) & (information > 0.05 * information.mean())
    columns = [gx, gy]
    if model in ("similarity", "homography"):
        columns += [gx * x + gy * y, gy * x - gx * y]
    if model == "homography":
        radial = gx * x + gy * y
        columns += [gx * x - gy * y, gx * y + gy * x, radial * x, radial * y]
    jacobian = np.stack([np.broadcast_to(c, a.shape)[use] for c in columns], axis=-1).astype(np.float64)
    difference = (a - warped)[use].astype(np.float64)
    # An edge sampled at two phases differs by a share of its own gradient: aliasing counts as noise,
    # else the robust loss keeps the edges that happen to agree and pulls the shift to whole pixels.
    slope = jacobian[:, 0] ** 2 + jacobian[:, 1] ** 2
    w = 1 / (_ALIASING_PX2 * slope + 1 / weight[use].astype(np.float64))
    normalized = np.abs(difference) * np.sqrt(w)
    scale = MAD_TO_SIGMA * _weighted_median(normalized, w * slope) + 1e-9
    w = w * np.maximum(0, 1 - (normalized / (4.685 * scale)) ** 2) ** 2
    normal = jacobian.T @ (jacobian * w[:, None]) + 1e-12 * np.eye(jacobian.shape[1])
    p = np.linalg.solve(normal, jacobian.T @ (w * difference))
    # Neighbouring residuals are correlated by the blur over about ten pixels.
    spread = np.linalg.inv(normal) @ (jacobian.T @ (jacobian * (w * difference)[:, None] ** 2)) @ np.linalg.inv(normal)
    error = float(np.sqrt(10 * np.trace(spread[:2, :2]) / 2))
    return _matrix(p, width, height, size), error


def _matrix(p: Floats, width: int, height: int, size: float) -> Floats:
    """The update's parameters (about the image centre, in units of `size`) as a px transform."""
    dx, dy, zoom, turn, *rest = [*p, 0.0, 0.0][: max(len(p), 4)]
    stretch, shear, tilt_x, tilt_y = [*rest, 0.0, 0.0, 0.0, 0.0][:4]
    local = np.array(
        [
            [1 + (zoom + stretch) / size, (shear - turn) / size, dx / size],
            [(turn + shear) / size, 1 + (zoom - stretch) / size, dy / size],
            [-tilt_x / size, -tilt_y / size, 1],
        ]
    )
    to_unit = np.array([[1 / size, 0, -width / 2 / size], [0, 1 / size, -height / 2 / size], [0, 0, 1]])
    return np.asarray(np.linalg.inv(to_unit) @ local @ to_unit)


def _gradient(image: Floats) -> tuple[Floats, Floats]:
    """Central differences, (H, W) each."""
    return np.gradient(image, axis=1), np.gradient(image, axis=0)


def _weighted_median(value: Floats, weight: Floats) -> float:
    order = np.argsort(value)
    total = np.cumsum(weight[order])
    return float(value[order][np.searchsorted(total, total[-1] / 2)])


def _correlation(reference: _Detail, shot: _Detail, transform: Floats) -> float:
    """Weighted zero-mean correlation of the detail of two shots once registered."""
    warped = warp(shot.value, transform)
    weight = reference.weight * warp(shot.weight, transform, order=1)
    product = (weight * reference.value * warped).sum()
    power = (weight * reference.value**2).sum() * (weight * warped**2).sum()
    return float(product / np.sqrt(power + 1e-30))
