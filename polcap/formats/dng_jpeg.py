"""In: a DNG whose mosaic is lossless JPEG. Out: its counts by libjpeg-turbo, and the rest of the file for LibRaw.

LibRaw takes three times as long for the same counts. So where imagecodecs is installed (extra `[fast]`), JPEG data of
the forms that both read alike are decoded here, and LibRaw is given the file without them: levels, colors and margins
are its reading either way. Whatever else stands in the file, or fails here, is LibRaw's alone. In the worker.
"""

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polcap.formats import plausible, sniff

_LOSSLESS, _LOSSLESS_HUFFMAN, _SCAN = 7, 0xC3, 0xDA  # compression of the TIFF; frame and scan of the JPEG
_BEFORE = {0xC4, 0xDD, 0xFE, *range(0xE0, 0xF0)}  # of a scan: Huffman tables, restart interval, comment, applications
_ONE_TO_ONE = 0x11  # sampling of a component
_SINCE = (1, 1)  # DNG version; before it a difference of 16 bits was coded in another way
_MOST_HEADER = 64  # segments before the scan
_PAST_END = 32 * b"\xff\0"  # ones, which are no code: who reads on behind a scan's end decodes differences of 0

Counts = NDArray[np.uint16]


@dataclass(frozen=True)
class Window:
    """One JPEG of the mosaic."""

    offset: int  # bytes from the beginning of the file
    length: int  # bytes
    top: int  # px
    left: int  # px
    height: int  # px, of a tile with what reaches beyond the picture
    width: int  # px


@dataclass(frozen=True)
class _Scan:
    """What the head of a JPEG says."""

    start: int  # bytes from the beginning of the file to the coded differences
    bits: int
    components: int


def counts(structure: sniff.Tiff, data: bytes) -> Counts | None:
    """The mosaic (H, W) with its masked border; None where LibRaw has to decode it.

    Parameters
    ----------
    structure
        Of the file; its strips and tiles lie within it.
    data
        All bytes of the file.
    """
    image = _sensor(structure)
    windows = [] if image is None else _windows(image)
    scans = [_scan(data, window) for window in windows]
    if image is None or not scans:
        return None
    mosaic: Counts = np.zeros((sniff.first(image, sniff.LENGTH), sniff.first(image, sniff.WIDTH)), np.uint16)
    for window, scan in zip(windows, scans):
        part = None if scan is None else _decoded(data, window, scan)
        if scan is None or part is None:
            return None
        room = mosaic[window.top : window.top + window.height, window.left : window.left + window.width]
        if room.shape == part.shape and part.flat[-1] == part.flat[-1 - scan.components]:
            return None  # the scan was too short, which LibRaw tells; or the corner is even
        if len(windows) == 1:
            return part
        room[:] = part[: room.shape[0], : room.shape[1]]
    return mosaic


def hollow(structure: sniff.Tiff, data: bytes) -> bytes:
    """The file without the beginning of its first JPEG: LibRaw reads what it states, and ends before its counts."""
    image = _sensor(structure)
    assert image is not None
    start = _windows(image)[0].offset
    return data[:start] + b"\0\0" + data[start + 2 :]


def _decoded(data: bytes, window: Window, scan: _Scan) -> Counts | None:
    """Counts (h, w) of a window; None where they are damaged, or may be."""
    try:
        from imagecodecs import Jpeg8Error, jpeg8_decode
    except ImportError:
        return None
    end = plausible.end_of_scan(data, scan.start)
    if data[end : end + 2] != b"\xff\xd9" or end + 2 > window.offset + window.length:
        return None
    try:
        part = jpeg8_decode(data[window.offset : end] + _PAST_END + b"\xff\xd9")
    except Jpeg8Error:
        return None
    if part.dtype != np.uint16 or part.size != window.height * window.width or int(part.max()) >> scan.bits:
        return None
    decoded: Counts = part.reshape(window.height, window.width)
    return decoded


def _sensor(structure: sniff.Tiff) -> sniff.Directory | None:
    """The directory of the mosaic, where nothing in it changes what the JPEG's counts are."""
    images = [one for one in structure.directories if sniff.first(one, sniff.PHOTOMETRIC) == sniff.CFA]
    raws = [one for one in structure.directories if sniff.first(one, sniff.PHOTOMETRIC) == sniff.LINEAR_RAW]
    if len(images) != 1 or raws:
        return None
    (image,) = images
    version = max(one.get(sniff.DNG_VERSION, ()) for one in structure.directories)
    plain = (
        version[:2] >= _SINCE
        and sniff.first(image, sniff.COMPRESSION) == _LOSSLESS
        and sniff.first(image, sniff.SAMPLES, 1) == 1
        and sniff.LINEARIZATION not in image
        and sniff.MASKED_AREAS not in image  # LibRaw takes the black level from their counts
    )
    return image if plain else None


def _windows(image: sniff.Directory) -> list[Window]:
    """Where the JPEGs of a mosaic go: tiles, or one strip; none where they are laid out in another way."""
    height, width = sniff.first(image, sniff.LENGTH), sniff.first(image, sniff.WIDTH)
    tall, wide = sniff.first(image, sniff.TILE_LENGTH), sniff.first(image, sniff.TILE_WIDTH)
    pieces = sniff.strips(image)
    if not tall or not wide:
        return [Window(*pieces[0], 0, 0, height, width)] if len(pieces) == 1 and height and width else []
    if tall > height or wide > width or 2 * wide == width:  # LibRaw folds rows of wider tiles, and takes two for one
        return []
    if not pieces or -(-height // tall) * -(-width // wide) != len(pieces):
        return []
    corners = [(y, x) for y in range(0, height, tall) for x in range(0, width, wide)]
    return [Window(*piece, *corner, tall, wide) for piece, corner in zip(pieces, corners)]


def _scan(data: bytes, window: Window) -> _Scan | None:
    """Of a lossless JPEG that holds the pixels of a window, each predicted by the one on its left; None of any other.

    References
    ----------
    ITU-T T.81, annexes B and H.
    """
    at, end = window.offset + 2, window.offset + window.length
    if data[window.offset : at] != b"\xff\xd8":
        return None
    bits = components = 0
    for _ in range(_MOST_HEADER):
        if at + 4 > end:
            return None
        mark, marker, length = struct.unpack_from(">BBH", data, at)
        body = data[at + 4 : min(at + 2 + length, end)]
        at += 2 + length
        if mark != 0xFF or length < 2:
            return None
        if marker == _LOSSLESS_HUFFMAN and not bits and len(body) >= 6:
            bits, height, width, components = struct.unpack_from(">BHHB", body)
            if components not in (1, 2) or set(body[7 : 6 + 3 * components : 3]) != {_ONE_TO_ONE}:
                return None
            if not 8 < bits <= 16 or components * height * width != window.height * window.width:
                return None
        elif marker == _SCAN:
            left = len(body) == 4 + 2 * components and body[0] == components and body[-3:] == b"\1\0\0"
            return _Scan(at, bits, components) if bits and left else None
        elif marker not in _BEFORE:
            return None
    return None
