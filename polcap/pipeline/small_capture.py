"""Reduces a capture to at most 0.6 MP for `polcap check`, and measures clipping and sharpness at full size."""

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from polcap.formats.raw import frame_decoder
from polcap.images import Capture, Floats, Frame, SensorImage
from polcap.optics import sharpness
from polcap.pipeline import reduced_frame
from polcap.pipeline.reduced_frame import ReducedFrame

_MOST_PIXELS = 0.6e6  # of the pictures that the stages process


@dataclass(frozen=True)
class SmallCapture:
    """A capture averaged down; frames are decoded in the background, and waited for when they are used."""

    capture: Capture
    step: int  # visible RAW px per px of this capture
    merged_px: int  # visible RAW px per px of the merged picture of `process`
    reduced: Mapping[Frame, Future[ReducedFrame]]

    def decode(self, frame: Frame) -> SensorImage:
        """The reduced picture of a frame; raises DecodeError."""
        return self.reduced[frame].result().picture

    @cached_property
    def clipped(self) -> Floats:
        """(K, E, h, w) share of each pixel that is clipped."""
        return np.stack([[one.clipped for one in shot] for shot in self._shots()])

    @cached_property
    def blur_px(self) -> Floats:
        """(K, E) extra blur of each frame against the sharpest of its exposure, 1σ [visible RAW px]."""
        return sharpness.frames_blur([[one.tiles for one in shot] for shot in self._shots()], self.merged_px)

    def _shots(self) -> list[list[ReducedFrame]]:
        """The capture's frames as K shots of E frames."""
        return [[self.reduced[frame].result() for frame in shot.frames] for shot in self.capture.shots]


def reduce(capture: Capture, clip: float, pool: ThreadPoolExecutor) -> SmallCapture:
    """Decode every frame once, on the threads of the pool, and average it down in the decoding process.

    The reference frame is first: it determines the reduction, and the tiles in which sharpness is measured. The others
    follow in the order of the merge. Counts from `clip` [white level] on are clipped.

    Raises
    ------
    DecodeError
        Of the reference frame immediately, of another frame when it is used.
    """
    first = capture.shots[0].frames[(len(capture.shots[0].frames) - 1) // 2]
    meta, arrays = frame_decoder.apply(first, reduced_frame.first, clip=clip, most_pixels=_MOST_PIXELS)
    times, half, corners = int(meta["times"]), int(meta["superpixel"]), arrays["corners"].tolist()
    decoded = Future[ReducedFrame]()
    decoded.set_result(reduced_frame.joined(meta, arrays))

    def begin(frame: Frame) -> Future[ReducedFrame]:
        return decoded if frame == first else pool.submit(_reduced, frame, clip, times, corners)

    every = [frame for shot in capture.all_shots for frame in (*shot.frames, *shot.ambient)]
    step = half * times
    (x, y), (width, height) = capture.principal_px, capture.size_px
    small = replace(
        capture,
        focal_px=capture.focal_px / step,
        principal_px=((x - (step - 1) / 2) / step, (y - (step - 1) / 2) / step),
        size_px=(width // step, height // step),
        calibration=capture.calibration
        and replace(capture.calibration, noise=()),  # it holds for pixels, not for means
    )
    return SmallCapture(small, step, half, {frame: begin(frame) for frame in every})


def _reduced(frame: Frame, clip: float, times: int, corners: list[list[int]]) -> ReducedFrame:
    parts = frame_decoder.apply(frame, reduced_frame.take, clip=clip, times=times, corners=corners)
    return reduced_frame.joined(*parts)
