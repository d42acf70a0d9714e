"""Sensor noise as a line, variance = slope · signal + floor, measured in the photographs themselves.

Signals are in units of the sensor's range (white − black = 1). Then 1/slope is the full well in electrons, and
√floor · (1/slope) the read noise in electrons.

References
----------
Janesick, Photon Transfer, SPIE 2007; Foi et al., Practical Poissonian-Gaussian noise modeling and
fitting for single-image raw-data, IEEE TIP 2008 (flat tiles, robust line).
"""

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Bits, Floats, NoiseLine
from polcap.optics import demosaic
from polcap.optics.robust import fit_noise_line
from polcap.stages.hdr.planes import Signals

TILE = 16  # px; about 68 independent second differences, which give a tile's variance to 17 %
FREEDOM = TILE * TILE / 3.78  # 3.78 = Σ ρ² over the autocorrelation of [1, −2, 1] ⊗ [1, −2, 1]
_SECOND = np.array([1, -2, 1]) / 6**0.5
_LEAST_TILES = 40
_TYPICAL_ELECTRONS, _TYPICAL_READ = 20000.0, 4.0  # at ISO 100; e⁻
_SANE_ELECTRONS = (100.0, 1e6)  # range of a plausible full well


@dataclass(frozen=True)
class Noise:
    """Variance of one pixel = slope · signal + floor, per channel."""

    slope: Floats  # (C,) 1/e⁻
    floor: Floats  # (C,)

    def variance(self, signal: Floats) -> Floats:
        """Variance (…, C) of pixels for their expected signals (…, C); negative signals count as 0."""
        return np.maximum(signal, 0) * self.slope + self.floor

    def of_channel(self, channel: int, signal: Floats, into: Floats | None = None) -> Floats:
        """Variance (h, w) of one channel for its expected signals (h, w), written to `into` or a new array."""
        out: Floats = np.maximum(signal, 0, out=into)
        out *= self.slope[channel]
        out += self.floor[channel]
        return out

    def of_radiance(self, ratio: Floats, gain: float = 1.0) -> "Noise":
        """The noise line of radiance: signals over their exposure ratio (C,), with `gain` on the variance."""
        return Noise(self.slope * np.float32(gain) / ratio, self.floor * np.float32(gain) / ratio**2)

    def with_ambient(self, level: Floats) -> "Noise":
        """The noise line after ambient light of `level` (C,) was subtracted: its noise remains."""
        return Noise(self.slope, self.floor + self.slope * np.maximum(level, 0))


def of_pixels(light: Floats, line: Noise, cfa: Bits | None) -> Floats:
    """Variance (C, h, w) for expected signals (C, h, w); `cfa` for pixels interpolated from it, None if binned."""
    expected = np.empty_like(light)
    for c, plane in enumerate(light):
        line.of_channel(c, plane, expected[c])
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
    flat: bool  # the variance includes detail of the scene: only the smallest variances count


def roughness(picture: Floats) -> Floats:
    """Second differences along both axes, (C, H, W) → (C, H−2, W−2); the variance of white noise is unchanged.

    The filter [1, −2, 1] ⊗ [1, −2, 1] / 6 does not respond to a ramp.
    """
    return np.stack([np.asarray(cv2.sepFilter2D(plane, -1, _SECOND, _SECOND))[1:-1, 1:-1] for plane in picture])


