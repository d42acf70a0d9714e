"""The merge itself: every frame of a shot weighted by its exposure over its noise, in one pass of blocks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap import parallel
from polcap.images import Bits, Floats, Quality, Shot
from polcap.optics.registration import squared_gradient
from polcap.stages.hdr import ambient as ambients
from polcap.stages.hdr import frame_motion, noise
from polcap.stages.hdr.ambient import Ambient
from polcap.stages.hdr.links import Measured
from polcap.stages.hdr.planes import Reader, Signals, blocks

Bools = NDArray[np.bool_]

_FALL = 0.05  # [white level]; over this range below saturation a frame's weight falls to _LEAST
_LEAST = 1e-3
_BLOCK_PX = 64_000  # of one channel: all planes of a block then stay in a core's own cache
_SOME = 1e-9  # weight of the reference frame where nothing can be believed: some value for every pixel


@dataclass(frozen=True)
class Merged:
    """Where one shot goes: slices of the stack."""

    value: Floats  # (H, W, 3)
    variance: Floats  # (H, W, 3)
    quality: Bits  # (H, W)


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


def prepare(
    shot: Shot, order: Sequence[int], reference: int, measured: Measured, lines: noise.Lines, read: Reader, clip: float,
    full: bool,
) -> "Mixture":  # fmt: skip
    """The frames of a shot ready to be weighted.

    Parameters
    ----------
    shot
        Its frames.
    order
        Their numbers, brightest first.
    reference
        Number of the frame on whose grid they are merged.
    measured
        Motion, ratios, noise and ghosts, on the binned grid.
    lines
        Noise by ISO.
    read
        Decodes a frame.
    clip
        As in the stage's settings [white level].
    full
        On the full grid instead of the binned one.
    """
    links = measured.links
    if full:
        ghost = np.repeat(np.repeat(measured.ghost, 2, axis=0), 2, axis=1)
        measured = replace(measured, estimate=_twice(measured.estimate), ghost=ghost)
    ambient = ambients.measure(shot, shot.frames[reference], lines, read, full, clip)
    bright = [float(link.ratio.mean()) for link in links]
    darkest = int(np.argmin(bright))
    served = anchored = np.zeros(measured.ghost.shape, bool)
    frames = []
    for e in [reference, *(e for e in order if e != reference)]:
        link, image = links[e], read(shot.frames[e])
        if measured.frames is not None and not full:
            found, blur = measured.frames[e].signals, measured.frames[e].gain
        else:
            found, blur = read.signals(shot, e, clip, full), None
            if link.moved is not None:
                found, blur = frame_motion.resampled(found, frame_motion.on_full(link.moved) if full else link.moved)
        last = bright[e] < 1.02 * bright[darkest]
        serves = found.usable if link.moved is not None or not last else np.ones_like(found.usable)
        if e == reference:
            anchored = serves
        elif measured.ghost.any():
            serves = serves & (~measured.ghost | (~anchored & (e == darkest)))
        served = served | (serves & found.usable)
        frames.append(
            _Frame(
                signals=found,
                serves=serves,
                blur=blur,
                ratio=link.ratio,
                noise=measured.noises[e],
                misfit=link.misfit * (4 if full else 1),
                lit=np.float32(ambients.gathered(shot.frames[e], shot.frames[reference])),
                last=last,
                cfa=image.cfa if full else None,
                least=np.float32(_SOME if e == reference else 0),
            )
        )
    return Mixture(frames, measured, ambient, served, clip)


@dataclass(frozen=True)
class Mixture:
    """A shot's frames and what they are weighted by."""

    frames: list[_Frame]
    measured: Measured  # on the grid of the frames
    ambient: Ambient | None
    served: Bools  # (H, W) where some frame can be believed
    clip: float

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.frames[0].signals.shape

    def into(self, out: Merged) -> None:
        """Weight, sum and write; a single channel goes into all three, with 3 times its variance."""
        _, height, width = self.shape
        rows_of_block = max(_BLOCK_PX // width, 1)
        parallel.results(partial(self._block, out, rows) for rows, _, _ in blocks(height, rows=rows_of_block))

    def _block(self, out: Merged, rows: slice) -> None:
        value, variance = self._rows(rows)
        total, noise_ = (np.sum(planes, axis=0) for planes in (value, variance))
        np.sqrt(noise_, out=noise_)
        noise_ *= np.float32(2)
        quality = _flagged(~self.served[rows], Quality.CLIPPED)
        quality |= _flagged(self.measured.ghost[rows], Quality.GHOST)
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
        estimate = self.measured.estimate[:, rows]
        light = np.maximum(estimate, 0)
        number, weights, variance = (np.zeros_like(estimate) for _ in range(3))
        shares = np.zeros_like(estimate) if self.ambient is not None else None  # of the ambient light
        steep = _edges(self.measured.estimate, rows) if any(f.misfit.any() for f in self.frames) else None
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
        """What a frame's weight is multiplied by where it clips or nearly does, (h, W) or one number."""
        serves = frame.serves[rows]
        trust: Floats | np.float32 = np.float32(1) if serves.all() else np.maximum(serves, frame.least)
        return trust if frame.last else trust * self._ramp(frame, estimate)

    def _noise(self, frame: _Frame, rows: slice, light: Floats, steep: Floats | None) -> Floats:
        """Expected variance of a frame's radiance times its ratio, (C, h, W), where that is `light`."""
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
            out = ambients.noise_of(light * ratio, frame.noise, frame.cfa)
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
