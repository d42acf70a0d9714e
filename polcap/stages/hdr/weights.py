"""Weighted mean of a bracket's frames: radiance, its variance and quality.

X = Σ w (Y/e) / Σ w with w = e² / (a e X₀ + b), where e is the frame's exposure, a and b its noise line, and X₀ the
smoothed first estimate (Granados et al., as in `hdr`). Weights fall towards saturation, and are 0 where a frame is
clipped or a ghost.
"""

from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from polcap import parallel
from polcap.calibration_values import Falloff
from polcap.capture_values import Frame
from polcap.image_values import Bits, Bools, Floats, MaskedImage, Quality, View
from polcap.optics.registration import scaled, squared_gradient
from polcap.stages.hdr import exposure, noise
from polcap.stages.hdr.bracket import AmbientLight, Bracket, ComparedBracket, ambient_light
from polcap.stages.hdr.ghosts import RegisteredFrame
from polcap.stages.hdr.planes import Reader, blocks, resample

_FALL = 0.05  # range of signal below clipping in which the factor on a frame's weight falls from 1 to `_AT_CLIPPING`
_AT_CLIPPING = 1e-3  # almost 0
_BLOCK_PX = 64_000  # px of a block and channel: all planes of a block then fit a core's cache
_FALLBACK = 1e-9  # factor on the reference frame's weight where it is not used, so that every pixel has a value
_AS_DARK = 1.02  # exposure over that of the darkest frame up to which a frame counts as darkest too
_DARK_SIGMAS = np.float32(2)  # pixels below this many standard deviations are flagged DARK


@dataclass(frozen=True)
class WeightedFrame:
    """One frame of a bracket on the grid of the merge, with its ambient light."""

    frame: RegisteredFrame
    used: Bools  # (H, W) pixels for which the frame is used
    ambient: np.float32  # exposure to ambient light, relative to the reference frame
    is_darkest: bool  # its weight does not fall near saturation, because no frame is darker
    cfa: Bits | None  # of an interpolated mosaic; None: binned
    fallback: np.float32  # factor on its weight where it is not used


