"""Weighted mean of a bracket's frames: radiance, its variance and quality.

X = Σ w (Y/e) / Σ w with w = e² / (a e X₀ + b), where e is the frame's exposure, a and b its noise line, and X₀ the
smoothed first estimate. Weights fall towards saturation, and are 0 where a frame is clipped or a ghost.

References
----------
Granados et al., Optimal HDR reconstruction with linear digital cameras, CVPR 2010.
"""

from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap import parallel
from polcap.images import Bits, Falloff, Floats, MaskedImage, Quality, View
from polcap.optics.registration import scaled, squared_gradient
from polcap.stages.hdr import exposure, noise
from polcap.stages.hdr.bracket import AmbientLight, Bracket, ComparedBracket, ambient_light
from polcap.stages.hdr.planes import Reader, Signals, blocks, resample

Bools = NDArray[np.bool_]

_FALL = 0.05  # [white level] range below saturation in which a frame's weight falls from 1 to _LEAST
_LEAST = 1e-3
_BLOCK_PX = 64_000  # px of a block and channel: all planes of a block then fit a core's cache
_SOME = 1e-9  # weight of the reference frame where no frame is usable, so that every pixel has a value
_AS_DARK = 1.02  # a frame at most this factor brighter than the darkest counts as darkest too
_DARK_SIGMAS = np.float32(2)  # pixels below this many standard deviations are flagged DARK


@dataclass(frozen=True)
class _Frame:
    """One frame on the reference frame's grid."""

    signals: Signals
    serves: Bools  # (H, W) pixels for which the frame is used
    blur: Floats | None  # (H, W) factor on the noise variance by resampling
    ratio: Floats  # (C,)
    noise: noise.Noise
    misfit: Floats  # (C,)
    ambient: np.float32  # exposure to ambient light, relative to the reference frame
    last: bool  # no frame is darker: used up to saturation
    cfa: Bits | None  # of an interpolated mosaic; None: binned
    least: np.float32  # weight where the frame is not used


