"""Photon transfer: a sensor's noise at each ISO, from pairs of flat frames and of dark frames.

Two frames of the same surface differ by noise alone: dust, lens and uneven pixels cancel. The variance of a channel is
a straight line over its signal. The slope is the inverse of the electrons at white, the floor is the read noise.

References
----------
Janesick, Photon Transfer, SPIE 2007, ch. 5; EMVA Standard 1288, release 4.0, ch. 6.
"""

from collections.abc import Iterator

import numpy as np

from polcap.calibrate.calibration_photographs import CLIP, Photograph, by_setting
from polcap.calibration_values import NoiseLine
from polcap.errors import CaptureError
from polcap.image_values import Bools, Floats, SensorImage
from polcap.optics import robust, sensor

_TILE = 16  # px; over a tile the lens's falloff is negligible
_LEAST_RANGE = 2.0  # brightest over darkest tile: a line needs two ends


def measure(flat: list[Photograph], dark: list[Photograph]) -> tuple[NoiseLine, ...]:
    """Measure the noise line (variance over signal) of every ISO that has a pair of flat frames.

    Raises CaptureError if no two flat frames have the same setting, or all have one brightness.
    """
    lines = []
    for iso in sorted({one.setting[0] for one in flat}):
        points = list(_points([one for one in flat if one.setting[0] == iso]))
        if not points:
            continue
        points += _points([one for one in dark if one.setting[0] == iso])
        lines.append(_line(iso, points, flat[0]))
    if flat and not lines:
        raise CaptureError(
            f"{flat[0].path.parent}: no two frames have the same ISO, time and aperture; take each twice"
        )
    return tuple(lines)


def _points(photographs: list[Photograph]) -> Iterator[tuple[Floats, Floats, Floats]]:
    """Signal and noise variance of the tiles (T, C) of every pair of equal frames, and photosites per pixel (C,)."""
    for group in by_setting(photographs).values():
        for first, second in zip(group[::2], group[1::2]):
            one, two = first.image(), second.image()
            a, b = sensor.signal(one), sensor.signal(two)
            if a.shape != b.shape:
                raise CaptureError(f"{second.path}: {b.shape[1]}×{b.shape[0]} px, {first.path.name} has another size")
            usable = sensor.usable(one, CLIP) & sensor.usable(two, CLIP)
            ratio = 1.0
            lit = a[usable].mean() > 0.01 if usable.any() else False
            if lit:  # the lamp flickers; frames under 1 % of white are dark and have nothing to compare
                ratio = float(b[usable].mean() / a[usable].mean())
            yield (*_tiles(a, b, usable, ratio), photosites(one, a.shape[-1]))


def _tiles(a: Floats, b: Floats, usable: Bools, ratio: float) -> tuple[Floats, Floats]:
    """Noise of two frames per tile: signal (b + r² a) / (1 + r²) and variance var(b − r a) / (1 + r²), (T, C) each."""
    rows, columns = a.shape[0] // _TILE, a.shape[1] // _TILE
    shape = rows, _TILE, columns, _TILE
    cut = slice(rows * _TILE), slice(columns * _TILE)
    usable_tiles = usable[cut].reshape(shape).all(axis=(1, 3)).ravel()
    weight = 1 / (1 + ratio**2)
    level = ((b + ratio**2 * a)[cut] * weight).reshape(*shape, -1).mean(axis=(1, 3), dtype=np.float64)
    difference = (b - ratio * a)[cut].astype(np.float64).reshape(*shape, -1)
    variance = difference.var(axis=(1, 3), ddof=1) * weight
    channels = a.shape[-1]
    return level.reshape(-1, channels)[usable_tiles], variance.reshape(-1, channels)[usable_tiles]


def photosites(image: SensorImage, channels: int) -> Floats:
    """Number of photosites of the mosaic that one pixel of each channel averages, (C,)."""
    if image.cfa is None:
        return np.ones(channels)
    count = np.bincount(image.cfa.ravel(), minlength=3)
    return np.asarray(count * image.superpixel**2 / image.cfa.size)


def _line(iso: float, points: list[tuple[Floats, Floats, Floats]], frame: Photograph) -> NoiseLine:
    """Noise line of an ISO from all pairs of its frames. Raises CaptureError: all are of one brightness."""
    level, variance = (np.concatenate([point[i] for point in points]) for i in (0, 1))
    if len(level) < 4 or level.max() < _LEAST_RANGE * max(float(level.min()), 1e-3):
        raise CaptureError(
            f"{frame.path.parent}: flat frames at ISO {iso:g} are all of one brightness or clipped; take pairs from "
            "a tenth to nine tenths of white, or dark ones too"
        )
    fits = [
        robust.fit_noise_line(level[:, c], variance[:, c], _TILE * _TILE - 1, least=0.2 * np.median(variance[:, c]))
        for c in range(level.shape[1])
    ]
    slope, floor = np.array([(fit.slope, fit.floor) for fit in fits]).T
    slope_sigma, floor_sigma = np.array([np.sqrt(np.diag(fit.covariance)) for fit in fits]).T
    return noise_line(iso, (slope, slope_sigma), (floor, floor_sigma), points[0][2], "flat frames")


def noise_line(
    iso: float, slope: tuple[Floats, Floats], floor: tuple[Floats, Floats], sites: Floats, source: str
) -> NoiseLine:
    """Make a noise line from slope and floor, (C,) each with 1σ, of pixels that average `sites` (C,) photosites.

    Its electron numbers are those of one photosite.
    """
    electrons = 1 / (slope[0] * sites)
    variance = np.maximum(floor[0], 0.0)
    read_noise = np.sqrt(variance * sites) * electrons
    return NoiseLine(
        iso=iso,
        slope=tuple(slope[0].tolist()),
        slope_sigma=tuple(slope[1].tolist()),
        floor=tuple(variance.tolist()),
        floor_sigma=tuple(floor[1].tolist()),
        electrons_at_white=tuple(electrons.tolist()),
        read_noise_electrons=tuple(read_noise.tolist()),
        read_noise_sigma=tuple((np.sqrt(variance + floor[1]) * np.sqrt(sites) * electrons - read_noise).tolist()),
        source=source,
    )
