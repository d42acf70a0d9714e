"""Sensor noise as a straight line, variance = slope · signal + floor, read off the pictures themselves.

Signals are in units of the sensor's range (white − black = 1). Then 1/slope is the number of electrons
that fill the range, and √floor · (1/slope) the read noise in electrons.

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

TILE = 16  # px; about 68 independent second differences, so that one tile knows its variance to 17 %
FREEDOM = TILE * TILE / 3.78  # 3.78 = Σ ρ² over the autocorrelation of [1, −2, 1] ⊗ [1, −2, 1]
_SECOND = np.array([1, -2, 1]) / 6**0.5
_LEAST_TILES = 40
_TYPICAL_ELECTRONS, _TYPICAL_READ = 20000.0, 4.0  # at ISO 100; e⁻
_SANE_ELECTRONS = (100.0, 1e6)


@dataclass(frozen=True)
class Noise:
    """Variance of one pixel = slope · signal + floor, per channel."""

    slope: Floats  # (C,) 1/e⁻
    floor: Floats  # (C,)

    def variance(self, signal: Floats) -> Floats:
        """Of pixels whose expected signal (N, C), or any (…, C), is known; a negative one counts as 0."""
        return np.maximum(signal, 0) * self.slope + self.floor

    def of(self, channel: int, signal: Floats, into: Floats | None = None) -> Floats:
        """The same for one channel's picture (h, w), a new array unless one to write to is given."""
        out: Floats = np.maximum(signal, 0, out=into)
        out *= self.slope[channel]
        out += self.floor[channel]
        return out

    def of_radiance(self, ratio: Floats, gain: float = 1.0) -> "Noise":
        """The same of radiance: of signals divided by their frame's ratio (C,), their variance times a gain."""
        return Noise(self.slope * np.float32(gain) / ratio, self.floor * np.float32(gain) / ratio**2)

    def lit(self, level: Floats) -> "Noise":
        """The same sensor where light of a `level` per channel (C,) was subtracted: its noise stays."""
        return Noise(self.slope, self.floor + self.slope * np.maximum(level, 0))


def of_pixels(light: Floats, line: Noise, cfa: Bits | None) -> Floats:
    """Variance of pixels of known expected signal (C, h, w); cfa where they were interpolated from it, not binned."""
    expected = np.empty_like(light)
    for c, plane in enumerate(light):
        line.of(c, plane, expected[c])
    if cfa is None:
        return expected
    expected[1] *= 2  # binned green is the mean of two photosites
    gain = demosaic.variance_gain(cfa)
    for i, j in np.ndindex(2, 2):
        expected[:, i::2, j::2] = np.tensordot(gain[i, j], expected[:, i::2, j::2], axes=1)
    return expected


@dataclass(frozen=True)
class Samples:
    """Signal and noise variance of small tiles of one frame; unusable ones NaN."""

    signal: Floats  # (T, C)
    variance: Floats  # (T, C)
    flat: bool  # the scene's own detail is still in the variance: only the lowest count


def roughness(picture: Floats) -> Floats:
    """Second differences along both axes, (C, H, W) → (C, H−2, W−2); white noise keeps its variance.

    [1, −2, 1] ⊗ [1, −2, 1] / 6 is blind to a ramp.
    """
    return np.stack([np.asarray(cv2.sepFilter2D(plane, -1, _SECOND, _SECOND))[1:-1, 1:-1] for plane in picture])