@dataclass(frozen=True)
class WeightedFrames:
    """The frames of a bracket with everything that their weights need."""

    frames: list[_Frame]
    compared: ComparedBracket  # on the grid of the frames
    ambient: AmbientLight | None
    served: Bools  # (H, W) pixels with at least one usable frame
    clip: float

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.frames[0].signals.shape

    def merge_into(self, out: MaskedImage) -> None:
        """Write the weighted mean to `out`; a single channel is copied to all three, with 3 times its variance."""
        _, height, width = self.shape
        rows_of_block = max(_BLOCK_PX // width, 1)
        parallel.results(partial(self._block, out, rows) for rows, _, _ in blocks(height, rows=rows_of_block))

    def _block(self, out: MaskedImage, rows: slice) -> None:
        value, variance = self._rows(rows)
        total, noise_ = (np.sum(planes, axis=0) for planes in (value, variance))
        np.sqrt(noise_, out=noise_)
        noise_ *= _DARK_SIGMAS
        quality = _flagged(~self.served[rows], Quality.CLIPPED)
        quality |= _flagged(self.compared.ghost[rows], Quality.GHOST)
        quality |= _flagged(total < noise_, Quality.DARK)
        out.quality[rows] = quality
        if len(value) == 1:
            value, variance = value.repeat(3, axis=0), variance.repeat(3, axis=0) * np.float32(3)
        cv2.merge(list(value), out.value[rows])
        cv2.merge(list(variance), out.variance[rows])

    def _rows(self, rows: slice) -> tuple[Floats, Floats]:
        """Weighted mean and its variance in some rows, (C, h, W).

        With weights w = trust / v and v the variance of a frame's radiance, Σ w² v = Σ trust · w. The sums use
        w / ratio, so that signals need not be converted to radiance.
        """
        estimate = self.compared.estimate[:, rows]
        light = np.maximum(estimate, 0)
        number, weights, variance = (np.zeros_like(estimate) for _ in range(3))
        shares = np.zeros_like(estimate) if self.ambient is not None else None  # of the ambient light
        steep = _edges(self.compared.estimate, rows) if any(f.misfit.any() for f in self.frames) else None
        for frame in self.frames:
            sample, trust = frame.signals.rows(rows), self._trust(frame, estimate, rows)
            for c, weight in enumerate(self._noise(frame, rows, light, steep)):
                ratio, plane = float(frame.ratio[c]), sample[c]
                np.divide(trust, weight, out=weight)
                if self.ambient is not None and shares is not None:
                    plane = plane - frame.ambient * self.ambient.value[c, rows]
                    cv2.scaleAdd(weight, float(frame.ambient), shares[c], shares[c])
                cv2.accumulateProduct(weight, plane, number[c])
                cv2.scaleAdd(weight, ratio, weights[c], weights[c])
                if np.ndim(trust):
                    weight *= trust
                cv2.scaleAdd(weight, ratio, variance[c], variance[c])
        number /= weights
        variance /= weights
        variance /= weights
        if self.ambient is not None and shares is not None:
            shares /= weights
            variance += shares * shares * self.ambient.variance[:, rows]
        return number, variance

    def _trust(self, frame: _Frame, estimate: Floats, rows: slice) -> Floats | np.float32:
        """Factor on a frame's weight, lower near and at saturation; (h, W) or one number."""
        serves = frame.serves[rows]
        trust: Floats | np.float32 = np.float32(1) if serves.all() else np.maximum(serves, frame.least)
        return trust if frame.last else trust * self._ramp(frame, estimate)

    def _noise(self, frame: _Frame, rows: slice, light: Floats, steep: Floats | None) -> Floats:
        """Expected variance of a frame's radiance `light` (C, h, W), times its exposure ratio."""
        if self.ambient is not None:
            exposure_ = (frame.ambient / frame.ratio)[:, None, None]
            light = light + exposure_ * np.maximum(self.ambient.value[:, rows], 0)
        if frame.cfa is None:
            out = np.empty_like(light)
            for c, plane in enumerate(light):
                np.multiply(plane, frame.noise.slope[c], out=out[c])
                out[c] += frame.noise.floor[c] / frame.ratio[c]
        else:
            ratio = frame.ratio[:, None, None]
            out = noise.of_pixels(light * ratio, frame.noise, frame.cfa)
            out /= ratio
        if frame.blur is not None:
            out *= frame.blur[rows]
        if steep is not None:  # registration errors and aliasing, at edges
            for c, plane in enumerate(out):
                cv2.scaleAdd(steep[c], float(frame.misfit[c] * frame.ratio[c]), plane, plane)
        return out

    def _ramp(self, frame: _Frame, estimate: Floats) -> Floats:
        """Factor (h, W) that falls smoothly from 1 to _LEAST at saturation, so that weights have no step."""
        peak = estimate[0] * frame.ratio[0]
        for plane, ratio in zip(estimate[1:], frame.ratio[1:]):
            np.maximum(peak, plane * ratio, out=peak)
        np.subtract(np.float32(self.clip), peak, out=peak)
        peak *= np.float32(1 / _FALL)
        return np.asarray(np.clip(peak, np.float32(_LEAST), 1, out=peak))


def prepare(
    bracket: Bracket, compared: ComparedBracket, lines: noise.Lines, read: Reader, full: bool
) -> WeightedFrames:
    """The registered frames of a compared bracket, on the full grid with `full`, and the pixels each is used for."""
    ambient = ambient_light(bracket, lines, read, full)
    if full:
        ghost = np.repeat(np.repeat(compared.ghost, 2, axis=0), 2, axis=1)
        compared = replace(compared, estimate=_twice(compared.estimate), ghost=ghost)
    bright = [float(link.ratio.mean()) for link in compared.links]
    darkest = int(np.argmin(bright))
    served = anchored = np.zeros(compared.ghost.shape, bool)
    frames = []
    for e in [bracket.reference, *bracket.others]:
        frame = _frame(bracket, e, compared, read, full, last=bright[e] < _AS_DARK * bright[darkest])
        if e == bracket.reference:
            anchored = frame.serves
        elif compared.ghost.any():
            frame = replace(frame, serves=frame.serves & (~compared.ghost | (~anchored & (e == darkest))))
        served = served | (frame.serves & frame.signals.usable)
        frames.append(frame)
    return WeightedFrames(frames, compared, ambient, served, read.clip)


def _frame(bracket: Bracket, e: int, compared: ComparedBracket, read: Reader, full: bool, last: bool) -> _Frame:
    """Frame e on the grid of the merge, used where it is usable; a frame with no darker one is used everywhere."""
    shot, link = bracket.shot, compared.links[e]
    image = read(shot.frames[e])
    if compared.frames is not None and not full:
        found, blur = compared.frames[e].signals, compared.frames[e].gain
    else:
        found, blur = read.signals(shot, e, full), None
        if link.motion is not None:
            found, blur = resample(found, scaled(link.motion, 2) if full else link.motion)
    is_reference = e == bracket.reference
    return _Frame(
        signals=found,
        serves=found.usable if link.motion is not None or not last else np.ones_like(found.usable),
        blur=blur,
        ratio=link.ratio,
        noise=compared.noises[e],
        misfit=link.misfit * (4 if full else 1),
        ambient=np.float32(exposure.of_ambient(shot.frames[e], shot.frames[bracket.reference])),
        last=last,
        cfa=image.cfa if full else None,
        least=np.float32(_SOME if is_reference else 0),
    )


def _flagged(where: Bools, flag: Quality) -> Bits:
    """The flag's bit where a mask holds, else 0."""
    return np.asarray(where.view(np.uint8) * np.uint8(flag))


def _edges(estimate: Floats, rows: slice) -> Floats:
    """Squared gradient (C, h, W) of some rows of an estimate (C, H, W)."""
    top = max(rows.start - 1, 0)
    found = np.stack([squared_gradient(plane[top : rows.stop + 1]) for plane in estimate])
    return np.asarray(found[:, rows.start - top :][:, : rows.stop - rows.start])


def _twice(picture: Floats) -> Floats:
    """A binned picture (C, H, W) enlarged to the full grid; cv2.resize respects the half-pixel offset."""
    _, h, w = picture.shape
    return np.stack([cv2.resize(plane, (2 * w, 2 * h)) for plane in picture])


def divide_by_falloff(image: MaskedImage, view: View, size_px: tuple[int, int], light: Falloff) -> None:
    """Divide merged radiance (H, W, 3) by the lens's relative illumination, and its variance by the square, in place.

    `view` is the camera of the picture; `size_px` the width and height of the visible RAW, where r = 1 in the corners.
    """
    coefficient = np.broadcast_to(np.array(light.coefficient), (3, 3))
    half = np.hypot(*size_px) / 2 / view.scale  # px of this grid
    height, width = image.quality.shape
    x2 = ((np.arange(width) - view.center[0]) / half) ** 2
    for rows, _, _ in blocks(height):
        y2 = ((np.arange(rows.start, rows.stop) - view.center[1]) / half) ** 2
        r2 = (y2[:, None] + x2)[..., None]
        gain = (1 + r2 * (coefficient[:, 0] + r2 * (coefficient[:, 1] + r2 * coefficient[:, 2]))).astype(np.float32)
        image.value[rows] /= gain
        image.variance[rows] /= gain**2
