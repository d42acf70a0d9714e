"""Sensor noise as a line, variance = slope · signal + floor, measured in the photographs themselves.

Signals are in units of the sensor's range (white − black = 1). Then 1/slope is the full well in electrons, and
√floor · (1/slope) the read noise in electrons.

References
----------
Janesick, Photon Transfer, SPIE 2007; Foi et al., Practical Poissonian-Gaussian noise modeling and
fitting for single-image raw-data, IEEE TIP 2008 (flat tiles, robust line).
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np

from polcap.calibration_values import NoiseLine
from polcap.image_values import Bits, Bools, Floats
from polcap.optics import demosaic
from polcap.optics.registration import squared_gradient
from polcap.optics.resize import area_mean
from polcap.optics.robust import fit_noise_line
from polcap.stages.hdr.planes import Signals

TILE = 16  # px; about 68 independent second differences, which give a tile's variance to 17 %
FREEDOM = TILE * TILE / 3.78  # 3.78 = Σ ρ² over the autocorrelation of [1, −2, 1] ⊗ [1, −2, 1]
_KERNEL = np.array([1, -2, 1]) / 6**0.5
_LEAST_TILES = 40
_TYPICAL_ELECTRONS, _TYPICAL_READ = 20000.0, 4.0  # at ISO 100; e⁻
_PLAUSIBLE_ELECTRONS = (100.0, 1e6)  # range of a full well, e⁻


@dataclass(frozen=True)
class Noise:
    """Noise line of one pixel per channel: variance = slope · signal + floor."""

    slope: Floats  # (C,) 1/e⁻
    floor: Floats  # (C,)

    def variance(self, signal: Floats) -> Floats:
        """Variance (…, C) of pixels for their expected signals (…, C); negative signals count as 0."""
        return np.maximum(signal, 0) * self.slope + self.floor

    def of_channel(self, channel: int, signal: Floats) -> Floats:
        """Variance (h, w) of one channel for its expected signals (h, w)."""
        variance: Floats = np.maximum(signal, 0)
        variance *= self.slope[channel]
        variance += self.floor[channel]
        return variance

    def of_radiance(self, ratio: Floats, gain: float = 1.0) -> "Noise":
        """The noise line of radiance: signals divided by their exposure ratio (C,), with `gain` times the variance."""
        return Noise(self.slope * np.float32(gain) / ratio, self.floor * np.float32(gain) / ratio**2)

    def with_ambient(self, level: Floats) -> "Noise":
        """The noise line after ambient light of `level` (C,) was subtracted: its noise remains."""
        return Noise(self.slope, self.floor + self.slope * np.maximum(level, 0))


def of_pixels(light: Floats, line: Noise, cfa: Bits | None) -> Floats:
    """Noise variance (C, h, w) for expected signals (C, h, w); `cfa` (2, 2) for demosaiced pixels, None for binned."""
    expected = np.stack([line.of_channel(c, plane) for c, plane in enumerate(light)])
    if cfa is None:
        return expected
    expected[1] *= 2  # binned green is the mean of two photosites
    gain = demosaic.variance_gain(cfa)
    for i, j in np.ndindex(2, 2):
        expected[:, i::2, j::2] = np.tensordot(gain[i, j], expected[:, i::2, j::2], axes=1)
    return expected


@dataclass(frozen=True)
class Samples:
    """Signal and variance of small tiles of one frame; NaN for unusable tiles."""

    signal: Floats  # (T, C)
    variance: Floats  # (T, C)
    with_detail: bool  # the variance includes detail of the scene, so only the smallest variances count


def second_differences(picture: Floats) -> Floats:
    """Second differences of a picture along both axes, to measure its noise: (C, H, W) → (C, H−2, W−2).

    The filter [1, −2, 1] ⊗ [1, −2, 1] / 6 is 0 on ramps, and does not change the variance of white noise.
    """
    return np.stack([np.asarray(cv2.sepFilter2D(plane, -1, _KERNEL, _KERNEL))[1:-1, 1:-1] for plane in picture])


def strips(height: int, width: int, most: float = 0.75e6) -> list[slice]:
    """Choose evenly spaced strips of rows in which noise is measured, at most about `most` px in all.

    A strip is as high as a tile plus the 2 px that `second_differences` needs.
    """
    rows = max((height - 2) // TILE, 0)
    wanted = max(1, min(rows, int(most / (TILE * max(width, 1)))))
    first = np.unique(np.linspace(0, rows - 1, wanted).astype(int)) if rows else np.zeros(0, int)
    return [slice(TILE * int(r), TILE * int(r) + TILE + 2) for r in first]


def tile_columns(
    frames: tuple[Signals, ...], maps: Callable[..., tuple[Floats, ...]], most: float = 0.75e6
) -> list[Floats]:
    """Compute maps from strips (C, h, w) of the frames by the function `maps`, and average each over tiles: (T, C).

    The maps are 1 px smaller on each side than the strips. Tiles that are not fully usable in all frames are NaN.
    """
    usable = np.logical_and.reduce([frame.usable for frame in frames])
    columns = []
    for rows in strips(usable.shape[0], usable.shape[1], most):
        usable_tiles = _usable_tiles(usable[rows])
        columns.append([_tiles(values, usable_tiles) for values in maps(*(frame.rows(rows) for frame in frames))])
    return [np.concatenate(column) for column in zip(*columns, strict=True)]


def sample_frame(picture: Signals) -> Samples:
    """Sample signal and noise variance in tiles of a single frame."""
    signal, variance = tile_columns((picture,), lambda part: (inner(part), second_differences(part) ** 2))
    return Samples(signal, variance, with_detail=True)


def sample_pair(first: Signals, second: Signals, ratio: Floats) -> tuple[Samples, Samples]:
    """Sample signal and noise variance in tiles of two registered frames, second = ratio (C,) · first + noise.

    With h₁ = t + n₁ and h₂ = r t + n₂, the scene's detail t cancels in ⟨h₁ (h₁ − h₂/r)⟩ = var n₁ and
    ⟨h₂ (h₂ − r h₁)⟩ = var n₂.
    """
    r = np.asarray(ratio, np.float32)

    def maps(one: Floats, two: Floats) -> tuple[Floats, ...]:
        h1, h2 = second_differences(one), second_differences(two)
        difference = h2 - r[:, None, None] * h1
        return inner(one), h1 * difference, inner(two), h2 * difference

    signal1, product1, signal2, product2 = tile_columns((first, second), maps)
    return Samples(signal1, product1 / -r, with_detail=False), Samples(signal2, product2, with_detail=False)


def inner(picture: Floats) -> Floats:
    """Crop a picture (C, h, w) by its outermost pixels."""
    return picture[:, 1:-1, 1:-1]


def squared_gradients(picture: Floats) -> Floats:
    """Squared gradient (C, h−2, w−2) of a picture (C, h, w) by central differences, per px²."""
    return inner(np.stack([squared_gradient(plane) for plane in picture]))


def fit(samples: list[Samples], iso: float | None, least_floor: float, radiance: bool = False) -> Noise:
    """Fit the noise line of each channel to the tiles of all frames of one ISO.

    Tiles are binned by signal. Each bin is represented by the median of its variances; for samples `with_detail` by the
    15 % quantile, converted to the mean by the χ² law. A typical sensor is assumed if there are too few usable tiles or
    the line is implausible. `least_floor` is the variance from rounding to whole counts. `radiance`: the signals are
    radiance on an arbitrary scale, so the brightest tile takes the place of the sensor's white.
    """
    white = np.ones(samples[0].signal.shape[1])
    if radiance:
        brightest = np.nanmax(np.concatenate([one.signal for one in samples]), axis=0, initial=0.0)
        white = np.where(brightest > 0, brightest, 1.0)
    line = np.array([_line(samples, c, iso, least_floor, float(one)) for c, one in enumerate(white)], np.float32)
    return Noise(line[:, 0], line[:, 1])


def misfit(first: Signals, second: Signals, ratio: Floats, lines: tuple[Noise, Noise], gain: float) -> Floats:
    """Excess variance between two registered frames, per squared gradient, (C,) px²; 0 if not significant.

    It comes from registration errors and aliasing, and is measured in tiles with edges. second = ratio (C,) · first;
    `lines` are their noise lines, `gain` is the factor on the second frame's noise variance by resampling.
    """
    r = np.asarray(ratio, np.float32)

    def maps(a: Floats, b: Floats) -> tuple[Floats, ...]:
        difference = inner(b) * (1 / r)[:, None, None] - inner(a)
        return inner(a), difference, difference**2, squared_gradients(a)

    level, offset, square, edge = tile_columns((first, second), maps)
    own = lines[0].variance(level)
    expected = own + lines[1].variance(level * r) / r**2 * gain
    columns = zip(expected.T, (square - offset**2).T, (edge - own).T)
    return np.array([_fit_misfit(*column) for column in columns], np.float32)


def _fit_misfit(expected: Floats, seen: Floats, edge: Floats) -> float:
    """Fit k ≥ 0 in seen = expected + k · edge (tile variances), without the worst 3 %; 0 for few tiles or below 3σ."""
    good = np.isfinite(seen) & (edge > 0.5 * expected)
    if good.sum() < _LEAST_TILES:
        return 0.0
    expected, excess, edge = expected[good], seen[good] - expected[good], edge[good]
    k = sigma = 0.0
    for _ in range(8):
        model = expected + k * edge
        z = excess / model
        used = z <= np.quantile(z, 0.97)
        x, y = (edge / model)[used], z[used]  # y = k x
        k = max(float(np.sum(x * y) / np.sum(x * x)), 0.0)
        sigma = float(np.sqrt(np.sum((x * (y - k * x)) ** 2)) / np.sum(x * x))
    return k if k > 3 * sigma else 0.0


class Lines:
    """Noise lines of a capture by ISO: from calibration, or measured in the first shot of that ISO."""

    def __init__(self, calibrated: Iterable[NoiseLine] = ()) -> None:
        self._samples: dict[object, list[Samples]] = {}
        self._known: dict[object, Noise] = {
            one.iso: Noise(np.array(one.slope, np.float32), np.array(one.floor, np.float32)) for one in calibrated
        }
        self._settled: set[object] = set(self._known)

    def learn(self, iso: object, samples: Samples) -> None:
        """Add the noise samples of a frame, unless the noise line of its ISO is final."""
        if iso not in self._settled:
            self._samples.setdefault(iso, []).append(samples)
            self._known.pop(iso, None)

    def line(self, iso: object, least_floor: float, radiance: bool = False) -> Noise:
        """Noise line at an ISO; a key that is no number is an unknown ISO. The other arguments are those of `fit`."""
        if iso not in self._known:
            number = float(iso) if isinstance(iso, int | float) else None
            self._known[iso] = fit(self._samples[iso], number, least_floor, radiance)
        return self._known[iso]

    def knows(self, iso: object) -> bool:
        """Whether the noise line of an ISO is final."""
        return iso in self._settled

    def settle(self) -> None:
        """Make the noise lines so far final, for all later shots, and drop their samples."""
        self._settled = set(self._known)
        self._samples.clear()


def _line(samples: list[Samples], channel: int, iso: float | None, least: float, white: float) -> tuple[float, float]:
    """Fit slope and floor of one channel's noise line to samples of all frames of one ISO."""
    electrons = _TYPICAL_ELECTRONS * 100 / max(iso or 100.0, 1.0) / white
    typical = 1 / electrons, max(least, (_TYPICAL_READ / electrons) ** 2)
    bins: list[tuple[Floats, Floats, bool]] = []  # signal and variance (n,) of tiles of like signal
    for sample in samples:
        good = np.isfinite(sample.signal[:, channel])
        if good.sum() < _LEAST_TILES:
            continue
        signal, variance = sample.signal[good, channel], sample.variance[good, channel]
        order = np.argsort(signal.round(6), kind="stable")  # rounded: equal on every processor
        for chosen in np.array_split(order, np.clip(len(order) // 25, 2, 32)):
            bins.append((signal[chosen], variance[chosen], sample.with_detail))
    if not bins:
        return typical
    level, number = np.array([(signal.mean(), len(signal)) for signal, _, _ in bins]).T
    slope, floor = typical
    for _ in range(3):  # the signal varies within a bin, so each tile is compared with the present line
        relative = np.array([_mean_of_bin(v / (slope * np.maximum(s, 0) + floor), detail) for s, v, detail in bins])
        seen = np.maximum(relative * (slope * np.maximum(level, 0) + floor), least)
        found = fit_noise_line(level, seen, FREEDOM * number, least=least, least_floor=least, outliers=True)
        if not white / _PLAUSIBLE_ELECTRONS[1] < found.slope < white / _PLAUSIBLE_ELECTRONS[0]:  # or NaN
            return typical
        slope, floor = found.slope, found.floor
    return slope, floor


def _mean_of_bin(relative: Floats, with_detail: bool) -> float:
    """Mean of a bin's tile variances (n,), over the line's: median, or by the 15 % quantile for tiles `with_detail`."""
    if not with_detail:
        return float(np.median(relative))
    spread = 2 / (9 * FREEDOM)  # χ² law by Wilson and Hilferty; 1.0364σ below the mean is the 15 % quantile
    return float(np.quantile(relative, 0.15) / (1 - spread - 1.0364 * spread**0.5) ** 3)


def _usable_tiles(usable: Bools) -> Bools:
    """Mask (T,) of a strip's tiles that have only usable pixels, also around them. `usable` (h, W) is the strip."""
    bad = np.asarray(~usable.all(axis=0))  # (W,)
    before = np.concatenate([[0], np.cumsum(bad)])
    first = TILE * np.arange((usable.shape[1] - 2) // TILE)
    return np.asarray(before[first + TILE + 2] == before[first])


def _tiles(values: Floats, usable_tiles: Bools) -> Floats:
    """Means (T, C) over the tiles of a strip (C, h, w) of `strips`; NaN for tiles not among the `usable_tiles` (T,)."""
    count = len(usable_tiles)
    mean = np.stack([area_mean(plane[:TILE, : count * TILE], (1, count))[0] for plane in values], axis=-1)
    return np.where(usable_tiles[:, None], mean.astype(np.float64), np.nan)
