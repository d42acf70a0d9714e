"""Light that is there without the flash, from frames taken without it."""

from dataclasses import dataclass

import cv2
import numpy as np

from polcap.errors import CaptureError
from polcap.images import Bits, Floats, Frame, Shot
from polcap.optics import demosaic, sensor
from polcap.stages.hdr import noise
from polcap.stages.hdr.planes import Reader, planar, signals


@dataclass(frozen=True)
class Ambient:
    """At the settings of the reference frame."""

    value: Floats  # (C, H, W)
    variance: Floats  # (C, H, W)


def promised(frame: Frame, reference: Frame) -> float:
    """Exposure relative to the reference frame as the settings promise; NaN if unknown."""
    a, b = frame.exif.relative_exposure, reference.exif.relative_exposure
    return a / b if a and b else float("nan")


def gathered(frame: Frame, reference: Frame) -> float:
    """How much more ambient light a frame gathers than the reference frame; 1 if the metadata are silent."""
    settings = promised(frame, reference)
    return settings if np.isfinite(settings) else 1.0


def measure(shot: Shot, reference: Frame, lines: noise.Lines, read: Reader, full: bool, clip: float) -> Ambient | None:
    """The mean of a shot's ambient frames; None where it has none.

    Parameters
    ----------
    shot
        Its ambient frames are averaged.
    reference
        The frame at whose settings the answer stands.
    lines
        Noise by ISO; learns that of these frames.
    read
        Decodes a frame.
    full
        Interpolate the mosaic instead of binning it.
    clip
        As in the stage's settings [white level].

    Raises
    ------
    CaptureError
        The frames are of unlike size.
    """
    if not shot.ambient:
        return None
    value: Floats | None = None
    share = [gathered(frame, reference) for frame in shot.ambient]
    for frame in shot.ambient:
        part = planar(sensor.signal(read(frame), full))
        if value is not None:
            same_size(f"an ambient frame of shot {shot.name}", part.shape, value.shape)
        value = part if value is None else value + part
    assert value is not None
    value /= np.float32(sum(share))
    variance = np.zeros_like(value)
    for frame, one in zip(shot.ambient, share):
        image = read(frame)
        key = frame.exif.iso or "ambient"
        if not lines.knows(key):
            lines.learn(key, noise.alone(signals(image, clip)))
        line = lines.line(key, sensor.rounding(image) / 2)
        level = np.stack([cv2.blur(plane, (5, 5)) for plane in value]) * np.float32(one)
        variance += noise_of(level, line, image.cfa if full else None) / np.float32(sum(share) ** 2)
    return Ambient(value, variance)


def share(ambient: Ambient, flash: Floats) -> float:
    """Of all light in the brighter half of the picture, what the flash (C, H, W) did not bring."""
    without, lit = (picture[:, ::4, ::4].sum(0) for picture in (ambient.value, flash))
    bright = lit + without >= np.median(lit + without)
    return float(without[bright].sum() / max(float((lit + without)[bright].sum()), 1e-9))


def noise_of(light: Floats, line: noise.Noise, cfa: Bits | None) -> Floats:
    """Noise of pixels of known expected signal (C, h, w); cfa where they were interpolated from it, not binned."""
    expected = np.empty_like(light)
    for c, plane in enumerate(light):
        line.of(c, plane, expected[c])
    if cfa is None:
        return expected
    expected[1] *= 2  # binned green is the mean of two photosites
    gain = demosaic.variance_gain(cfa)
    for i, j in np.ndindex(2, 2):
        expected[:, i::2, j::2] = np.tensordot(gain[i, j], expected[:, i::2, j::2], axes=1)
    return expected


def same_size(name: str, shape: tuple[int, ...], expected: tuple[int, ...]) -> None:
    """Raises CaptureError where two frames (C, H, W) do not fit together."""
    if shape != expected:
        a, b = (f"{s[2]}×{s[1]}×{s[0]}" for s in (shape, expected))
        raise CaptureError(f"{name} is {a}, the frames before it {b} [px, px, channels]: use one camera")
