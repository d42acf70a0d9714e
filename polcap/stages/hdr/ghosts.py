"""What the exposures of one scene agree on: a first radiance, and the pixels where they do not agree.

Frames come registered, in units of the sensor's range, with their exposure ratio to the reference frame.
Radiance is on the reference frame's scale. All work goes in blocks of rows, channel by channel.
"""

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap import parallel
from polcap.images import Floats
from polcap.optics.registration import squared_gradient
from polcap.stages.hdr.noise import Noise
from polcap.stages.hdr.planes import Signals, blocks

Bools = NDArray[np.bool_]

_WINDOW = 5  # px, side of the window of the comparison and of the smoothing
_EVEN = np.full(_WINDOW, 1 / _WINDOW, np.float32)
_SIGMA = 6.0  # of noise
_MISFIT = 3.0  # of the registration's own error at edges
_SHARE = 0.02  # of the radiance: flare and shading may differ by this much between exposures
_NEIGHBOURS = 1.5  # variance of a window's mean over that of independent pixels: neighbours share some noise


@dataclass(frozen=True)
class Exposed:
    """One registered frame with what was measured of it."""

    signals: Signals
    ratio: Floats  # (C,) float32, exposure relative to the reference frame
    noise: Noise


class Anchor:
    """The exposure that rules each pixel: the reference frame, or the darkest where that one clips."""

    def __init__(self, reference: Exposed) -> None:
        self.known = reference.signals.usable  # (H, W)
        self._reference = reference
        self._dark: Exposed | None = None

    def fill(self, darkest: Exposed) -> None:
        """Take the darkest frame for the pixels that the reference frame cannot give."""
        self.known = self._reference.signals.usable | darkest.signals.usable
        self._dark = darkest

    def rows(self, rows: slice) -> Floats:
        """Radiance, (C, h, W)."""
        value = self._reference.signals.rows(rows)
        if self._dark is None:
            return value
        own, dark = self._reference.signals.usable[rows], self._dark
        if own.all():
            return value
        other = dark.signals.rows(rows)
        return np.stack([np.where(own, a, b / r) for a, b, r in zip(value, other, dark.ratio)])

    def variance(self, level: Floats, channel: int, rows: slice) -> Floats:
        """Noise of one pixel of the given rows in a channel, for an expected radiance `level` (h, W)."""
        own, seen = self._reference.noise.of(channel, level), self._reference.signals.usable[rows]
        if self._dark is None or seen.all():
            return own
        return np.where(seen, own, self._dark.noise.of_radiance(self._dark.ratio).of(channel, level))

    def ghosts(self, frame: Exposed, misfit: Floats, gain: float) -> Bools:
        """Pixels (H, W) where a frame differs over a whole window by more than noise, misfit and flare.

        misfit: (C,) variance per squared gradient; gain: what resampling made of the frame's noise.
        Single deviant windows are dropped, the rest is grown by a window.
        """
        _, height, width = frame.signals.shape
        found = np.zeros((height, width), bool)
        parallel.results(
            partial(self._block, frame, misfit, gain, found, *block) for block in blocks(height, _WINDOW // 2 + 1)
        )
        core = _all_around(found, 1)
        return _any_around(core, _WINDOW // 2 + 2)

    def _block(
        self, frame: Exposed, misfit: Floats, gain: float, found: Bools, rows: slice, inner: slice, target: slice
    ) -> None:
        """Windows that differ, `inner` of some rows, into their part `target` of `found`."""
        anchor, value = self.rows(rows), frame.signals.rows(rows)
        off = np.zeros(anchor.shape[1:], bool)
        theirs = frame.noise.of_radiance(frame.ratio, gain)
        for c in range(len(anchor)):
            level = box(anchor[c])
            own = self.variance(level, c, rows)
            limit = theirs.of(c, level)
            limit += own
            limit *= np.float32(_SIGMA**2 * _NEIGHBOURS / _WINDOW**2)
            np.sqrt(limit, out=limit)
            if misfit[c]:
                beyond = box(squared_gradient(anchor[c]))
                beyond -= own
                np.maximum(beyond, 0, out=beyond)
                beyond *= np.float32(_MISFIT**2 * misfit[c])
                limit += np.sqrt(beyond, out=beyond)
            difference = box(value[c])
            cv2.scaleAdd(difference, -1 / float(frame.ratio[c]), level, difference)
            np.abs(difference, out=difference)
            np.abs(level, out=level)
            cv2.scaleAdd(level, _SHARE, limit, limit)
            off |= difference > limit
        seen = _all_around(self.known[rows] & frame.signals.usable[rows], _WINDOW // 2)
        found[target] = (off & seen)[inner]


class FirstEstimate:
    """X₀ = Σ Y/a / Σ e/a over usable pixels, smoothed where it is flat."""

    def __init__(self) -> None:
        self._parts: list[tuple[Exposed, Bools]] = []

    def add(self, frame: Exposed, serves: Bools) -> None:
        """A frame for the pixels (H, W) that it serves."""
        self._parts.append((frame, serves))

    def smoothed(self, otherwise: Signals | Anchor, ghost: Bools) -> Floats:
        """The local mean, and of each pixel's distance to it what noise does not explain, (C, H, W).

        A local Wiener filter (Lee, IEEE PAMI 1980), deaf to distances under 1.5 times the noise.
        `otherwise` stands in where no frame served, and at ghosts.
        """
        out = np.empty(self._parts[0][0].signals.shape, np.float32)
        halo = 2 * (_WINDOW // 2)  # the spread is a window of distances to the mean of a window
        parallel.results(partial(self._block, otherwise, ghost, out, *block) for block in blocks(out.shape[1], halo))
        return out

    def _block(
        self, otherwise: Signals | Anchor, ghost: Bools, out: Floats, rows: slice, inner: slice, target: slice
    ) -> None:
        values = [frame.signals.rows(rows) for frame, _ in self._parts]
        serves = [_weight(serve[rows]) for _, serve in self._parts]
        clear = ~ghost[rows]
        everywhere = bool(clear.all()) and any(np.ndim(serve) == 0 for serve in serves)
        stand_in = None if everywhere else otherwise.rows(rows)
        for c in range(len(out)):
            number = np.zeros(clear.shape, np.float32)
            exposure: Floats | np.float32 = np.float32(0)
            floor: Floats | np.float32 = np.float32(0)
            for (frame, _), value, serve in zip(self._parts, values, serves):
                electrons = 1 / float(frame.noise.slope[c])
                cv2.scaleAdd(value[c] if np.ndim(serve) == 0 else value[c] * serve, electrons, number, number)
                exposure = exposure + serve * np.float32(electrons * frame.ratio[c])
                floor = floor + serve * np.float32(electrons**2 * frame.noise.floor[c])
            number /= np.maximum(exposure, np.float32(1e-20))
            if stand_in is not None:
                served = (exposure > 0) & clear
                number = np.where(served, number, stand_in[c])
                exposure = np.where(served, exposure, np.float32(1e15))
            out[c, target] = _wiener(number, exposure, floor)[inner]


def _weight(serves: Bools) -> Floats | np.float32:
    """Where a frame serves, 1, else 0: (h, w), or one number where it serves everywhere."""
    return np.float32(1) if serves.all() else serves.astype(np.float32)


def _wiener(x: Floats, electrons: Floats | np.float32, floor: Floats | np.float32) -> Floats:
    """Smoothed (h, w): `electrons` per unit of x, `floor` the read noise's variance in electrons."""
    mean = box(x)
    distance = x - mean
    spread = box(distance * distance)
    np.maximum(spread, np.float32(1e-20), out=spread)
    noise = np.maximum(mean, 0, out=mean)
    noise *= np.float32(1.5) / electrons
    noise += np.float32(1.5) * floor / (electrons * electrons)
    noise /= spread
    distance *= np.minimum(noise, 1, out=noise)
    return x - distance


def box(picture: Floats) -> Floats:
    """Mean (h, w) over the window around each pixel of a picture (h, w), whose border repeats."""
    # half the time of cv2.blur, which sums in doubles
    return np.asarray(cv2.sepFilter2D(picture, -1, _EVEN, _EVEN, borderType=cv2.BORDER_REPLICATE))


def _any_around(mask: Bools, reach: int) -> Bools:
    """Grown by `reach` px in all eight directions."""
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return np.asarray(cv2.dilate(mask.view(np.uint8), kernel)).view(bool)


def _all_around(mask: Bools, reach: int) -> Bools:
    """What is left when everything else grows by `reach` px; beyond the border nothing grows."""
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return np.asarray(cv2.erode(mask.view(np.uint8), kernel)).view(bool)
