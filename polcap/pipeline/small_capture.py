"""A capture in, the same of at most 0.6 MP out, with what the averaging would hide: clipping and sharpness."""

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from polcap.formats.raw import glance
from polcap.formats.raw.glance import Glance
from polcap.images import Capture, Floats, Frame, SensorImage, Shot
from polcap.optics import sharpness

_MOST_PIXELS = 0.6e6  # of the pictures that the stages see


@dataclass(frozen=True)
class Taken:
    """A capture averaged down, and what the averaging would hide; its frames come as they are decoded."""

    capture: Capture  # loads from memory, or waits
    step: int  # visible RAW px per px
    binned: int  # visible RAW px per px of the picture that `process` merges
    coming: dict[int, Future[Glance]]  # by the frame's id
    shots: tuple[tuple[Frame, ...], ...]  # (K, E)

    @cached_property
    def clipped(self) -> Floats:
        """(K, E, h, w) share of each pixel that is clipped."""
        return np.stack([[self._seen(frame).clipped for frame in shot] for shot in self.shots])

    @cached_property
    def blur_px(self) -> Floats:
        """(K, E) of each frame beyond the sharpest of its exposure, 1σ [visible RAW px]."""
        return sharpness.frames_blur([[self._seen(f).tiles for f in shot] for shot in self.shots], self.binned)

    def _seen(self, frame: Frame) -> Glance:
        return self.coming[id(frame)].result()


def take(capture: Capture, clip: float, pool: ThreadPoolExecutor) -> Taken:
    """Every frame decoded once, and averaged down where it is decoded.

    The reference frame comes first: it says how far to reduce and where to look. The others follow in the order in
    which they are merged.

    Parameters
    ----------
    capture
        Its frames are forgotten.
    clip
        Counts from here on are clipped [white level].
    pool
        Decodes as many frames at a time as it has threads.

    Raises
    ------
    DecodeError
        Of the reference frame at once, of another one when it is asked for.
    """
    first = capture.shots[0].frames[(len(capture.shots[0].frames) - 1) // 2]
    meta, arrays = _within(first, glance.first, clip=clip, most_pixels=_MOST_PIXELS)
    times, half, corners = int(meta["times"]), int(meta["superpixel"]), arrays["corners"].tolist()
    brackets = (*capture.shots, *(() if capture.crossed is None else (capture.crossed,)))
    others = [frame for shot in brackets for frame in (*shot.frames, *shot.ambient) if frame is not first]
    coming = {id(frame): pool.submit(_glance, frame, clip, times, corners) for frame in others}
    coming[id(first)] = Future()
    coming[id(first)].set_result(glance.joined(meta, arrays))

    def smaller(frame: Frame) -> Frame:
        return replace(frame, load=partial(_picture, coming[id(frame)]), within=None)

    def shrunk(shot: Shot) -> Shot:
        return replace(shot, frames=tuple(map(smaller, shot.frames)), ambient=tuple(map(smaller, shot.ambient)))

    step = half * times
    (x, y), (width, height) = capture.principal_px, capture.size_px
    return Taken(
        capture=replace(
            capture,
            shots=tuple(map(shrunk, capture.shots)),
            crossed=None if capture.crossed is None else shrunk(capture.crossed),
            focal_px=capture.focal_px / step,
            principal_px=((x - (step - 1) / 2) / step, (y - (step - 1) / 2) / step),
            size_px=(width // step, height // step),
            calibration=capture.calibration and replace(capture.calibration, noise=()),  # of pixels, not of their means
        ),
        step=step,
        binned=half,
        coming=coming,
        shots=tuple(shot.frames for shot in capture.shots),
    )


def _glance(frame: Frame, clip: float, times: int, corners: list[list[int]]) -> Glance:
    return glance.joined(*_within(frame, glance.take, clip=clip, times=times, corners=corners))


def _picture(coming: Future[Glance]) -> SensorImage:
    return coming.result().picture


def _within(frame: Frame, function: Any, **options: Any) -> tuple[dict[str, Any], glance.Arrays]:
    """The function applied where the frame is decoded, which for some kinds of file is here."""
    apply = frame.within or partial(_here, frame)
    return apply(function, **options)


def _here(frame: Frame, function: Any, **options: Any) -> tuple[dict[str, Any], glance.Arrays]:
    meta, arrays = function(frame.load(), **options)
    return meta, arrays
