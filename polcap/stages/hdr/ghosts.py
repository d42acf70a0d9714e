"""Ghost detection between the frames of a bracket, and a first estimate of the radiance.

A ghost is a pixel whose frames disagree, because something moved. Frames are registered; signals are in units of the
sensor's range, radiance on the scale of the reference frame. All work is done in blocks of rows, channel by channel.
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

_WINDOW = 5  # px, side of the window for comparison and smoothing
_EVEN = np.full(_WINDOW, 1 / _WINDOW, np.float32)
# A window is a ghost if its frames differ by more than the sum of these four:
_SIGMA = 6.0  # standard deviations of noise
_MISFIT = 3.0  # standard deviations of the registration error at edges
_SHARE = 0.02  # of the radiance: flare differs by as much between exposures
_BLACK = 2e-4  # of the sensor's range, at each frame's exposure: error of the black level, 3 of 15,000 counts
_CORRELATED = 1.5  # variance of a window's mean over that of independent pixels: neighbors share some noise


@dataclass(frozen=True)
class ExposedFrame:
    """A registered frame with its exposure ratio and noise."""

    signals: Signals
    ratio: Floats  # (C,) float32 exposure relative to the reference frame
    noise: Noise
    vignetting: Floats | None = None  # (H, W) float32 factor on the ratio, as wide apertures darken corners; None: 1


class Anchor:
    """Radiance that other frames are compared with: the reference frame, or the darkest where the reference clips."""

    def __init__(self, reference: ExposedFrame) -> None:
        self.known = reference.signals.usable  # (H, W)
        self._reference = reference
        self._dark: ExposedFrame | None = None

    def fill(self, darkest: ExposedFrame) -> None:
        """Use the darkest frame for pixels that are not usable in the reference frame."""
        self.known = self._reference.signals.usable | darkest.signals.usable
        self._dark = darkest

    def rows(self, rows: slice) -> Floats:
        """Radiance (C, h, W) of some rows."""
        value = self._reference.signals.rows(rows)
        if self._dark is None:
            return value
        own, dark = self._reference.signals.usable[rows], self._dark
        if own.all():
            return value
        other = dark.signals.rows(rows)
        return np.stack([np.where(own, a, b / r) for a, b, r in zip(value, other, dark.ratio)])

    def variance(self, level: Floats, channel: int, rows: slice) -> Floats:
        """Noise variance (h, W) in some rows of a channel, for an expected radiance `level` (h, W)."""
        own, seen = self._reference.noise.of_channel(channel, level), self._reference.signals.usable[rows]
        if self._dark is None or seen.all():
            return own
        return np.where(seen, own, self._dark.noise.of_radiance(self._dark.ratio).of_channel(channel, level))

    def ghosts(self, frame: ExposedFrame, misfit: Floats, gain: float) -> Bools:
        """Pixels (H, W) around which the mean of a window differs by more than noise, registration error and flare.

        misfit (C,) is the variance per squared gradient, gain the factor on the frame's noise variance by resampling.
        Isolated windows are dropped, the others are grown by a window.
        """
        _, height, width = frame.signals.shape
        found = np.zeros((height, width), bool)
        parallel.results(
            partial(self._block, frame, misfit, gain, found, *block) for block in blocks(height, _WINDOW // 2 + 1)
        )
        core = _all_around(found, 1)
        return _any_around(core, _WINDOW // 2 + 2)

    def _block(
        self, frame: ExposedFrame, misfit: Floats, gain: float, found: Bools, rows: slice, inner: slice, target: slice
    ) -> None:
        """Mark windows that differ: read `rows`, and write their part `inner` to the rows `target` of `found`."""
        anchor, value = self.rows(rows), frame.signals.rows(rows)
        off = np.zeros(anchor.shape[1:], bool)
        noise = frame.noise.of_radiance(frame.ratio, gain)
        for c in range(len(anchor)):
            level = box(anchor[c])
            own = self.variance(level, c, rows)
            limit = noise.of_channel(c, level)
            limit += own
            limit *= np.float32(_SIGMA**2 * _CORRELATED / _WINDOW**2)
            np.sqrt(limit, out=limit)
            if misfit[c]:
                beyond = box(squared_gradient(anchor[c]))
                beyond -= own
                np.maximum(beyond, 0, out=beyond)
                beyond *= np.float32(_MISFIT**2 * misfit[c])
                limit += np.sqrt(beyond, out=beyond)
            limit += np.float32(_BLACK * (1 + 1 / float(frame.ratio[c])))
            difference = box(value[c])
            if frame.vignetting is not None:
                difference /= frame.vignetting[rows]
            cv2.scaleAdd(difference, -1 / float(frame.ratio[c]), level, difference)
            np.abs(difference, out=difference)
            np.abs(level, out=level)
            cv2.scaleAdd(level, _SHARE, limit, limit)
            off |= difference > limit
        seen = _all_around(self.known[rows] & frame.signals.usable[rows], _WINDOW // 2)
        found[target] = (off & seen)[inner]


class FirstEstimate:
    """First estimate of the radiance, X₀ = Σ Y/a / Σ e/a over usable pixels, smoothed where the picture is flat."""

    def __init__(self) -> None:
        self._parts: list[tuple[ExposedFrame, Bools]] = []

    def add(self, frame: ExposedFrame, serves: Bools) -> None:
        """Add a frame, to be used for some pixels (H, W)."""
        self._parts.append((frame, serves))

    def smoothed(self, otherwise: Signals | Anchor, ghost: Bools) -> Floats:
        """The estimate (C, H, W) after a local Wiener filter (Lee, IEEE PAMI 1980).

        Each pixel is moved towards the mean of its window, by the share of the window's variance that noise explains;
        the filter assumes 1.5 times the noise variance. `otherwise` is used where no frame was added, and at ghosts.
        """
        out = np.empty(self._parts[0][0].signals.shape, np.float32)
        halo = 2 * (_WINDOW // 2)  # windows of distances from means of windows
        parallel.results(partial(self._block, otherwise, ghost, out, *block) for block in blocks(out.shape[1], halo))
        return out

    def _block(
        self, otherwise: Signals | Anchor, ghost: Bools, out: Floats, rows: slice, inner: slice, target: slice
    ) -> None:
        """Smooth `rows`, and write their part `inner` to the rows `target` of `out`."""
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
    """1 where a frame is used and 0 elsewhere, (h, w); the number 1 where it is used everywhere."""
    return np.float32(1) if serves.all() else serves.astype(np.float32)


def _wiener(x: Floats, electrons: Floats | np.float32, floor: Floats | np.float32) -> Floats:
    """Wiener-filtered x (h, w), with `electrons` per unit of x and `floor` the variance of read noise [electrons²]."""
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
    """Mean (h, w) over the window around each pixel of a picture (h, w); border pixels are repeated."""
    # twice as fast as cv2.blur, which sums in float64
    return np.asarray(cv2.sepFilter2D(picture, -1, _EVEN, _EVEN, borderType=cv2.BORDER_REPLICATE))


def _any_around(mask: Bools, reach: int) -> Bools:
    """The mask grown by `reach` px in all eight directions."""
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return np.asarray(cv2.dilate(mask.view(np.uint8), kernel)).view(bool)


def _all_around(mask: Bools, reach: int) -> Bools:
    """The mask shrunk by `reach` px in all eight directions, except from the picture's border."""
    kernel = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    return np.asarray(cv2.erode(mask.view(np.uint8), kernel)).view(bool)
