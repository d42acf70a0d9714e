"""Writes a Bayer or X-Trans mosaic as a DNG, uncompressed or in lossless JPEG: a little-endian TIFF.

References
----------
Adobe, Digital Negative Specification 1.4. ITU-T T.81 (JPEG), annexes C and H.
"""

import heapq
import struct
from collections.abc import Sequence
from datetime import datetime
from fractions import Fraction
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from polcap.formats import atomic
from polcap.images import Bits, Exif, Floats

_BYTE, _ASCII, _SHORT, _LONG, _RATIONAL, _UNDEFINED, _SRATIONAL = 1, 2, 3, 4, 5, 7, 10
_CODE = {_SHORT: "H", _LONG: "I", _RATIONAL: "II", _SRATIONAL: "ii"}
_D65, _CENTIMETRE = 21, 3
_Entry = tuple[int, int, Any]  # tag, type, value or values


def write(
    path: Path,
    mosaic: NDArray[np.uint16],
    *,
    cfa: Bits,
    black: ArrayLike,
    white: float,
    exif: Exif,
    color_matrix: Floats,
    as_shot_neutral: Floats,
    compression: Literal["ljpeg", "none"] = "ljpeg",
) -> None:
    """Write a mosaic (H, W) of even sides bit for bit; on a failure there is no file.

    The many parameters are the facts that a DNG has to state.

    cfa : (2, 2) or (6, 6) of 0 R, 1 G, 2 B. black : counts, one or (2, 2). white : counts.
    color_matrix : (3, 3) XYZ under D65 → camera. as_shot_neutral : (3,) camera values of a grey.
    exif : fields that are None are left out; its width, height and color_matrix are not used.

    Raises
    ------
    ValueError
        The mosaic is not uint16, or its sides are odd.
    StorageError
        The file cannot be written.
    """
    height, width = mosaic.shape
    if mosaic.dtype != np.uint16 or height % 2 or width % 2:
        raise ValueError(f"a DNG mosaic is uint16 with even sides, not {mosaic.dtype} {width}×{height}")
    image = lossless_jpeg(mosaic) if compression == "ljpeg" else mosaic.astype("<u2").tobytes()
    main = [
        *_layout_tags(width, height, len(image), compression),
        *_camera_tags(exif),
        (33421, _SHORT, np.shape(cfa)),
        (33422, _BYTE, bytes(np.asarray(cfa, np.uint8).ravel())),
        (50714, _RATIONAL, np.broadcast_to(black, (2, 2)).ravel()),
        (50717, _LONG, int(white)),
        (50721, _SRATIONAL, np.asarray(color_matrix).ravel()),
        (50728, _RATIONAL, as_shot_neutral),
        (50778, _SHORT, _D65),
    ]
    start = 8 + len(_ifd(main, 8))
    exif_ifd = _ifd(_exif_tags(exif), start)
    offsets = {34665: start, 273: start + len(exif_ifd)}
    main = [(tag, kind, offsets.get(tag, value)) for tag, kind, value in main]
    with atomic.path(path) as temporary:
        temporary.write_bytes(b"II*\0" + struct.pack("<I", 8) + _ifd(main, 8) + exif_ifd + image)


def _layout_tags(width: int, height: int, length: int, compression: str) -> list[_Entry]:
    """One strip of `length` bytes, 16 bits per pixel, the whole of it visible."""
    return [
        (254, _LONG, 0),  # the full image
        (256, _LONG, width),
        (257, _LONG, height),
        (258, _SHORT, 16),
        (259, _SHORT, 7 if compression == "ljpeg" else 1),
        (262, _SHORT, 32803),  # color filter array
        (273, _LONG, 0),  # strip offset, set by the caller
        (274, _SHORT, 1),
        (277, _SHORT, 1),
        (278, _LONG, height),
        (279, _LONG, length),
        (284, _SHORT, 1),
        (34665, _LONG, 0),  # offset of the Exif directory, set by the caller
        (50706, _BYTE, bytes((1, 4, 0, 0))),
        (50707, _BYTE, bytes((1, 1, 0, 0))),
        (50710, _BYTE, bytes((0, 1, 2))),
        (50711, _SHORT, 1),
        (50713, _SHORT, (2, 2)),
        (50718, _RATIONAL, (1, 1)),
        (50719, _LONG, (0, 0)),
        (50720, _LONG, (width, height)),
    ]


