"""Decodes a frame of a capture: a RAW file, a finished picture, or one angle of a polarization sensor."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from polcap.formats.raw import libraw, photo, worker
from polcap.images import Frame, SensorImage


def decode(frame: Frame) -> SensorImage:
    """The pixels of a frame.

    Raises
    ------
    DecodeError
        The file is damaged, has changed since it was probed, or is in color where the sensor is monochrome.
    """
    path, digest, reading = Path(frame.path), _file_digest(frame), frame.reading
    if reading.sensor_deg is not None:
        return photo.read_mosaic(path, reading.sensor_deg, reading.white, reading.black, digest, reading.kind)
    if reading.kind == "raw":
        return libraw.read(path, digest)
    return photo.read(path, reading.encoding, reading.white, reading.black, digest)


def apply(frame: Frame, function: Callable[..., worker.Answer], **options: Any) -> worker.Answer:
    """`function(image, **options)` of a frame's pixels; of a RAW in the child process, which returns only the answer.

    The function is a module's, the options plain JSON values.

    Raises
    ------
    DecodeError
        As `decode`.
    """
    if frame.reading.kind == "raw" and frame.reading.sensor_deg is None:
        return libraw.within(frame.path, _file_digest(frame), function, **options)
    return function(decode(frame), **options)


def _file_digest(frame: Frame) -> str | None:
    return frame.digest.partition(" ")[0] or None
