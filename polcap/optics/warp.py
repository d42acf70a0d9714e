"""Resampling of images through a homography and a lens's distortion, with cubic splines.

A cubic spline reproduces ramps and parabolas exactly, so a shift of the image is reproduced exactly. OpenCV's cubic
kernel (a = −0.75) is not exact: it moves a ramp by up to 0.05 px, as much as registration may err in all. OpenCV's
linear interpolation is exact, and four linear look-ups make a cubic B-spline.

References
----------
Thévenaz, Blu, Unser, Interpolation revisited, IEEE TMI 2000. Sigg and Hadwiger, Fast third-order texture
filtering, GPU Gems 2, ch. 20 (B-splines from linear look-ups).
"""

from typing import Literal

import cv2
import numpy as np

from polcap.image_values import Bits, Bools, Distortion, Floats
from polcap.optics import distortion
from polcap.optics.projection import coordinates

Box = tuple[int, int, int, int]

_POLE = np.sqrt(3.0) - 2.0  # of the filter from samples to the coefficients of a cubic spline
_REACH = 8  # px; weights beyond are below |pole|⁸ = 2.6e-5, 1/100 of the noise of a good shot
_POWERS = _POLE ** np.abs(np.arange(-_REACH, _REACH + 1.0))
_PREFILTER = (_POWERS / _POWERS.sum()).astype(np.float32)  # sum 1: a uniform image does not change
_EDGE = 3  # px added around the image, for interpolation at its outermost pixels
_ROWS = 64  # resampled at a time


