"""Weighted mean of a bracket's frames: radiance, its variance and quality, in one pass over blocks of rows.

X = Σ w (Y/e) / Σ w with w = e² / (a e X₀ + b): e the frame's exposure, a and b its noise line, X₀ the smoothed first
estimate. Weights fall towards saturation and are 0 where a frame is clipped or disagrees.

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

_FALL = 0.05  # [white level]; over this range below saturation a frame's weight falls to _LEAST
_LEAST = 1e-3
_BLOCK_PX = 64_000  # of one channel: all planes of a block then stay in a core's own cache
_SOME = 1e-9  # weight of the reference frame where no frame is usable: some value for every pixel
_AS_DARK = 1.02  # a frame not brighter by more than this counts as the darkest
_DARK_SIGMAS = np.float32(2)


@dataclass(frozen=True)
class _Frame:
    """One frame on the reference frame's grid."""

    signals: Signals
    serves: Bools  # (H, W)
    blur: Floats | None  # (H, W) noise variance gain of resampling
    ratio: Floats  # (C,)
    noise: noise.Noise
    misfit: Floats  # (C,)
    lit: np.float32  # ambient light in it, relative to the reference frame
    last: bool  # there is no darker one to fall back on
    cfa: Bits | None  # where it was interpolated, not binned
    least: np.float32  # weight even where it does not serve


@dataclass(frozen=True)
class WeightedFrames:
    """The frames of a bracket, ready to be summed."""

    frames: list[_Frame]
    compared: ComparedBracket  # on the grid of the frames
    ambient: AmbientLight | None
    served: Bools  # (H, W) where some frame is usable
    clip: float

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.frames[0].signals.shape

    def merge_into(self, out: MaskedImage) -> None:
        """Write the weighted mean; a single channel goes into all three, with 3 times its variance."""
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
        """Weighted mean and its variance of some rows, (C, h, W).

        With frames' weights w = trust / v, v the variance of their radiance, Σ w² v is Σ trust · w. Sums are made of
        w / ratio, so that counts need not be brought to radiance.
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
                    plane = plane - frame.lit * self.ambient.value[c, rows]
                    cv2.scaleAdd(weight, float(frame.lit), shares[c], shares[c])
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
        """Factor of a frame's weight, lower where it clips or nearly does, (h, W) or one number."""
        serves = frame.serves[rows]
        trust: Floats | np.float32 = np.float32(1) if serves.all() else np.maximum(serves, frame.least)
        return trust if frame.last else trust * self._ramp(frame, estimate)

    def _noise(self, frame: _Frame, rows: slice, light: Floats, steep: Floats | None) -> Floats:
        """Expected variance of a frame's radiance `light` (C, h, W) times its ratio."""
        if self.ambient is not None:
            lit = (frame.lit / frame.ratio)[:, None, None]
            light = light + lit * np.maximum(self.ambient.value[:, rows], 0)
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
        if steep is not None:  # registration and aliasing show at edges
            for c, plane in enumerate(out):
                cv2.scaleAdd(steep[c], float(frame.misfit[c] * frame.ratio[c]), plane, plane)
        return out

    def _ramp(self, frame: _Frame, estimate: Floats) -> Floats:
        """1 well below saturation, falling towards 0 at it, so that no frame drops out in a step; (h, W)."""
        peak = estimate[0] * frame.ratio[0]
        for plane, ratio in zip(estimate[1:], frame.ratio[1:]):
            np.maximum(peak, plane * ratio, out=peak)
        np.subtract(np.float32(self.clip), peak, out=peak)
        peak *= np.float32(1 / _FALL)
        return np.asarray(np.clip(peak, np.float32(_LEAST), 1, out=peak))


def prepare(
    bracket: Bracket, compared: ComparedBracket, lines: noise.Lines, read: Reader, full: bool
) -> WeightedFrames:
    """The frames of a compared bracket, registered, on the full grid with `full`; each with the pixels it serves."""
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
    """Frame e on the grid of the merge; it serves wherever it is usable, the last one everywhere."""
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
        lit=np.float32(exposure.of_ambient(shot.frames[e], shot.frames[bracket.reference])),
        last=last,
        cfa=image.cfa if full else None,
        least=np.float32(_SOME if is_reference else 0),
    )


def _flagged(where: Bools, flag: Quality) -> Bits:
    """A flag where it holds, else 0."""
    return np.asarray(where.view(np.uint8) * np.uint8(flag))


def _edges(estimate: Floats, rows: slice) -> Floats:
    """Squared gradient of some rows of an estimate (C, H, W)."""
    top = max(rows.start - 1, 0)
    found = np.stack([squared_gradient(plane[top : rows.stop + 1]) for plane in estimate])
    return np.asarray(found[:, rows.start - top :][:, : rows.stop - rows.start])


def _twice(picture: Floats) -> Floats:
    """A binned picture (C, H, W) on the full grid; cv2 keeps the half-pixel offset of the two."""
    _, h, w = picture.shape
    return np.stack([cv2.resize(plane, (2 * w, 2 * h)) for plane in picture])


def divide_by_falloff(image: MaskedImage, view: View, size_px: tuple[int, int], light: Falloff) -> None:
    """Divide merged radiance (H, W, 3) by the lens's light, its variance by the light's square, in place.

    `view`: of its grid; `size_px`: width and height of the visible RAW, in the corners of which the law's r is 1.
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
