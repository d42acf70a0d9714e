"""Resampling of images through a homography and a lens's distortion, with cubic splines.

A cubic spline reproduces ramps and parabolas exactly, so a shift of the image is reproduced exactly. OpenCV's cubic
kernel (a = −0.75) is not exact: it moves a ramp by up to 0.05 px, as much as registration may err in all. OpenCV's
linear interpolation is exact, and four linear look-ups make a cubic B-spline.

References
----------
Thévenaz, Blu, Unser, Interpolation revisited, IEEE TMI 2000. Sigg and Hadwiger, Fast third-order texture
filtering, GPU Gems 2, ch. 20 (B-splines from linear look-ups).
"""

from collections.abc import Callable
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Bits, Distortion, Floats
from polcap.optics import distortion
from polcap.optics.projection import coordinates

Bools = NDArray[np.bool_]
Box = tuple[int, int, int, int]

_POLE = np.sqrt(3.0) - 2.0  # of the filter from samples to the coefficients of a cubic spline
_REACH = 8  # px; weights beyond are below |pole|⁸ = 2.6e-5, 1/100 of the noise of a good shot
_CUT = _POLE ** np.abs(np.arange(-_REACH, _REACH + 1.0))
_PREFILTER = (_CUT / _CUT.sum()).astype(np.float32)  # sum 1: a uniform image does not change
_EDGE = 3  # px added around the image, for interpolation at its outermost pixels
_ROWS = 64  # resampled at a time