def _camera_tags(exif: Exif) -> list[_Entry]:
    return [
        (271, _ASCII, exif.make),
        (272, _ASCII, exif.model),
        (305, _ASCII, "polcap"),
        (306, _ASCII, _stamp(exif, "%Y:%m:%d %H:%M:%S")),
        (50708, _ASCII, f"{exif.make} {exif.model}".strip() or "unknown"),
    ]


def _exif_tags(exif: Exif) -> list[_Entry]:
    pitch = exif.pixel_pitch_um
    return [
        (33434, _RATIONAL, exif.exposure_time),
        (33437, _RATIONAL, exif.f_number),
        (34855, _SHORT, exif.iso and round(exif.iso)),
        (36864, _UNDEFINED, b"0231"),
        (36867, _ASCII, _stamp(exif, "%Y:%m:%d %H:%M:%S")),
        (37385, _SHORT, exif.flash_fired if exif.flash_fired is None else int(exif.flash_fired)),
        (37386, _RATIONAL, exif.focal_length_mm),
        (37521, _ASCII, (_stamp(exif, "%f") or "")[:3] or None),
        (41486, _RATIONAL, pitch and 1e4 / pitch),
        (41487, _RATIONAL, pitch and 1e4 / pitch),
        (41488, _SHORT, pitch and _CENTIMETRE),
        (41989, _SHORT, exif.focal_length_35mm and round(exif.focal_length_35mm)),
        (42036, _ASCII, exif.lens),
    ]


def _stamp(exif: Exif, form: str) -> str | None:
    return datetime.fromisoformat(exif.taken).strftime(form) if exif.taken else None


