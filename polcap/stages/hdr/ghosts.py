"""Finds ghosts (pixels where something moved between frames), and makes a first estimate of the radiance.

This estimate is the *anchor*: the reference frame, and the darkest frame where the reference is clipped. Frames are
registered. Signals are in units of the sensor's range; radiance is on the scale of the reference frame. All work is
done in blocks of rows, channel by channel.
"""

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np

from polcap import parallel
from polcap.image_values import Bools, Floats
from polcap.optics.morphology import dilate, erode
from polcap.optics.registration import squared_gradient
from polcap.stages.hdr.noise import Noise
from polcap.stages.hdr.planes import Signals, blocks

_WINDOW = 5  # px, side of the window for comparison and smoothing
_EVEN = np.full(_WINDOW, 1 / _WINDOW, np.float32)  # kernel of a mean
# A window is a ghost if its frames differ by more than the sum of these four:
_SIGMA = 6.0  # standard deviations of noise
_MISFIT = 3.0  # standard deviations of the registration error at edges
_SHARE = 0.02  # of the radiance: flare differs by as much between exposures
_BLACK = 2e-4  # error of the black level in each frame [sensor's range]: 3 of 15,000 counts
_CORRELATED = 1.5  # variance of a window's mean over that of independent pixels: neighbors share some noise


@dataclass(frozen=True)
class RegisteredFrame:
    """A frame on the reference frame's grid, with its exposure, noise and motion."""

    signals: Signals
    ratio: Floats  # (C,) float32 exposure relative to the reference frame
    noise: Noise
    misfit: Floats  # (C,) float32 px²; variance per squared gradient, from registration errors and aliasing
    motion: Floats | None = None  # (3, 3) reference px → frame px; None: no motion
    gain: Floats | None = None  # (H, W) factor on the noise variance by resampling; None: not resampled
    vignetting: Floats | None = None  # (H, W) float32 factor on the ratio, as wide apertures darken corners; None: 1
    curvature: float = 0.0  # of `exposure.curvature`; 0: linear, NaN: unknown
    flicker: float = float("nan")  # of `exposure.flicker`; NaN: unknown, or the reference frame

    @property
    def mean_gain(self) -> float:
        return 1.0 if self.gain is None else float(self.gain.mean())


