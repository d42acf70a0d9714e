"""Reduces a capture to at most 0.6 MP for `polcap check`. Clipping and sharpness are measured at full size.

Frames are reduced in the decoding child process, which imports this module; only small arrays are sent back.
"""

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.capture_values import Capture, Frame, middle
from polcap.formats.raw import frame_decoder
from polcap.image_values import Floats, SensorImage
from polcap.optics import sensor, sharpness
from polcap.optics.projection import to_grid
from polcap.optics.resize import block_means

_MOST_PIXELS = 0.6e6  # of the pictures that the stages process
Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class ReducedFrame:
    """One reduced frame: picture, share of clipped pixels, tiles for the measurement of sharpness."""

    picture: SensorImage  # (h, w, 3) means of blocks, black 0, white 1; 1 for partly clipped blocks
    clipped: Floats  # (h, w) share of each block that is clipped
    tiles: sharpness.Tiles


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
        """Share of clipped RAW pixels in each reduced pixel, (K, E, h, w)."""
        return np.stack([[one.clipped for one in shot] for shot in self._shots()])

    @cached_property
    def blur_px(self) -> Floats:
        """Extra blur (K, E) of each frame relative to the sharpest of the same exposure, 1σ [visible RAW px]."""
        return sharpness.frames_blur([[one.tiles for one in shot] for shot in self._shots()], self.merged_px)

    def _shots(self) -> list[list[ReducedFrame]]:
        """The reduced frames, grouped as K shots of E frames."""
        return [[self.reduced[frame].result() for frame in shot.frames] for shot in self.capture.shots]


def reduce(capture: Capture, clip: float, pool: ThreadPoolExecutor) -> SmallCapture:
    """Start to decode and reduce every frame of a capture once, on the threads of the pool.

    The reference frame is first: it determines the reduction, and the tiles in which sharpness is measured. The others
    follow in the order of the merge. `clip` is as in `sensor.clip_count`.

    Raises DecodeError: of the reference frame immediately, of another frame when it is used.
    """
    first = middle(capture.shots[0].frames)
    meta, arrays = frame_decoder.apply(first, reduce_first, clip=clip, most_pixels=_MOST_PIXELS)
    times, merged_px, corners = int(meta["times"]), int(meta["superpixel"]), arrays["corners"].tolist()
    reduced = {first: pool.submit(_build_frame, meta, arrays)}
    for frame in (frame for shot in capture.all_shots for frame in (*shot.frames, *shot.ambient) if frame != first):
        reduced[frame] = pool.submit(_decode_reduced, frame, clip, times, corners)
    step = merged_px * times
    x, y = (to_grid(coordinate, step) for coordinate in capture.principal_px)
    width, height = (side // step for side in capture.size_px)
    small = replace(
        capture,
        focal_px=capture.focal_px / step,
        principal_px=(x, y),
        size_px=(width, height),
        calibration=capture.calibration and replace(capture.calibration, noise=()),  # noise of pixels, not of means
    )
    return SmallCapture(small, step, merged_px, reduced)


def _decode_reduced(frame: Frame, clip: float, times: int, corners: list[list[int]]) -> ReducedFrame:
    """Decode and reduce a frame in the child process."""
    return _build_frame(*frame_decoder.apply(frame, reduce_frame, clip=clip, times=times, corners=corners))


def _build_frame(meta: dict[str, Any], arrays: Arrays) -> ReducedFrame:
    """Build a `ReducedFrame` from the answer of the child process."""
    picture = SensorImage(
        value=arrays["value"],
        black=np.zeros((1, 1)),
        white=1.0,
        cfa=None,
        camera_matrix=arrays.get("camera_matrix"),
        white_balance=arrays.get("white_balance"),
        lossy=meta["lossy"],
    )
    return ReducedFrame(picture, arrays["clipped"], sharpness.Tiles(arrays["light"], arrays["usable"]))


def reduce_first(image: SensorImage, clip: float, most_pixels: float) -> tuple[dict[str, Any], Arrays]:
    """In the child process: reduce the reference frame, and choose the reduction for the whole capture.

    The choice is added to the answer of `reduce_frame`: `times`, the number of merged pixels along a block;
    `superpixel`, the number of RAW pixels along a merged pixel; `corners` (T, 2) px of the tiles.
    """
    pixels = (image.value.shape[0] // image.superpixel) * (image.value.shape[1] // image.superpixel)
    times = max(1, int(np.ceil(np.sqrt(pixels / most_pixels))))
    corners = sharpness.places(image, clip)
    meta, arrays = reduce_frame(image, clip, times, corners.tolist())
    return {**meta, "times": times, "superpixel": image.superpixel}, {**arrays, "corners": corners}


def reduce_frame(
    image: SensorImage, clip: float, times: int, corners: list[list[int]]
) -> tuple[dict[str, Any], Arrays]:
    """In the child process: reduce a frame to means over blocks of `times` × `times` merged pixels.

    The tiles at `corners` (T, 2) px are returned at full size.
    """
    clipped = block_means(~sensor.usable(image, clip), times)
    value = _means(image, times)
    value[clipped > 0] = 1  # so that the stages exclude partly clipped pixels
    tiles = sharpness.take(image, np.asarray(corners, np.int64).reshape(-1, 2), clip)
    arrays: Arrays = {"value": value, "clipped": clipped, "light": tiles.light, "usable": tiles.usable}
    for name in ("camera_matrix", "white_balance"):
        if getattr(image, name) is not None:
            arrays[name] = getattr(image, name)
    return {"lossy": image.lossy}, arrays


def _means(image: SensorImage, times: int) -> Floats:
    """Mean signal (h, w, 3) of a frame over blocks of times × times merged pixels."""
    if image.cfa is None or image.cfa.shape != (2, 2):
        signal = sensor.signal(image)
        return block_means(np.repeat(signal, 3, axis=2) if signal.shape[2] == 1 else signal, times)
    height, width = (side // (2 * times) for side in image.value.shape)
    black = np.broadcast_to(image.black, (2, 2))
    means = np.zeros((height, width, 3), np.float32)
    for i, j in np.ndindex(2, 2):  # averaged in one step, without the merged picture
        plane = image.value[i : 2 * times * height : 2, j : 2 * times * width : 2].astype(np.float32)
        color = image.cfa[i, j]
        means[..., color] += (block_means(plane, times) - black[i, j]) / (image.cfa == color).sum()
    return means / np.float32(image.white - float(image.black.mean()))
