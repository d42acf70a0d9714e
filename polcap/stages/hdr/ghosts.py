"""What the exposures of one scene agree on: a first radiance, and the pixels where they do not agree.

Frames come one by one, registered, in units of the sensor's range, with their exposure ratio to the
reference frame. Radiance is on the reference frame's scale. All work goes in blocks of rows.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from polcap.images import Floats
from polcap.stages.hdr.noise import Noise

Bools = NDArray[np.bool_]

_ROWS = 128
_WINDOW = 5  # px, side of the window of the comparison and of the smoothing
_SIGMA = 6.0  # of noise
_MISFIT = 3.0  # of the registration's own error at edges
_SHARE = 0.02  # of the radiance: flare and shading may differ by this much between exposures


class Anchor:
    """The exposure that rules each pixel: the reference frame, or the darkest where that one clips."""

    def __init__(self, reference: Floats, usable: Bools, noise: Noise) -> None:
        self.value = reference  # (H, W, C)
        self.known = usable  # (H, W)
        self._own, self._noise = usable, noise
        self._dark: tuple[Noise, Floats] | None = None

    def fill(self, value: Floats, usable: Bools, ratio: Floats, noise: Noise) -> None:
        """Take the darkest frame for the pixels that the reference frame cannot give."""
        self.value = np.where(self._own[..., None], self.value, value / ratio)
        self.known = self._own | usable
        self._dark = noise, ratio

    def variance(self, level: Floats, rows: slice) -> Floats:
        """Noise of one pixel of the given rows, for their expected radiance (h, w, C)."""
        own = self._noise.variance(level)
        if self._dark is None:
            return own
        noise, ratio = self._dark
        return np.where(self._own[rows][..., None], own, noise.variance(level * ratio) / ratio**2)

    def ghosts(self, value: Floats, usable: Bools, ratio: Floats, noise: Noise, misfit: Floats, gain: float) -> Bools:
        """Pixels (H, W) where a frame differs over a whole window by more than noise, misfit and flare.

        misfit: (C,) variance per squared gradient; gain: what resampling made of the frame's noise.
        Single deviant windows are dropped, the rest is grown by a window.
        """
        found = np.zeros(usable.shape, bool)
        for rows, inner, target in blocks(len(value), _WINDOW // 2 + 1):
            a = self.value[rows]
            level = box(a)
            own = self.variance(level, rows)
            other = noise.variance(level * ratio) / ratio**2
            limit = _SIGMA * np.sqrt((own + gain * other) * (1.5 / _WINDOW**2))  # neighbours share some noise
            limit += _SHARE * np.abs(level)
            if misfit.any():
                limit += _MISFIT * np.sqrt(np.maximum(box(edges(a)) - own, 0) * misfit)
            off = (np.abs(box(value[rows] / ratio) - level) > limit).any(axis=2)
            seen = _all_around(self.known[rows] & usable[rows], _WINDOW // 2)
            found[target] = (off & seen)[inner]
        core = _all_around(found, 1)
        return _any_around(core, _WINDOW // 2 + 2)


class FirstEstimate:
    """X₀ = Σ Y/a / Σ e/a over usable pixels, smoothed where it is flat."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self._number, self._exposure, self._floor = (np.zeros(shape, np.float32) for _ in range(3))  # electrons

    def add(self, value: Floats, usable: Bools, ratio: Floats, noise: Noise) -> None:
        for rows in (target for _, _, target in blocks(len(value), 0)):
            ok = usable[rows][..., None]
            electrons = ok / noise.slope
            self._number[rows] += value[rows] * electrons
            self._exposure[rows] += ratio * electrons
            self._floor[rows] += noise.floor * electrons**2

    def smoothed(self, otherwise: Floats, ghost: Bools) -> Floats:
        """The local mean, and of each pixel's distance to it what noise does not explain.

        A local Wiener filter (Lee, IEEE PAMI 1980), deaf to distances under 1.5 times the noise.
        `otherwise` stands in where no frame served, and at ghosts.
        """
        out = np.empty_like(self._number)
        for rows, inner, target in blocks(len(out), _WINDOW // 2):
            exposure = self._exposure[rows]
            served = (exposure > 0) & ~ghost[rows][..., None]
            x = np.where(served, self._number[rows] / np.maximum(exposure, 1e-20), otherwise[rows])
            mean = box(x)
            spread = box((x - mean) ** 2)
            e = np.where(served, exposure, np.float32(1e15))
            noise = np.maximum(mean, 0) / e + self._floor[rows] / (e * e)
            keep = np.clip(1 - 1.5 * noise / np.maximum(spread, 1e-20), 0, 1)
            out[target] = (mean + keep * (x - mean))[inner]
        return out


def blocks(height: int, halo: int) -> Iterator[tuple[slice, slice, slice]]:
    """Rows to read (with a halo, cut at the border), the wanted part of what was read, and where it goes."""
    for top in range(0, height, _ROWS):
        bottom = min(top + _ROWS, height)
        start = max(top - halo, 0)
        yield (
            slice(start, min(bottom + halo, height)),
            slice(top - start, bottom - start),
            slice(top, bottom),
        )


def box(picture: Floats) -> Floats:
    """Mean over the window around each pixel of (H, W, C); the border repeats."""
    half = _WINDOW // 2
    p = np.pad(picture, ((half, half), (half, half), (0, 0)), mode="edge")
    h, w = picture.shape[:2]
    rows = p[:h].copy()
    for k in range(1, _WINDOW):
        rows += p[k : k + h]
    out = rows[:, :w].copy()
    for k in range(1, _WINDOW):
        out += rows[:, k : k + w]
    out *= np.float32(1 / _WINDOW**2)
    return out


def edges(picture: Floats) -> Floats:
    """Squared gradient of (H, W, C), per px²."""
    p = np.pad(picture, ((1, 1), (1, 1), (0, 0)), mode="edge")
    gx, gy = p[1:-1, 2:] - p[1:-1, :-2], p[2:, 1:-1] - p[:-2, 1:-1]
    return (gx * gx + gy * gy) / 4


def _any_around(mask: Bools, reach: int) -> Bools:
    """Grown by `reach` px in all eight directions."""
    p = np.pad(mask, reach)
    h, w = mask.shape
    rows = np.logical_or.reduce([p[k : k + h] for k in range(2 * reach + 1)])
    return np.asarray(np.logical_or.reduce([rows[:, k : k + w] for k in range(2 * reach + 1)]))


def _all_around(mask: Bools, reach: int) -> Bools:
    return ~_any_around(~mask, reach)