def strips(height: int, width: int, most: float = 0.75e6) -> list[slice]:
    """Rows enough for the statistics: whole tile rows (plus the 2 that `roughness` eats), evenly spread."""
    rows = max((height - 2) // TILE, 0)
    wanted = max(1, min(rows, int(most / (TILE * max(width, 1)))))
    first = np.unique(np.linspace(0, rows - 1, wanted).astype(int)) if rows else np.zeros(0, int)
    return [slice(TILE * int(r), TILE * int(r) + TILE + 2) for r in first]


def alone(picture: Signals) -> Samples:
    """Tiles of a single frame."""
    signal, variance = [], []
    for rows in strips(*picture.usable.shape):
        part, whole = picture.rows(rows), usable_tiles(picture.usable[rows])
        detail = roughness(part)
        signal.append(tiles(part[:, 1:-1, 1:-1], whole))
        variance.append(tiles(detail * detail, whole))
    return _samples(signal, variance, True, picture.shape[0])


def paired(first: Signals, second: Signals, ratio: Floats) -> tuple[Samples, Samples]:
    """Tiles of two frames of the same scene in the same place, second = ratio · first but for noise; ratio (C, ).

    With h₁ = t + n₁ and h₂ = r t + n₂ the detail t drops out of ⟨h₁ (h₁ − h₂/r)⟩ = var n₁ and of
    ⟨h₂ (h₂ − r h₁)⟩ = var n₂, however rich it is and whatever the two gains are.
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
    """The line through the tiles of all frames of one ISO, channel by channel.

    Tiles are binned by signal, and each bin counts as its median (of `flat` samples: its 15 % quantile, corrected to
    the mean by the χ² law). Where too few tiles are usable, or the line is absurd, a typical sensor is assumed.
    `least_floor`: the variance of rounding to whole counts.
    """
    channels = samples[0].signal.shape[1]
    line = np.array([_line(samples, c, iso, least_floor) for c in range(channels)], np.float32)
    return Noise(line[:, 0], line[:, 1])


def misfit(first: Signals, second: Signals, ratio: Floats, lines: tuple[Noise, Noise], gain: float) -> Floats:
    """How two registered frames differ beyond noise: variance per squared gradient, (C,) px².

    Registration errors and aliasing show at edges. From the tiles that have edges; 0 where it is not significant.
    second = ratio (C,) · first, of noise `lines`; `gain`: of the second frame's noise variance by resampling.
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
    """k of seen = expected + k · edge by relative least squares, the worst 3 % of the tiles left out."""
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
    """The noise lines of a capture by ISO: calibrated, or learnt from the first shot of that ISO."""

    def __init__(self, calibrated: Iterable[NoiseLine] = ()) -> None:
        self._samples: dict[object, list[Samples]] = {}
        self._known: dict[object, Noise] = {
            one.iso: Noise(np.array(one.slope, np.float32), np.array(one.floor, np.float32)) for one in calibrated
        }
        self._settled: set[object] = set(self._known)

    def learn(self, iso: object, samples: Samples) -> None:
        """Add the tiles of a frame, unless the line of its ISO is settled."""
        if iso not in self._settled:
            self._samples.setdefault(iso, []).append(samples)
            self._known.pop(iso, None)

    def line(self, iso: object, least_floor: float) -> Noise:
        """Noise at an ISO; a key that is not a number is an unknown ISO."""
        if iso not in self._known:
            number = float(iso) if isinstance(iso, int | float) else None
            self._known[iso] = fit(self._samples[iso], number, least_floor)
        return self._known[iso]

    def knows(self, iso: object) -> bool:
        """Whether the line of an ISO is settled."""
        return iso in self._settled

    def settle(self) -> None:
        """Later shots use the lines known by now."""
        self._settled = set(self._known)
        self._samples.clear()


def _line(samples: list[Samples], channel: int, iso: float | None, least: float) -> tuple[float, float]:
    electrons = _TYPICAL_ELECTRONS * 100 / max(iso or 100.0, 1.0)
    typical = 1 / electrons, max(least, (_TYPICAL_READ / electrons) ** 2)
    parts: list[tuple[Floats, Floats, bool]] = []  # (B, n) each: B bins of n tiles
    for sample in samples:
        good = np.isfinite(sample.signal[:, channel])
        if good.sum() < _LEAST_TILES:
            continue
        signal, variance = sample.signal[good, channel], sample.variance[good, channel]
        for bins in _alike(signal, int(np.clip(len(signal) // 25, 2, 32))):
            parts.append((signal[bins], variance[bins], sample.flat))
    if not parts:
        return typical
    line = typical
    for _ in range(3):  # within a bin the signal varies: compare each tile with the line so far
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
        if not 1 / _SANE_ELECTRONS[1] < fit.slope < 1 / _SANE_ELECTRONS[0]:  # also of signals all alike: NaN
            return typical
        line = fit.slope, fit.floor
    return line


def _alike(signal: Floats, count: int) -> list[NDArray[np.int64]]:
    """Tiles (T,) in bins by their signal, as even as may be: two arrays (B, n), the second's bins a tile shorter."""
    order = np.argsort(signal)
    n, longer = divmod(len(order), count)
    cut = longer * (n + 1)
    return [order[:cut].reshape(longer, n + 1), order[cut:].reshape(count - longer, n)]


def _low_quantile(variance: Floats) -> Floats:
    """Mean variances (B,) of pure noise from the 15 % quantiles of tile variances (B, n) (Wilson and Hilferty's χ²)."""
    spread = 2 / (9 * FREEDOM)
    return np.asarray(np.quantile(variance, 0.15, axis=1) / (1 - spread - 1.0364 * spread**0.5) ** 3)


def usable_tiles(usable: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tiles (T,) of one of `strips` (h, W) that touch no pixel that is not usable."""
    bad = np.asarray(~usable.all(axis=0))  # (W,)
    before = np.concatenate([[0], np.cumsum(bad)])
    first = TILE * np.arange((usable.shape[1] - 2) // TILE)
    return np.asarray(before[first + TILE + 2] == before[first])


def tiles(values: Floats, whole: NDArray[np.bool_]) -> Floats:
    """Means over the tiles of one of `strips` (C, h, w), (T, C); NaN but where a tile is `whole` (T,)."""
    count = len(whole)
    mean = np.empty((count, len(values)))
    for c, plane in enumerate(values):
        mean[:, c] = cv2.resize(plane[:TILE, : count * TILE], (count, 1), interpolation=cv2.INTER_AREA)[0]
    mean[~whole] = np.nan
    return mean


def _samples(signal: list[Floats], variance: list[Floats], flat: bool, channels: int) -> Samples:
    empty = np.empty((0, channels))
    return Samples(np.concatenate([empty, *signal]), np.concatenate([empty, *variance]), flat)
