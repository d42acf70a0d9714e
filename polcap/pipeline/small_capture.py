"""A capture averaged down to at most 0.6 MP, and facts that averaging hides: clipping and sharpness."""

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
class SmallCapture:
    """A capture averaged down; its frames are decoded meanwhile, and waited for when they are used."""

    capture: Capture
    step: int  # visible RAW px per px
    merged_px: int  # visible RAW px per px of the picture that `process` merges
    seen: tuple[tuple[Future[Glance], ...], ...]  # (K, E)

    @cached_property
    def clipped(self) -> Floats:
        """(K, E, h, w) share of each pixel that is clipped."""
        return np.stack([[one.result().clipped for one in shot] for shot in self.seen])

    @cached_property
    def blur_px(self) -> Floats:
        """(K, E) of each frame beyond the sharpest of its exposure, 1σ [visible RAW px]."""
        return sharpness.frames_blur([[one.result().tiles for one in shot] for shot in self.seen], self.merged_px)


def reduce(capture: Capture, clip: float, pool: ThreadPoolExecutor) -> SmallCapture:
    """Decode every frame once, as many at a time as the pool has threads, and average it down where it is decoded.

    The reference frame comes first: it decides by how much to reduce, and where sharpness is measured. The others
    follow in the order in which they are merged. `clip` [white level]: counts from here on are clipped.

    Raises
    ------
    DecodeError
        Of the reference frame at once, of another one when it is used.
    """
    first = capture.shots[0].frames[(len(capture.shots[0].frames) - 1) // 2]
    meta, arrays = _within(first, glance.first, clip=clip, most_pixels=_MOST_PIXELS)
    times, half, corners = int(meta["times"]), int(meta["superpixel"]), arrays["corners"].tolist()
    decoded = Future[Glance]()
    decoded.set_result(glance.joined(meta, arrays))

    def begin(frame: Frame) -> Future[Glance]:
        return decoded if frame is first else pool.submit(_glance, frame, clip, times, corners)

    def smaller(frame: Frame, coming: Future[Glance]) -> Frame:
        return replace(frame, load=partial(_picture, coming), within=None)

    def shrunk(shot: Shot, coming: tuple[Future[Glance], ...]) -> Shot:
        ambient = tuple(smaller(frame, begin(frame)) for frame in shot.ambient)
        return replace(shot, frames=tuple(map(smaller, shot.frames, coming)), ambient=ambient)

    shots, seen = [], []
    for shot in (*capture.shots, *(() if capture.crossed is None else (capture.crossed,))):
        seen.append(tuple(map(begin, shot.frames)))
        shots.append(shrunk(shot, seen[-1]))
    count = len(capture.shots)
    step = half * times
    (x, y), (width, height) = capture.principal_px, capture.size_px
    small = replace(
        capture,
        shots=tuple(shots[:count]),
        crossed=None if capture.crossed is None else shots[-1],
        focal_px=capture.focal_px / step,
        principal_px=((x - (step - 1) / 2) / step, (y - (step - 1) / 2) / step),
        size_px=(width // step, height // step),
        calibration=capture.calibration and replace(capture.calibration, noise=()),  # of pixels, not of their means
    )
    return SmallCapture(small, step, half, tuple(seen[:count]))


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
