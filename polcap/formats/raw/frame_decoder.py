"""Decodes a frame of a capture: a RAW file, a finished picture, or one angle of a polarization sensor."""

import importlib
from collections.abc import Callable
from typing import Any

from polcap.capture_values import Frame
from polcap.formats import sandbox
from polcap.formats.raw import libraw, photo
from polcap.image_values import SensorImage


def decode(frame: Frame) -> SensorImage:
    """Decode the pixels of one photograph of a capture. Raises DecodeError: it is damaged, or has changed since."""
    path, digest, reading = frame.path, _file_digest(frame), frame.reading
    if reading.cell is not None:
        return photo.read_mosaic(path, reading.cell, reading, digest)
    if reading.kind == "raw":
        return libraw.read(path, digest)
    return photo.read(path, reading, digest)


def apply(frame: Frame, function: Callable[..., sandbox.Answer], **options: Any) -> sandbox.Answer:
    """Decode a photograph and return `function(image, **options)`; for a RAW all of it runs in the child process.

    So only the result is sent back. The function must be at the top level of a module, the options plain JSON values.
    Raises DecodeError as `decode` does.
    """
    if frame.reading.kind != "raw" or frame.reading.cell is not None:
        return function(decode(frame), **options)
    digest, module, name = _file_digest(frame), function.__module__, function.__name__
    return sandbox.call(apply_to_raw, frame.path, digest=digest, module=module, name=name, options=options)


def apply_to_raw(path: str, digest: str | None, module: str, name: str, options: dict[str, Any]) -> sandbox.Answer:
    """In the child process: decode a RAW and evaluate the function `name` of `module` on it."""
    function: Callable[..., sandbox.Answer] = getattr(importlib.import_module(module), name)
    return function(libraw.image(*libraw.decode(path, digest)), **options)


def _file_digest(frame: Frame) -> str | None:
    return frame.digest.partition(" ")[0] or None
