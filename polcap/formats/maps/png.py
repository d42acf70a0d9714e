"""Reads and writes PNG files of 8 or 16 bits.

Colors have the chunk sRGB. Data have no chunk of color, so that no program converts them; maps.json or the material
states the meaning of the numbers.
"""

import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polcap.errors import StorageError
from polcap.formats import atomic, sandbox
from polcap.formats.raw import file_kind, photo
from polcap.image_values import Floats

Pixels = NDArray[np.uint8] | NDArray[np.uint16]
_LEVEL = 2  # of compression; 4 is a third slower, 1 to 4 % smaller
_SWAPS = {3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}  # seven times faster than NumPy's indexing
_HEADER = 33  # bytes of the signature and IHDR, which comes first


def write(path: Path, array: Pixels, srgb: bool = False) -> None:
    """Write a uint8 or uint16 image (H, W), (H, W, 3) RGB or (H, W, 4) RGBA as PNG; same array, same bytes."""
    atomic.write(path, encode(array, srgb))


def encode(array: Pixels, srgb: bool = False) -> bytes:
    """Encode an image (H, W[, C]), uint8 or uint16, as the bytes of a PNG; `srgb` states that it is sRGB color.

    Raises TypeError: the values are neither uint8 nor uint16. StorageError: OpenCV cannot encode them.
    """
    if array.dtype not in (np.uint8, np.uint16):
        raise TypeError(f"PNG holds uint8 or uint16, not {array.dtype}")
    done, data = cv2.imencode(".png", swapped(array), [cv2.IMWRITE_PNG_COMPRESSION, _LEVEL])
    if not done:
        raise StorageError(f"cannot encode a picture of {array.shape} as PNG; report this as a bug")
    coded = bytes(data)
    return b"".join([coded[:_HEADER], _SRGB, coded[_HEADER:]]) if srgb else coded


def described(data: bytes, text: Mapping[str, str]) -> bytes:
    """Add texts to the bytes of a PNG: a chunk per keyword of `text`, tEXt for ASCII and iTXt (UTF-8) for others."""
    chunks = [
        _chunk(b"tEXt", f"{key}\0{value}".encode())
        if value.isascii()
        else _chunk(b"iTXt", f"{key}\0\0\0\0\0{value}".encode())
        for key, value in text.items()
    ]
    return b"".join([data[:_HEADER], *chunks, data[_HEADER:]])


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


_SRGB = _chunk(b"sRGB", b"\1")  # relative colorimetric


def indexed(level: NDArray[np.uint8], colors: NDArray[np.uint8]) -> bytes:
    """The bytes of a palette PNG of levels (H, W): level 0 is transparent, level k has color k − 1 of (N, 3).

    References
    ----------
    W3C, Portable Network Graphics (3rd ed.), §11.2 (chunks IHDR, PLTE, IDAT, IEND) and §11.3.1.1 (tRNS).
    """
    height, width = level.shape
    rows = np.zeros((height, width + 1), np.uint8)  # filter 0 before every row
    rows[:, 1:] = level
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 3, 0, 0, 0)),
        (b"PLTE", bytes(3) + colors.astype(np.uint8).tobytes()),
        (b"tRNS", b"\0"),
        (b"IDAT", zlib.compress(rows.tobytes(), 6)),
        (b"IEND", b""),
    ]
    return file_kind.PNG + b"".join(_chunk(kind, data) for kind, data in chunks)


def read(path: Path) -> Pixels:
    """Read a PNG as an array (H, W) or (H, W, C), channels in RGB(A) order. Raises DecodeError."""
    return sandbox.call(decode, path)[1]["pixels"]


def decode(path: str) -> sandbox.Answer:
    """Read a PNG in the child process; result and DecodeError as for `read`."""
    _, pixels = photo.stored_channels(path, file_kind.PNG, "a PNG")
    return {}, {"pixels": pixels[..., 0] if pixels.shape[2] < 3 else pixels}  # grey, its alpha left out


def sixteen_bits(value: Floats) -> NDArray[np.uint16]:
    """Convert values 0…1 (any shape) to integers 0…65535; values outside are clipped."""
    return np.asarray(np.rint(np.clip(np.asarray(value, dtype=np.float64), 0.0, 1.0) * 65535), dtype=np.uint16)


def swapped(array: Any) -> Any:
    """Swap the channels RGB(A) ↔ BGR(A); returns a contiguous copy. A grey picture (H, W) is returned unchanged."""
    if array.ndim == 2 or array.shape[-1] not in _SWAPS:
        return np.ascontiguousarray(array)
    return cv2.cvtColor(np.ascontiguousarray(array), _SWAPS[array.shape[-1]])