@dataclass(frozen=True)
class Anchor:
    """Radiance to compare frames with: the reference frame, or the darkest frame where the reference clips."""

    reference: RegisteredFrame
    darkest: RegisteredFrame | None = None

    @property
    def known(self) -> Bools:
        """Mask (H, W) of pixels where the anchor has a usable frame."""
        usable = self.reference.signals.usable
        return usable if self.darkest is None else usable | self.darkest.signals.usable

    def rows(self, rows: slice) -> Floats:
        """Radiance (C, h, W) of some rows: of the reference frame, of the darkest frame where the reference clips."""
        value, usable = self.reference.signals.rows(rows), self.reference.signals.usable[rows]
        if self.darkest is None or usable.all():
            return value
        return np.where(usable, value, self.darkest.signals.rows(rows) / self.darkest.ratio[:, None, None])

    def variance(self, level: Floats, channel: int, rows: slice) -> Floats:
        """Noise variance (h, W) of the anchor in some rows of a channel, for an expected radiance `level` (h, W)."""
        variance, usable = self.reference.noise.of_channel(channel, level), self.reference.signals.usable[rows]
        if self.darkest is None or usable.all():
            return variance
        return np.where(usable, variance, self.darkest.noise.of_radiance(self.darkest.ratio).of_channel(channel, level))

    def ghosts(self, frame: RegisteredFrame) -> Bools:
        """Ghost mask (H, W): pixels around which a frame differs by more than noise, registration error and flare.

        Isolated windows are dropped, the others are grown by a window.
        """
        _, height, width = frame.signals.shape
        found, known = np.zeros((height, width), bool), self.known & frame.signals.usable
        noise = frame.noise.of_radiance(frame.ratio, frame.mean_gain)

        def compare(rows: slice, inner: slice, target: slice) -> None:
            anchor, value = self.rows(rows), frame.signals.rows(rows)
            differs = np.zeros(anchor.shape[1:], bool)
            for c in range(len(anchor)):
                level = box(anchor[c])
                own = self.variance(level, c, rows)
                limit = np.sqrt((noise.of_channel(c, level) + own) * np.float32(_SIGMA**2 * _CORRELATED / _WINDOW**2))
                if frame.misfit[c]:
                    edge = np.maximum(box(squared_gradient(anchor[c])) - own, 0)
                    limit += np.sqrt(edge * np.float32(_MISFIT**2 * frame.misfit[c]))
                limit += _SHARE * np.abs(level) + np.float32(_BLACK * (1 + 1 / float(frame.ratio[c])))
                scaled = box(value[c]) / frame.ratio[c]
                if frame.vignetting is not None:
                    scaled /= frame.vignetting[rows]
                differs |= np.abs(scaled - level) > limit
            found[target] = (differs & erode(known[rows], _WINDOW // 2))[inner]

        parallel.results(partial(compare, *block) for block in blocks(height, _WINDOW // 2 + 1))
        return dilate(erode(found, 1), _WINDOW // 2 + 2)


def first_estimate(parts: list[tuple[RegisteredFrame, Bools]], fallback: Anchor, ghost: Bools) -> Floats:
    """First estimate of a bracket's radiance, X₀ = Σ Y/a / Σ e/a, (C, H, W), after a local Wiener filter.

    `parts` are frames, each with the pixels (H, W) for which it is used. `fallback` is used where no frame is, and at
    ghosts. The filter (Lee, IEEE PAMI 1980) moves each pixel towards the mean of its window, by the share of the
    window's variance that 1.5 times the noise variance explains.
    """
    out = np.empty(parts[0][0].signals.shape, np.float32)

    def estimate(rows: slice, inner: slice, target: slice) -> None:
        values = [frame.signals.rows(rows) for frame, _ in parts]
        masks = [_weight(used[rows]) for _, used in parts]
        clear = ~ghost[rows]
        everywhere = clear.all() and any(np.ndim(used) == 0 for used in masks)
        substitute = None if everywhere else fallback.rows(rows)
        for c in range(len(out)):
            total = np.zeros(clear.shape, np.float32)
            exposure: Floats | np.float32 = np.float32(0)
            floor: Floats | np.float32 = np.float32(0)
            for (frame, _), value, used in zip(parts, values, masks):
                electrons = 1 / frame.noise.slope[c]
                total += value[c] * (used * electrons)
                exposure = exposure + used * (electrons * frame.ratio[c])
                floor = floor + used * (electrons**2 * frame.noise.floor[c])
            total /= np.maximum(exposure, np.float32(1e-20))
            if substitute is not None:
                measured = (exposure > 0) & clear
                total = np.where(measured, total, substitute[c])
                exposure = np.where(measured, exposure, np.float32(1e15))  # no noise, so no filter
            out[c, target] = _wiener(total, exposure, floor)[inner]

    halo = 2 * (_WINDOW // 2)  # windows of distances from means of windows
    parallel.results(partial(estimate, *block) for block in blocks(out.shape[1], halo))
    return out


def _weight(used: Bools) -> Floats | np.float32:
    """Weight (h, w) of a frame: 1 in pixels where it is used, else 0; the number 1 if it is used everywhere."""
    return np.float32(1) if used.all() else used.astype(np.float32)


def _wiener(x: Floats, electrons: Floats | np.float32, floor: Floats | np.float32) -> Floats:
    """Wiener-filter a picture x (h, w): local means replace detail that 1.5 times the noise variance explains.

    `electrons` is the number of electrons per unit of x, `floor` the variance of the read noise [electrons²].
    """
    mean = box(x)
    distance = x - mean
    noise = np.float32(1.5) * (np.maximum(mean, 0) / electrons + floor / (electrons * electrons))
    return x - distance * np.minimum(noise / np.maximum(box(distance * distance), np.float32(1e-20)), 1)


def box(picture: Floats) -> Floats:
    """Box filter: mean (h, w) over the window around each pixel of a picture (h, w); border pixels are repeated."""
    # twice as fast as cv2.blur, which sums in float64
    return np.asarray(cv2.sepFilter2D(picture, -1, _EVEN, _EVEN, borderType=cv2.BORDER_REPLICATE))
