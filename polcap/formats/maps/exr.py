"""Reads and writes OpenEXR files of named channels, lossless, by OpenImageIO."""

from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np

from polcap.errors import StorageError
from polcap.formats import atomic, sandbox
from polcap.formats.raw import file_kind, photo
from polcap.image_values import Floats

Attribute = str | int | float | tuple[float, ...]


def write(
    path: Path,
    channels: Mapping[str, Floats],
    attributes: Mapping[str, Attribute] | None = None,
    *,
    half: bool | Collection[str] = False,
) -> None:
    """Write named channels (H, W) ("R", "normal.x", "S0.R") as an EXR, ZIP-compressed; same input, same bytes.

    `half` makes all channels, or those named, 16 bits instead of 32; values beyond the range of half are clipped to it.
    Raises StorageError.
    """
    import OpenImageIO as oiio

    names = list(channels)
    pixels = np.stack([np.asarray(channels[name], dtype=np.float32) for name in names], axis=-1)
    is_half = [half if isinstance(half, bool) else name in half for name in names]
    if any(is_half):
        limit = np.where(is_half, np.float32(np.finfo(np.float16).max), np.float32(np.inf))
        pixels = np.clip(pixels, -limit, limit)  # NaN stays
    height, width, count = pixels.shape
    spec = oiio.ImageSpec(width, height, count, oiio.HALF if all(is_half) else oiio.FLOAT)
    spec.channelnames = names
    if any(is_half) and not all(is_half):
        spec.channelformats = tuple(oiio.TypeDesc("half" if one else "float") for one in is_half)
    spec.attribute("compression", "zip:1")  # level 4: a quarter slower, 0.5 % smaller
    spec.attribute("DateTime", "")  # else the time of writing is stored, and no two files are equal
    for key, value in (attributes or {}).items():
        if isinstance(value, tuple):
            spec.attribute(key, oiio.TypeDesc(f"float[{len(value)}]"), value)
        else:
            spec.attribute(key, value)
    with atomic.path(path) as temporary:
        output = oiio.ImageOutput.create(str(temporary))
        if output is None:
            raise StorageError(f"cannot write {path}: {photo.reason(oiio)}; end its name in .exr")
        done = output.open(str(temporary), spec) and output.write_image(pixels)
        if not (output.close() and done):
            raise StorageError(f"cannot write {path}: {photo.reason(output)}; check the disk's free space")


def described(texts: Mapping[str, str]) -> dict[str, Attribute]:
    """Attributes of a header for texts by key; a copyright notice (`rights`) is also OpenEXR's `owner`."""
    copyright_ = {"Copyright": texts["rights"]} if texts.get("rights") else {}
    return {**{f"polcap:{key}": text for key, text in texts.items()}, **copyright_}


def read(path: Path) -> dict[str, Floats]:
    """Read the channels of an EXR by name, each (H, W) float32. Raises DecodeError."""
    return sandbox.call(decode, path)[1]


def decode(path: str) -> sandbox.Answer:
    """Read an EXR in the child process; result and DecodeError as for `read`."""
    names, pixels = photo.stored_channels(path, file_kind.EXR, "an OpenEXR file")
    return {}, {name: pixels[..., k] for k, name in enumerate(names)}