def strips(height: int, width: int, most: float = 0.75e6) -> list[slice]:
    """Evenly spaced strips of rows: whole rows of tiles, plus 2 px for `roughness`; at most about `most` px in all."""
    rows = max((height - 2) // TILE, 0)
    wanted = max(1, min(rows, int(most / (TILE * max(width, 1)))))
    first = np.unique(np.linspace(0, rows - 1, wanted).astype(int)) if rows else np.zeros(0, int)
    return [slice(TILE * int(r), TILE * int(r) + TILE + 2) for r in first]


def sample_frame(picture: Signals) -> Samples:
    """Signal and variance in tiles of a single frame."""
    signal, variance = [], []
    for rows in strips(*picture.usable.shape):
        part, whole = picture.rows(rows), usable_tiles(picture.usable[rows])
        detail = roughness(part)
        signal.append(tiles(part[:, 1:-1, 1:-1], whole))
        variance.append(tiles(detail * detail, whole))
    return _samples(signal, variance, True, picture.shape[0])


def sample_pair(first: Signals, second: Signals, ratio: Floats) -> tuple[Samples, Samples]:
    """Signal and variance in tiles of two registered frames, second = ratio (C,) · first except for noise.

    With h₁ = t + n₁ and h₂ = r t + n₂, the scene's detail t cancels in ⟨h₁ (h₁ − h₂/r)⟩ = var n₁ and
    ⟨h₂ (h₂ − r h₁)⟩ = var n₂.
    """
    columns: tuple[list[Floats], ...] = ([], [], [], [])
    r = np.asarray(ratio, np.float32)
    for rows in strips(*first.usable.shape):
        one, two, whole = first.rows(rows), second.rows(rows), usable_tiles(first.usable[rows] & second.usable[rows])
        h1, h2 = roughness(one), roughness(two)
        difference = h2 - r[:, None, None] * h1
        h1 *= difference
        h2 *= difference
        means = [tiles(values, whole) for values in (one[:, 1:-1, 1:-1], h1, two[:, 1:-1, 1:-1], h2)]
        means[1] /= -r
        for column, mean in zip(columns, means):
            column.append(mean)
    channels = first.shape[0]
    return (
        _samples(columns[0], columns[1], False, channels),
        _samples(columns[2], columns[3], False, channels),
    )


def fit(samples: list[Samples], iso: float | None, least_floor: float) -> Noise:
    """Fit the noise line of each channel to the tiles of all frames of one ISO.

    Tiles are binned by signal. Each bin is represented by the median of its variances; for `flat` samples by the 15 %
    quantile, converted to the mean by the χ² law. A typical sensor is assumed if there are too few usable tiles or the
    line is implausible. `least_floor` is the variance from rounding to whole counts.
    """
    channels = samples[0].signal.shape[1]
    line = np.array([_line(samples, c, iso, least_floor) for c in range(channels)], np.float32)
    return Noise(line[:, 0], line[:, 1])


def misfit(first: Signals, second: Signals, ratio: Floats, lines: tuple[Noise, Noise], gain: float) -> Floats:
    """Excess variance between two registered frames, per squared gradient, (C,) px²; 0 if not significant.

    It comes from registration errors and aliasing, and is measured in tiles with edges. second = ratio (C,) · first;
    `lines` are their noise lines, `gain` is the factor on the second frame's noise variance by resampling.
    """
    r = np.asarray(ratio, np.float32)
    columns: tuple[list[Floats], ...] = ([], [], [])
    for rows in strips(*first.usable.shape):
        a, whole = first.rows(rows), usable_tiles(first.usable[rows] & second.usable[rows])
        d = second.rows(rows)[:, 1:-1, 1:-1] * (1 / r)[:, None, None]
        d -= a[:, 1:-1, 1:-1]
        gx, gy = a[:, 1:-1, 2:] - a[:, 1:-1, :-2], a[:, 2:, 1:-1] - a[:, :-2, 1:-1]
        gx *= gx
        gy *= gy
        gx += gy
        level, offset = tiles(a[:, 1:-1, 1:-1], whole), tiles(d, whole)
        d *= d
        own = lines[0].variance(level)
        columns[0].append(own + lines[1].variance(level * r) / r**2 * gain)
        columns[1].append(tiles(d, whole) - offset**2)
        columns[2].append(tiles(gx, whole) / 4 - own)
    out = np.zeros(first.shape[0], np.float32)
    if columns[0]:
        expected, seen, edge = (np.concatenate(column) for column in columns)
        for c in range(len(out)):
            out[c] = _per_edge(expected[:, c], seen[:, c], edge[:, c])
    return out


def _per_edge(expected: Floats, seen: Floats, edge: Floats) -> float:
    """Fit k in seen = expected + k · edge by relative least squares, without the worst 3 % of the tiles."""
    good = np.isfinite(seen) & (edge > 0.5 * expected)
    if good.sum() < _LEAST_TILES:
        return 0.0
    expected, excess, edge = expected[good], seen[good] - expected[good], edge[good]
    k = sigma = 0.0
    for _ in range(8):
        model = expected + k * edge
        z = excess / model
        inner = z <= np.quantile(z, 0.97)
        x, y = (edge / model)[inner], z[inner]
        k = max(float(np.sum(x * y) / np.sum(x * x)), 0.0)
        sigma = float(np.sqrt(np.sum((x * (y - k * x)) ** 2)) / np.sum(x * x))
    return k if k > 3 * sigma else 0.0


class Lines:
    """The noise lines of a capture by ISO: calibrated, or measured in the first shot of that ISO."""

    def __init__(self, calibrated: Iterable[NoiseLine] = ()) -> None:
        self._samples: dict[object, list[Samples]] = {}
        self._known: dict[object, Noise] = {
            one.iso: Noise(np.array(one.slope, np.float32), np.array(one.floor, np.float32)) for one in calibrated
        }
        self._settled: set[object] = set(self._known)

    def learn(self, iso: object, samples: Samples) -> None:
        """Add the tiles of a frame, unless the line of its ISO is final."""
        if iso not in self._settled:
            self._samples.setdefault(iso, []).append(samples)
            self._known.pop(iso, None)

    def line(self, iso: object, least_floor: float) -> Noise:
        """Noise line at an ISO; a key that is not a number means an unknown ISO."""
        if iso not in self._known:
            number = float(iso) if isinstance(iso, int | float) else None
            self._known[iso] = fit(self._samples[iso], number, least_floor)
        return self._known[iso]

    def knows(self, iso: object) -> bool:
        """Whether the line of an ISO is final."""
        return iso in self._settled

    def settle(self) -> None:
        """Make the present lines final: later shots use them."""
        self._settled = set(self._known)
        self._samples.clear()


def _line(samples: list[Samples], channel: int, iso: float | None, least: float) -> tuple[float, float]:
    """Slope and floor of one channel's noise line."""
    electrons = _TYPICAL_ELECTRONS * 100 / max(iso or 100.0, 1.0)
    typical = 1 / electrons, max(least, (_TYPICAL_READ / electrons) ** 2)
    parts: list[tuple[Floats, Floats, bool]] = []  # (B, n) each: B bins of n tiles
    for sample in samples:
        good = np.isfinite(sample.signal[:, channel])
        if good.sum() < _LEAST_TILES:
            continue
        signal, variance = sample.signal[good, channel], sample.variance[good, channel]
        for bins in _bins(signal, int(np.clip(len(signal) // 25, 2, 32))):
            parts.append((signal[bins], variance[bins], sample.flat))
    if not parts:
        return typical
    line = typical
    for _ in range(3):  # the signal varies within a bin, so each tile is compared with the present line
        x, y, n = [], [], []
        for signal, variance, flat in parts:
            level = signal.mean(axis=1)
            relative = variance / (line[0] * np.maximum(signal, 0) + line[1])
            quotients = _low_quantile(relative) if flat else np.median(relative, axis=1)
            x.append(level)
            y.append(quotients * (line[0] * np.maximum(level, 0) + line[1]))
            n.append(np.full(len(signal), float(signal.shape[1])))
        freedom = FREEDOM * np.concatenate(n)
        signal, seen = np.concatenate(x), np.maximum(np.concatenate(y), least)
        fit = fit_noise_line(signal, seen, freedom, least=least, least_floor=least, outliers=True)
        if not 1 / _SANE_ELECTRONS[1] < fit.slope < 1 / _SANE_ELECTRONS[0]:  # NaN if all signals are equal
            return typical
        line = fit.slope, fit.floor
    return line


def _bins(signal: Floats, count: int) -> list[NDArray[np.int64]]:
    """Indices of tiles in `count` bins by signal (T,): two arrays (B, n), bins of the second one tile shorter."""
    order = np.argsort(signal)
    n, longer = divmod(len(order), count)
    cut = longer * (n + 1)
    return [order[:cut].reshape(longer, n + 1), order[cut:].reshape(count - longer, n)]


def _low_quantile(variance: Floats) -> Floats:
    """Mean noise variances (B,) from the 15 % quantiles of tile variances (B, n), by Wilson and Hilferty's χ² law."""
    spread = 2 / (9 * FREEDOM)
    return np.asarray(np.quantile(variance, 0.15, axis=1) / (1 - spread - 1.0364 * spread**0.5) ** 3)


def usable_tiles(usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether each tile (T,) of a strip (h, W) of `strips` has only usable pixels, also around it."""
    bad = np.asarray(~usable.all(axis=0))  # (W,)
    before = np.concatenate([[0], np.cumsum(bad)])
    first = TILE * np.arange((usable.shape[1] - 2) // TILE)
    return np.asarray(before[first + TILE + 2] == before[first])


def tiles(values: Floats, whole: NDArray[np.bool_]) -> Floats:
    """Means (T, C) over the tiles of a strip (C, h, w) of `strips`; NaN for tiles that are not `whole` (T,)."""
    count = len(whole)
    mean = np.empty((count, len(values)))
    for c, plane in enumerate(values):
        mean[:, c] = cv2.resize(plane[:TILE, : count * TILE], (count, 1), interpolation=cv2.INTER_AREA)[0]
    mean[~whole] = np.nan
    return mean


def _samples(signal: list[Floats], variance: list[Floats], flat: bool, channels: int) -> Samples:
    empty = np.empty((0, channels))
    return Samples(np.concatenate([empty, *signal]), np.concatenate([empty, *variance]), flat)