def lossless_jpeg(mosaic: NDArray[np.uint16]) -> bytes:
    """A mosaic (H, W), W even, as a lossless JPEG of two components, one per column of the CFA.

    Predictor 1 (the pixel on the left; in the first column the one above); one optimal Huffman table.
    """
    height, width = mosaic.shape
    pairs = mosaic.reshape(height, width // 2, 2).astype(np.int32)
    predicted = np.empty_like(pairs)
    predicted[:, 1:] = pairs[:, :-1]
    predicted[1:, 0] = pairs[:-1, 0]
    predicted[0, 0] = 1 << 15
    difference = ((pairs - predicted + 32768) % 65536 - 32768).ravel()  # modulo 2¹⁶, T.81 H.1.2.1
    size = np.frexp(np.abs(difference).astype(np.float64))[1]  # bits of |difference|: 0…16
    difference = np.where(difference == -32768, 32768, difference)
    lengths = _huffman_lengths(np.bincount(size, minlength=17))
    symbols = sorted(np.flatnonzero(lengths).tolist(), key=lambda s: (lengths[s], s))
    code, counts = _canonical(lengths, symbols)

    extra = np.where(size == 16, 0, size)  # 32768 needs no bits of its own
    low = np.where(difference < 0, difference + (1 << extra) - 1, difference) & ((1 << extra) - 1)
    scan = _pack((code[size] << extra) | low, lengths[size] + extra)
    table = bytes([0, *counts, *symbols])
    frame = struct.pack(">BHHB", 16, height, width // 2, 2) + bytes((0, 0x11, 0, 1, 0x11, 0))
    return b"".join(
        (
            b"\xff\xd8",
            b"\xff\xc3" + struct.pack(">H", 2 + len(frame)) + frame,
            b"\xff\xc4" + struct.pack(">H", 2 + len(table)) + table,
            b"\xff\xda" + struct.pack(">H", 10) + bytes((2, 0, 0, 1, 0, 1, 0, 0)),
            scan,
            b"\xff\xd9",
        )
    )


def _huffman_lengths(frequency: NDArray[np.intp]) -> NDArray[np.int64]:
    """Code lengths (17,) of the categories that occur, at most 16 bits, none of them all ones.

    A code of d bits needs a total of at least Fibonacci(d + 2) times the rarest count: a floor of 1/1000 of the
    total keeps d ≤ 14. A 17th category that never occurs adds one bit and takes the code of all ones.
    """
    floor = int(frequency.sum()) // 1000 + 1
    heap: list[tuple[int, int, tuple[int, ...]]] = [(max(int(f), floor), s, (s,)) for s, f in enumerate(frequency) if f]
    heap.append((1, 17, (17,)))
    heapq.heapify(heap)
    lengths = np.zeros(18, np.int64)
    while len(heap) > 1:
        a, b = heapq.heappop(heap), heapq.heappop(heap)
        lengths[list(a[2] + b[2])] += 1
        heapq.heappush(heap, (a[0] + b[0], min(a[1], b[1]), a[2] + b[2]))
    return lengths[:17]


def _canonical(lengths: NDArray[np.int64], symbols: list[int]) -> tuple[NDArray[np.int64], list[int]]:
    """Codes (17,) of the symbols in their order, and how many there are of each length 1…16 (T.81 C.2)."""
    code = np.zeros(17, np.int64)
    value, length = 0, 0
    for symbol in symbols:
        value <<= int(lengths[symbol]) - length
        length = int(lengths[symbol])
        code[symbol] = value
        value += 1
    return code, np.bincount(lengths[symbols], minlength=17)[1:].tolist()


def _pack(value: NDArray[np.int64], length: NDArray[np.int64]) -> bytes:
    """Bit fields of at most 32 bits, one after the other, padded with ones, 0xFF followed by 0."""
    end = np.cumsum(length)
    start, total = end - length, int(end[-1])
    word, shift = start >> 5, 64 - (start & 31) - length
    window = value.astype(np.uint64) << shift.astype(np.uint64)
    words = np.zeros((total >> 5) + 2)
    for part, at in ((window >> np.uint64(32), word), (window & np.uint64(0xFFFFFFFF), word + 1)):
        words += np.bincount(at, part.astype(np.float64), len(words))  # fields never overlap: a sum is an or
    stream = words.astype(">u4").view(np.uint8)[: (total + 7) // 8].copy()
    stream[-1] |= (1 << (-total % 8)) - 1
    return stream.tobytes().replace(b"\xff", b"\xff\0")


def _ifd(entries: list[_Entry], offset: int) -> bytes:
    """The bytes of a directory placed at `offset`, its long values after it; entries without a value are left out."""
    valued = sorted((entry for entry in entries if entry[2] is not None), key=itemgetter(0))
    encoded = [(tag, kind, *_encode(kind, value)) for tag, kind, value in valued]
    present = [entry for entry in encoded if entry[3] != b"\0" or entry[1] != _ASCII]
    behind = offset + 2 + 12 * len(present) + 4
    head, tail = struct.pack("<H", len(present)), b""
    for tag, kind, count, data in present:
        if len(data) <= 4:
            place = data.ljust(4, b"\0")
        else:
            place = struct.pack("<I", behind + len(tail))
            tail += data + b"\0" * (len(data) % 2)
        head += struct.pack("<HHI", tag, kind, count) + place
    return head + b"\0\0\0\0" + tail


def _encode(kind: int, value: Any) -> tuple[int, bytes]:
    if kind == _ASCII:
        value = value.encode() + b"\0"
    if isinstance(value, bytes):
        return len(value), value
    values: Sequence[Any] = np.atleast_1d(value).tolist()
    if kind in (_RATIONAL, _SRATIONAL):
        pairs = [Fraction(v).limit_denominator(100000) for v in values]
        return len(values), b"".join(struct.pack(f"<{_CODE[kind]}", *p.as_integer_ratio()) for p in pairs)
    return len(values), struct.pack(f"<{len(values)}{_CODE[kind]}", *values)
