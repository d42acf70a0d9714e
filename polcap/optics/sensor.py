"""Conversion of sensor counts to linear signals, and detection of clipped pixels."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from polcap.image_values import Bools, Floats, SensorImage
from polcap.optics import demosaic
from polcap.optics.morphology import dilate


def signal(image: SensorImage, full: bool = False) -> Floats:
    """Convert sensor counts to a linear signal (H, W, C) float32, black = 0 and white = 1.

    A mosaic is binned by superpixels, or demosaiced if `full`. C = 1 for a monochrome sensor, whose file has three
    equal channels and no mosaic. Signals below black stay negative.
    """
    span = np.float32(image.white - float(image.black.mean()))
    if image.cfa is None:
        value = image.value[..., :1] if monochrome(image) else image.value
        return np.asarray((value - image.black.astype(np.float32)) / span, np.float32)
    black = np.broadcast_to(image.black, image.cfa.shape)  # of each phase
    if full:
        h, w = (2 * (n // 2) for n in image.value.shape)
        mosaic = image.value[:h, :w].astype(np.float32)
        for i, j in np.ndindex(2, 2):
            mosaic[i::2, j::2] -= np.float32(black[i, j])
        mosaic /= span
        return demosaic.interpolate(mosaic, image.cfa)
    return np.ascontiguousarray(np.moveaxis(binned_planes(image), 0, -1))


def with_black_error(image: SensorImage, error: Floats) -> SensorImage:
    """A frame whose black levels are raised by `error` (C,) of the sensor's range, one per channel or for all."""
    counts = error * (image.white - float(image.black.mean()))
    if image.cfa is not None:
        counts = np.broadcast_to(counts, 3)[image.cfa]
    return replace(image, black=image.black + counts)


def binned_planes(image: SensorImage, rows: slice = slice(None)) -> Floats:
    """Linear signal of a mosaic binned by superpixels, or of some rows of superpixels, (3, h, W) float32."""
    assert image.cfa is not None
    side = image.superpixel
    start, stop, _ = rows.indices(image.value.shape[0] // side)
    cfa = np.roll(image.cfa, -side * start % len(image.cfa), axis=0)  # the first row's phase
    black = np.broadcast_to(image.black, image.cfa.shape)
    binned = demosaic.superpixel(image.value[side * start : side * stop], cfa)
    for color, plane in enumerate(binned):
        plane -= np.float32(black[image.cfa == color].mean())
    binned /= np.float32(image.white - float(image.black.mean()))
    return binned


def monochrome(image: SensorImage) -> bool:
    """Whether all three channels are equal; False for uniform pictures, such as fully clipped ones."""
    v = image.value
    alike = image.cfa is None and np.array_equal(v[..., 0], v[..., 1]) and np.array_equal(v[..., 0], v[..., 2])
    return alike and bool(np.ptp(v[..., 0]) > 0)


def usable(image: SensorImage, clip: float) -> Bools:
    """Mask (H, W) of binned pixels of `signal` without a clipped photosite; `clip` is as in `clip_count`."""
    return below(image, clip_count(image, clip))


def below(image: SensorImage, level: float, full: bool = False) -> Bools:
    """Mask (H, W) of pixels of `signal` without a count of `level` or more in them or in their eight neighbors.

    Raw counts of whole superpixels are compared, so all colors of a pixel are treated alike. Such a count excludes its
    surroundings, so pixels near the limit are not selected by their noise.
    """
    value = image.value
    over = _at_least(value, level)
    if image.cfa is None:
        over = over[..., 0] | over[..., 1] | over[..., 2]  # ten times as fast as `any`
    elif image.superpixel == 3:
        h, w = value.shape[0] // 3, value.shape[1] // 3
        over = np.asarray(over[: 3 * h, : 3 * w].reshape(h, 3, w, 3).any((1, 3)))
    else:
        h, w = value.shape[0] // 2, value.shape[1] // 2
        over = over[: 2 * h : 2, : 2 * w] | over[1 : 2 * h : 2, : 2 * w]
        over = np.ascontiguousarray(over).view(np.uint16) != 0  # two neighbors at once
    over = dilate(over, 1)
    return ~(np.repeat(np.repeat(over, 2, axis=0), 2, axis=1) if full and image.cfa is not None else over)


def _at_least(value: Floats | NDArray[np.uint16], level: float) -> Bools:
    """Compare value ≥ level; integer counts are compared as integers."""
    if value.dtype == np.uint16:
        least = math.ceil(level)
        return np.zeros(value.shape, bool) if least > 65535 else np.asarray(value >= np.uint16(least))
    return np.asarray(value >= level)


def clipped_share(image: SensorImage, clip: float) -> float:
    """Share of an image's counts that are clipped; see `clip_count`."""
    return float(np.mean(_at_least(image.value, clip_count(image, clip))))


def clip_count(image: SensorImage, clip: float) -> float:
    """Count from which photosites are clipped: the share `clip` of the count at which they saturate."""
    return clip * saturation(image)


def saturation(image: SensorImage) -> float:
    """Count at which pixels saturate: white level, or the highest count (over .6 of it) if .1 % of pixels have it."""
    part = np.ascontiguousarray(image.value[::3, ::3])
    top = float(part.max())
    crowded = np.count_nonzero(part == top) > max(1e-3 * part.size, 20)
    return top if crowded and 0.6 * image.white < top < image.white else image.white


def is_radiance(image: SensorImage) -> bool:
    """Whether an image is floating-point radiance on a scale of its own, so that its white is no sensor's full well."""
    return image.value.dtype.kind == "f" and not image.lossy and image.white > 1


def rounding_variance(image: SensorImage) -> float:
    """Noise variance from rounding to integer counts, in units of `signal`; nearly 0 for floating-point images."""
    step = 1.0 if np.issubdtype(image.value.dtype, np.integer) else 1e-3  # count
    return float(step**2 / 12 / (image.white - float(image.black.mean())) ** 2)