def warp(
    image: Floats | Bits,
    transform: Floats,
    box: Box | None = None,
    order: Literal[1, 3] = 3,
    lens: Distortion | None = None,
) -> Floats:
    """Resample an image through a homography and a lens's distortion; the result is float32 and covers `box`.

    A pixel of the output is mapped by `lens`, then by `transform`, to a position in the image.

    image is (H, W) or (H, W, C); transform (3, 3) maps output px (x, y, 1) to image px, homogeneous. The output is the
    `box` x0, y0, x1, y1 of its own px (end exclusive), by default the image's own frame. order 3 is for values: cubic
    splines; 1, linear, is for weights and masks. Outside the image its edge pixels repeat. With `lens`, the distortion
    of the output's grid, the output is the picture of a pinhole camera.
    """
    x0, y0, x1, y1 = (int(v) for v in box or (0, 0, image.shape[1], image.shape[0]))
    inside = x0 >= 0 and y0 >= 0 and x1 <= image.shape[1] and y1 <= image.shape[0]
    if lens is None and inside and np.array_equal(transform, np.eye(3)):
        return np.asarray(image[y0:y1, x0:x1], dtype=np.float32)
    left, top, right, bottom = source_box(image.shape[:2], transform, (x0, y0, x1, y1), lens)
    part = np.asarray(image[top:bottom, left:right], np.float32)
    planes = [np.ascontiguousarray(plane) for plane in ([part] if part.ndim == 2 else cv2.split(part))]
    splines = [Spline(plane) for plane in planes] if order == 3 else []
    out = np.empty((len(planes), y1 - y0, x1 - x0), np.float32)
    across = np.arange(float(x0), x1)
    for first in range(y0, y1, _ROWS):
        down = np.arange(float(first), min(first + _ROWS, y1))[:, None]
        u, v = _source(transform, lens, across, down)
        block = out[:, first - y0 : first - y0 + len(down)]
        if order == 3:
            taps = Taps(u - left, v - top, part.shape[:2])
            for spline, plane in zip(splines, block):
                plane[:] = spline.at(taps)
        else:
            places = (u - left).astype(np.float32), (v - top).astype(np.float32)
            for source, plane in zip(planes, block):
                plane[:] = cv2.remap(source, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return out[0] if image.ndim == 2 else np.asarray(cv2.merge(list(out))).reshape(y1 - y0, x1 - x0, -1)


class Taps:
    """Positions in an image, as the four look-ups and two weights of a cubic B-spline."""

    def __init__(self, x: Floats, y: Floats, shape: tuple[int, int]) -> None:
        """Positions x, y (h, w) px, clipped to an image of `shape` (H, W)."""
        self.x0, self.x1, self.right = _taps(x, shape[1] - 1)
        self.y0, self.y1, self.down = _taps(y, shape[0] - 1)


def _taps(at: Floats, last: int) -> tuple[Floats, Floats, Floats]:
    """The two look-ups of a cubic B-spline along one axis, and the weight of the second, float32."""
    at = np.clip(at, 0, last)
    before = np.floor(at)
    f = (at - before).astype(np.float32)
    before += _EDGE
    f2 = f * f
    f3 = f2 * f
    # of the four weights (1−f)³/6, (4−6f²+3f³)/6, …, f³/6, the first two form one look-up, the last two the other
    second = 1 + 3 * f + 3 * f2 - 2 * f3
    first = 6 - second
    return (
        (before - 1 + (4 - 6 * f2 + 3 * f3) / first).astype(np.float32),
        (before + 1 + f3 / second).astype(np.float32),
        second * np.float32(1 / 6),
    )


class Spline:
    """An image (H, W) as coefficients of cubic B-splines, for interpolation."""

    def __init__(self, image: Floats) -> None:
        around = cv2.copyMakeBorder(image, _EDGE, _EDGE, _EDGE, _EDGE, cv2.BORDER_REPLICATE)
        self._coeffs = cv2.sepFilter2D(around, cv2.CV_32F, _PREFILTER, _PREFILTER, borderType=cv2.BORDER_REPLICATE)

    def at(self, taps: Taps) -> Floats:
        """Interpolated values (h, w) of the image at the positions of `taps`."""
        upper, lower = (_mix(self._read(taps.x0, y), self._read(taps.x1, y), taps.right) for y in (taps.y0, taps.y1))
        return _mix(upper, lower, taps.down)

    def _read(self, x: Floats, y: Floats) -> Floats:
        return np.asarray(cv2.remap(self._coeffs, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def _mix(a: Floats, b: Floats, share: Floats) -> Floats:
    """Linear interpolation a + share · (b − a), computed in b's memory."""
    b -= a
    b *= share
    b += a
    return b


def _source(transform: Floats, lens: Distortion | None, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    """Positions in the image of pixels x, y of the output; shapes broadcast."""
    return coordinates(transform, *((x, y) if lens is None else distortion.distort(lens, x, y)))


def source_box(shape: tuple[int, ...], transform: Floats, box: Box, lens: Distortion | None) -> Box:
    """Box of an image of `shape` (H, W) that a warp over `box` reads."""
    x0, y0, x1, y1 = box
    # points along the sides, which a lens bends
    across, down = np.linspace(x0 - 0.5, x1 - 0.5, 65), np.linspace(y0 - 0.5, y1 - 0.5, 65)
    x = np.concatenate([across, across, np.full(65, across[0]), np.full(65, across[-1])])
    y = np.concatenate([np.full(65, down[0]), np.full(65, down[-1]), down, down])
    x, y = _source(transform, lens, x, y)
    margin = _REACH + _EDGE + 2
    left, top = int(np.floor(x.min())) - margin, int(np.floor(y.min())) - margin
    right, bottom = int(np.ceil(x.max())) + margin, int(np.ceil(y.max())) + margin
    height, width = shape[:2]
    left, top = min(max(left, 0), width - 1), min(max(top, 0), height - 1)
    return left, top, max(min(right, width), left + 1), max(min(bottom, height), top + 1)


def covered(
    shape: tuple[int, int], transform: Floats, box: Box, margin: float = 1.0, lens: Distortion | None = None
) -> Bools:
    """Mask (y1 − y0, x1 − x0) of output pixels for which `warp` reads inside the image, `margin` px from its edge.

    `shape` (H, W) is the image's; transform, box and lens as in `warp`.
    """
    x0, y0, x1, y1 = box
    x, y = np.arange(float(x0), x1), np.arange(float(y0), y1)[:, None]
    u, v = _source(transform, lens, x, y)
    across, down = (u >= margin) & (u <= shape[1] - 1 - margin), (v >= margin) & (v <= shape[0] - 1 - margin)
    return np.asarray(across & down)
