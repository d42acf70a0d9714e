"""A capture in, the same of at most 0.6 MP out, with what the averaging would hide: clipping and sharpness."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.images import Capture, Floats, Frame, SensorImage
from polcap.optics import sensor, sharpness

_MOST_PIXELS = 0.6e6  # of the pictures that the stages see: they take three to four seconds on two cores


@dataclass(frozen=True)
class Taken:
    """A capture averaged down, and what the averaging would hide."""

    capture: Capture  # loads from memory
    step: int  # visible RAW px per px
    clipped: Floats  # (K, E, h, w) share of each pixel that is clipped
    blur_px: Floats  # (K, E) of each frame beyond the sharpest of its exposure, 1σ [visible RAW px]
    binned: int  # visible RAW px per px of the picture that `process` merges


def take(capture: Capture, clip: float) -> Taken:
    """Every frame decoded once, two at a time; the reference frame says how far to reduce and where to look."""
    frames = [frame for shot in capture.shots for frame in (*shot.frames, *shot.ambient)]
    first = capture.shots[0].frames[(len(capture.shots[0].frames) - 1) // 2]

    def looked_over() -> tuple[SensorImage, NDArray[np.int64], int]:
        image = first.load()
        usable = sensor.usable(image, clip)
        times = max(1, int(np.ceil(np.sqrt(usable.size / _MOST_PIXELS))))
        return image, sharpness.places(image, clip), times

    with ThreadPoolExecutor(2) as pool:
        reference = pool.submit(looked_over)  # before all others, which wait for it

        def seen(frame: Frame) -> tuple[SensorImage, Floats, sharpness.Tiles]:
            loaded = None if frame is first else frame.load()
            image, corners, times = reference.result()
            whole = loaded or image
            signal = sensor.signal(whole)
            signal = np.repeat(signal, 3, axis=2) if signal.shape[2] == 1 else signal
            usable = sensor.usable(whole, clip)
            shares = _averaged((~usable).astype(np.float32), times)
            value = _averaged(signal, times)
            value[shares > 0] = 1  # the stages drop a pixel of which a part is clipped
            small = SensorImage(
                value, np.zeros((1, 1)), 1.0, None, whole.camera_matrix, whole.white_balance, whole.lossy
            )
            return small, shares, sharpness.take(whole, corners, clip)

        found = dict(zip(map(id, frames), pool.map(seen, frames)))
    image, _, times = reference.result()
    half = image.superpixel

    def smaller(frame: Frame) -> Frame:
        small = found[id(frame)][0]
        return replace(frame, load=lambda: small)

    step = half * times
    (x, y), (width, height) = capture.principal_px, capture.size_px
    return Taken(
        capture=replace(
            capture,
            shots=tuple(
                replace(s, frames=tuple(map(smaller, s.frames)), ambient=tuple(map(smaller, s.ambient)))
                for s in capture.shots
            ),
            focal_px=capture.focal_px / step,
            principal_px=((x - (step - 1) / 2) / step, (y - (step - 1) / 2) / step),
            size_px=(width // step, height // step),
            calibration=capture.calibration and replace(capture.calibration, noise=()),  # of pixels, not of their means
        ),
        step=step,
        clipped=np.stack([[found[id(frame)][1] for frame in shot.frames] for shot in capture.shots]),
        blur_px=sharpness.frames_blur([[found[id(f)][2] for f in shot.frames] for shot in capture.shots], half),
        binned=half,
    )


def _averaged(picture: Floats, times: int) -> Floats:
    """Means of times × times pixels; an incomplete last block is dropped."""
    height, width = picture.shape[0] // times, picture.shape[1] // times
    whole = picture[: height * times, : width * times]
    return np.array(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.float32)