def warp(
    image: Floats | Bits,
    transform: Floats,
    box: Box | None = None,
    order: Literal[1, 3] = 3,
    lens: Distortion | None = None,
) -> Floats:
    """Resample an image over `box`, float32: output px go through `lens`, then `transform`, to image px.

    Parameters
    ----------
    image
        (H, W) or (H, W, C).
    transform
        (3, 3), output px (x, y, 1) → image px, homogeneous.
    box
        x0, y0, x1, y1 of the output in its own px (end exclusive); the image's own frame by default.
    order
        3: cubic splines, for values; 1: linear, for weights and masks. Outside the image its edge pixels repeat.
    lens
        Distortion of the output's grid; the output is then the picture of a pinhole camera.
    """
    x0, y0, x1, y1 = (int(v) for v in box or (0, 0, image.shape[1], image.shape[0]))
    if lens is not None:
        return _warp_through_lens(lens, image, transform, (x0, y0, x1, y1), order)
    if np.array_equal(transform, np.eye(3)) and x0 >= 0 and y0 >= 0 and x1 <= image.shape[1] and y1 <= image.shape[0]:
        return np.asarray(image[y0:y1, x0:x1], dtype=np.float32)
    h = np.asarray(transform, np.float64)
    left, top, right, bottom = _source(image.shape[:2], h, (x0, y0, x1, y1))
    part = np.ascontiguousarray(image[top:bottom, left:right], np.float32)
    local = _translation(-left, -top) @ h @ _translation(x0, y0)
    size = x1 - x0, y1 - y0
    if _is_translation(local):
        return _translate(part, local[:2, 2], size, _linear if order == 1 else _cubic)
    if order == 1:
        how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        flat = cv2.warpPerspective(part, local, size, flags=how, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(flat, np.float32).reshape(size[1], size[0], *image.shape[2:])
    planes = [part] if part.ndim == 2 else cv2.split(part)
    splines = [Spline(np.ascontiguousarray(plane)) for plane in planes]
    out = np.empty((len(planes), size[1], size[0]), np.float32)
    for y in range(0, size[1], _ROWS):
        rows = slice(y, min(y + _ROWS, size[1]))
        taps = Taps(
            *coordinates(local, np.arange(float(size[0])), np.arange(float(rows.start), rows.stop)[:, None]),
            part.shape[:2],
        )
        for spline, plane in zip(splines, out):
            plane[rows] = spline.at(taps)
    return out[0] if image.ndim == 2 else np.asarray(cv2.merge(list(out))).reshape(size[1], size[0], -1)


def _warp_through_lens(
    lens: Distortion, image: Floats | Bits, transform: Floats, box: Box, order: Literal[1, 3]
) -> Floats:
    """`warp` with a lens."""
    x0, y0, x1, y1 = box
    left, top, right, bottom = _source(image.shape[:2], transform, box, lens)
    part = np.asarray(image[top:bottom, left:right], np.float32)
    local = _translation(-left, -top) @ np.asarray(transform, np.float64)
    planes = [np.ascontiguousarray(plane) for plane in ([part] if part.ndim == 2 else cv2.split(part))]
    splines = [Spline(plane) for plane in planes] if order == 3 else []
    out = np.empty((len(planes), y1 - y0, x1 - x0), np.float32)
    across = np.arange(float(x0), x1)
    for y in range(0, y1 - y0, _ROWS):
        rows = slice(y, min(y + _ROWS, y1 - y0))
        down = np.arange(float(y0 + rows.start), y0 + rows.stop)[:, None]
        u, v = coordinates(local, *distortion.distort(lens, across, down))
        if order == 3:
            taps = Taps(u, v, part.shape[:2])
            for spline, plane in zip(splines, out):
                plane[rows] = spline.at(taps)
            continue
        places = u.astype(np.float32), v.astype(np.float32)
        for source, plane in zip(planes, out):
            plane[rows] = cv2.remap(source, *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return out[0] if image.ndim == 2 else np.asarray(cv2.merge(list(out))).reshape(y1 - y0, x1 - x0, -1)


def _is_translation(transform: Floats) -> bool:
    return np.array_equal(transform, _translation(*transform[:2, 2]))


def _translate(image: Floats, by: Floats, size: tuple[int, int], kernel: Callable[[float], Floats]) -> Floats:
    """An image (H, W[, C]) read at output px + by (2,), (size[1], size[0][, C]).

    All pixels have the same fraction, so interpolation is one separable filter.
    """
    whole = np.floor(by).astype(int)
    across, down = (kernel(float(share)) for share in by - whole)
    filtered = cv2.sepFilter2D(image, cv2.CV_32F, across, down, borderType=cv2.BORDER_REPLICATE).reshape(image.shape)
    (x, y), (width, height) = (int(start) for start in whole), size
    if x >= 0 and y >= 0 and x + width <= image.shape[1] and y + height <= image.shape[0]:
        return np.asarray(filtered[y : y + height, x : x + width])
    rows, columns = (
        np.clip(np.arange(start, start + length), 0, last)
        for start, length, last in ((y, height, image.shape[0] - 1), (x, width, image.shape[1] - 1))
    )
    return np.asarray(filtered[np.ix_(rows, columns)])


def _linear(f: float) -> Floats:
    """Filter (3,) of the samples that interpolates linearly at a fraction f of a pixel."""
    return np.array([0, 1 - f, f], np.float32)


def _cubic(f: float) -> Floats:
    """Filter of the samples that interpolates with a cubic spline at a fraction f of a pixel."""
    if f == 0:
        return np.ones(1, np.float32)
    taps = np.array([(1 - f) ** 3, 4 - 6 * f**2 + 3 * f**3, 1 + 3 * f + 3 * f**2 - 3 * f**3, f**3]) / 6
    return np.asarray(np.r_[0, np.convolve(_PREFILTER, taps)], np.float32)  # 0: makes the number of taps odd


class Taps:
    """Positions in an image, as the four look-ups and two weights of a cubic B-spline."""

    def __init__(self, x: Floats, y: Floats, shape: tuple[int, int]) -> None:
        """Positions x, y (h, w) px, clipped to an image of `shape` (H, W)."""
        self.x0, self.x1, self.right = _taps(x, shape[1] - 1)
        self.y0, self.y1, self.down = _taps(y, shape[0] - 1)


def _taps(at: Floats, last: int) -> tuple[Floats, Floats, Floats]:
    """The two look-ups along one axis, and the weight of the second, float32."""
    at = np.clip(at, 0, last)
    whole = np.floor(at)
    f = (at - whole).astype(np.float32)
    whole += _EDGE
    f2 = f * f
    f3 = f2 * f
    # of the four weights (1−f)³/6, (4−6f²+3f³)/6, …, f³/6, the first two form one look-up, the last two the other
    second = 1 + 3 * f + 3 * f2 - 2 * f3
    first = 6 - second
    return (
        (whole - 1 + (4 - 6 * f2 + 3 * f3) / first).astype(np.float32),
        (whole + 1 + f3 / second).astype(np.float32),
        second * np.float32(1 / 6),
    )


class Spline:
    """An image (H, W) as coefficients of cubic B-splines."""

    def __init__(self, image: Floats) -> None:
        around = cv2.copyMakeBorder(image, _EDGE, _EDGE, _EDGE, _EDGE, cv2.BORDER_REPLICATE)
        self._of = cv2.sepFilter2D(around, cv2.CV_32F, _PREFILTER, _PREFILTER, borderType=cv2.BORDER_REPLICATE)

    def at(self, taps: Taps) -> Floats:
        """Interpolated values (h, w)."""
        upper, lower = (_mix(self._read(taps.x0, y), self._read(taps.x1, y), taps.right) for y in (taps.y0, taps.y1))
        return _mix(upper, lower, taps.down)

    def _read(self, x: Floats, y: Floats) -> Floats:
        return np.asarray(cv2.remap(self._of, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def _mix(a: Floats, b: Floats, share: Floats) -> Floats:
    """a + share · (b − a), computed in b's memory."""
    b -= a
    b *= share
    b += a
    return b


def _translation(x: float, y: float) -> Floats:
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])


def _source(shape: tuple[int, ...], transform: Floats, box: Box, lens: Distortion | None = None) -> Box:
    """The box of an image of `shape` (H, W) whose pixels affect its warp over `box`."""
    x0, y0, x1, y1 = box
    x: Floats = np.array([x0, x1, x0, x1]) - 0.5
    y: Floats = np.array([y0, y0, y1, y1]) - 0.5
    if lens is not None:  # the sides become curves
        across, down = np.linspace(x0 - 0.5, x1 - 0.5, 65), np.linspace(y0 - 0.5, y1 - 0.5, 65)
        x = np.concatenate([across, across, np.full(65, across[0]), np.full(65, across[-1])])
        y = np.concatenate([np.full(65, down[0]), np.full(65, down[-1]), down, down])
        x, y = distortion.distort(lens, x, y)
    x, y = coordinates(transform, x, y)
    margin = _REACH + _EDGE + 2
    left, top = int(np.floor(x.min())) - margin, int(np.floor(y.min())) - margin
    right, bottom = int(np.ceil(x.max())) + margin, int(np.ceil(y.max())) + margin
    height, width = shape[:2]
    left, top = min(max(left, 0), width - 1), min(max(top, 0), height - 1)
    return left, top, max(min(right, width), left + 1), max(min(bottom, height), top + 1)


def covered(
    shape: tuple[int, int], transform: Floats, box: Box, margin: float = 1.0, lens: Distortion | None = None
) -> Bools:
    """Pixels (y1 − y0, x1 − x0) of a box for which `warp` reads inside the image, `margin` px or more from its edge.

    `shape` (H, W) is the image's; transform, box and lens as in `warp`.
    """
    x0, y0, x1, y1 = box
    if lens is not None:
        grid = np.arange(x0, x1, dtype=np.float64), np.arange(y0, y1, dtype=np.float64)[:, None]
        return _within(*coordinates(transform, *distortion.distort(lens, *grid)), shape, margin)
    x, y = np.array([x0, x1 - 1.0, x0, x1 - 1.0]), np.array([y0, y0, y1 - 1.0, y1 - 1.0])
    if _within(*coordinates(transform, x, y), shape, margin).all():  # then the homography maps all of the box inside
        return np.ones((y1 - y0, x1 - x0), bool)
    across, down = np.arange(x0, x1, dtype=np.float64), np.arange(y0, y1, dtype=np.float64)[:, None]
    if _is_translation(transform):
        return _within(across + transform[0, 2], down + transform[1, 2], shape, margin)
    return _within(*coordinates(transform, across, down), shape, margin)


def _within(u: Floats, v: Floats, shape: tuple[int, int], margin: float) -> Bools:
    across, down = (u >= margin) & (u <= shape[1] - 1 - margin), (v >= margin) & (v <= shape[0] - 1 - margin)
    return np.asarray(across & down)