@dataclass(frozen=True)
class WeightedBracket:
    """The frames of a bracket, with the data that their weights in the merge need."""

    frames: list[WeightedFrame]
    estimate: Floats  # (C, H, W) the smoothed first estimate
    ghost: Bools  # (H, W)
    ambient: AmbientLight | None
    unclipped: Bools  # (H, W) pixels with an unclipped frame

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.frames[0].frame.signals.shape

    def merge_into(self, out: MaskedImage) -> None:
        """Write the weighted mean of the frames to `out`.

        A single channel is copied to all three, with 3 times its variance.
        """
        _, height, width = self.shape
        rows_of_block = max(_BLOCK_PX // width, 1)
        parallel.results(partial(self._block, out, rows) for rows, _, _ in blocks(height, rows=rows_of_block))

    def _block(self, out: MaskedImage, rows: slice) -> None:
        """Write value, variance and quality of some rows to `out`."""
        value, variance = self._weighted_mean(rows)
        quality = _flagged(~self.unclipped[rows], Quality.CLIPPED)
        quality |= _flagged(self.ghost[rows], Quality.GHOST)
        quality |= _flagged(value.sum(axis=0) < _DARK_SIGMAS * np.sqrt(variance.sum(axis=0)), Quality.DARK)
        out.quality[rows] = quality
        if len(value) == 1:
            value, variance = value.repeat(3, axis=0), variance.repeat(3, axis=0) * np.float32(3)
        cv2.merge(list(value), out.value[rows])
        cv2.merge(list(variance), out.variance[rows])

    def _weighted_mean(self, rows: slice) -> tuple[Floats, Floats]:
        """Weighted mean of the frames and its variance in some rows, (C, h, W).

        With weights w = trust / v and v the variance of a frame's radiance, Σ w² v = Σ trust · w. The sums use
        w / ratio, so that signals need not be converted to radiance.
        """
        estimate = self.estimate[:, rows]
        total, weights, variance, ambient_exposure = (np.zeros_like(estimate) for _ in range(4))
        edges = _edges(self.estimate, rows) if any(one.frame.misfit.any() for one in self.frames) else None
        for one in self.frames:
            sample, trust = one.frame.signals.rows(rows), self._trust(one, estimate, rows)
            for c, weight in enumerate(self._noise(one, rows, np.maximum(estimate, 0), edges)):
                ratio, plane = float(one.frame.ratio[c]), sample[c]
                np.divide(trust, weight, out=weight)
                if self.ambient is not None:
                    plane = plane - one.ambient * self.ambient.value[c, rows]
                    cv2.scaleAdd(weight, float(one.ambient), ambient_exposure[c], ambient_exposure[c])
                cv2.accumulateProduct(weight, plane, total[c])
                cv2.scaleAdd(weight, ratio, weights[c], weights[c])
                weight *= trust
                cv2.scaleAdd(weight, ratio, variance[c], variance[c])
        total /= weights
        variance /= weights
        variance /= weights
        if self.ambient is not None:
            variance += (ambient_exposure / weights) ** 2 * self.ambient.variance[:, rows]
        return total, variance

    def _trust(self, one: WeightedFrame, estimate: Floats, rows: slice) -> Floats | np.float32:
        """Factor on a frame's weight, (h, W) or one number: it falls from 1 to almost 0 near saturation.

        So weights have no step. The darkest frame keeps the factor 1 near saturation, because no other frame has these
        pixels. Where a frame is not used, the factor is its `fallback`.
        """
        used = one.used[rows]
        trust: Floats | np.float32 = np.float32(1) if used.all() else np.maximum(used, one.fallback)
        if one.is_darkest:
            return trust
        # expected signal of the brightest channel, with the ambient light
        brightest = np.maximum.reduce([plane * ratio for plane, ratio in zip(estimate, one.frame.ratio)])
        if self.ambient is not None:
            brightest += one.ambient * self.ambient.value[:, rows].max(axis=0)
        ramp = (np.float32(one.frame.signals.clip) - brightest) * np.float32(1 / _FALL)
        return np.asarray(trust * np.clip(ramp, np.float32(_AT_CLIPPING), 1))

    def _noise(self, one: WeightedFrame, rows: slice, radiance: Floats, edges: Floats | None) -> Floats:
        """Noise variance of a frame's radiance, times its exposure ratio; `radiance` (C, h, W) is the expected one."""
        frame, ratio = one.frame, one.frame.ratio[:, None, None]
        if self.ambient is not None:
            radiance = radiance + one.ambient / ratio * np.maximum(self.ambient.value[:, rows], 0)
        variance = noise.of_pixels(radiance * ratio, frame.noise, one.cfa)
        variance /= ratio
        if frame.gain is not None:
            variance *= frame.gain[rows]
        if edges is not None:  # squared gradients: registration errors and aliasing add variance
            for c, plane in enumerate(variance):
                cv2.scaleAdd(edges[c], float(frame.misfit[c] * frame.ratio[c]), plane, plane)
        return variance


def prepare(
    bracket: Bracket, compared: ComparedBracket, lines: noise.Lines, read: Reader, full: bool
) -> WeightedBracket:
    """Prepare a compared bracket for the merge: registered frames, and the pixels for which each is used.

    `full`: on the grid of the photosites instead of the superpixels.
    """
    ambient = ambient_light(bracket, lines, read, full)
    ghost, estimate = compared.ghost, compared.estimate
    if full:
        ghost, estimate = np.repeat(np.repeat(ghost, 2, axis=0), 2, axis=1), _twice(estimate)
    exposures = [float(frame.ratio.mean()) for frame in compared.frames]
    darkest, reference = int(np.argmin(exposures)), bracket.shot.frames[bracket.reference]
    unclipped = by_reference = np.zeros(ghost.shape, bool)
    frames = []
    for e in [bracket.reference, *bracket.others]:
        frame = compared.frames[e]
        if full or ambient is not None:
            frame = _read_again(bracket.shot.frames[e], frame, read, full)
        is_darkest, usable = exposures[e] < _AS_DARK * exposures[darkest], frame.signals.usable
        # the darkest frame, unless it moved, gives clipped pixels their value
        used = usable if frame.motion is not None or not is_darkest else np.ones_like(usable)
        if e == bracket.reference:
            by_reference = used
        else:
            used = used & (~ghost | (~by_reference & (e == darkest)))
        unclipped = unclipped | (used & usable)
        frames.append(
            WeightedFrame(
                frame=frame,
                used=used,
                ambient=np.float32(exposure.of_ambient(bracket.shot.frames[e], reference)),
                is_darkest=is_darkest,
                cfa=read(bracket.shot.frames[e]).cfa if full else None,
                fallback=np.float32(_FALLBACK if e == bracket.reference else 0),
            )
        )
    return WeightedBracket(frames, estimate, ghost, ambient, unclipped)


def _read_again(source: Frame, frame: RegisteredFrame, read: Reader, full: bool) -> RegisteredFrame:
    """Read a frame again without subtracting ambient light; `full`: on the grid of the photosites."""
    signals, gain = read.signals(source, full), None
    if frame.motion is not None:
        signals, gain = resample(signals, scaled(frame.motion, 2) if full else frame.motion)
    return replace(frame, signals=signals, gain=gain, misfit=frame.misfit * (4 if full else 1))  # px²


def _flagged(where: Bools, flag: Quality) -> Bits:
    """Quality bits with `flag` set where a mask is true, else 0."""
    return np.asarray(where.view(np.uint8) * np.uint8(flag))


def _edges(estimate: Floats, rows: slice) -> Floats:
    """Squared gradient (C, h, W) of an estimate (C, H, W) in some rows."""
    top = max(rows.start - 1, 0)
    found = np.stack([squared_gradient(plane[top : rows.stop + 1]) for plane in estimate])
    return np.asarray(found[:, rows.start - top :][:, : rows.stop - rows.start])


def _twice(picture: Floats) -> Floats:
    """Enlarge a binned picture (C, H, W) to the full grid; cv2.resize respects the half-pixel offset."""
    _, h, w = picture.shape
    return np.stack([cv2.resize(plane, (2 * w, 2 * h)) for plane in picture])


def divide_by_falloff(image: MaskedImage, view: View, size_px: tuple[int, int], falloff: Falloff) -> None:
    """Divide radiance (H, W, 3) by a lens's falloff 1 + a r² + b r⁴ + c r⁶, and variance by its square, in place.

    `view` is the camera of the picture; `size_px` the width and height of the visible RAW, where r = 1 in the corners.
    """
    coefficient = np.broadcast_to(np.array(falloff.coefficient), (3, 3))  # a monochrome sensor has one row
    radius = np.hypot(*size_px) / 2 / view.scale  # r = 1, in px of this grid
    height, width = image.quality.shape
    x2 = ((np.arange(width) - view.center[0]) / radius) ** 2
    for rows, _, _ in blocks(height):
        y2 = ((np.arange(rows.start, rows.stop) - view.center[1]) / radius) ** 2
        r2 = (y2[:, None] + x2)[..., None]
        factor = (1 + r2 * (coefficient[:, 0] + r2 * (coefficient[:, 1] + r2 * coefficient[:, 2]))).astype(np.float32)
        image.value[rows] /= factor
        image.variance[rows] /= factor**2
