"""In: a DNG whose mosaic is lossless JPEG. Out: its counts by libjpeg-turbo, and the rest of the file for LibRaw.

LibRaw takes three times as long for the same counts. So where imagecodecs is installed (extra `[fast]`), JPEG data of
the forms that both read alike are decoded here, and LibRaw is given the file without them: levels, colors and margins
are its reading either way. Whatever else stands in the file, or fails here, is LibRaw's alone. In the worker.
"""

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polcap.formats.raw import plausible, sniff

_LOSSLESS, _LOSSLESS_HUFFMAN, _SCAN = 7, 0xC3, 0xDA  # compression of the TIFF; frame and scan of the JPEG
_TABLES, _RESTARTS = 0xC4, 0xDD  # Huffman tables, interval of restarts
_BEFORE = {_TABLES, _RESTARTS, 0xFE, *range(0xE0, 0xF0)}  # of a scan: these, a comment, applications
_ONE_TO_ONE = 0x11  # sampling of a component
_SINCE = (1, 1)  # DNG version; before it a difference of 16 bits was coded in another way
_MOST_HEADER = 64  # segments before the scan
_PAST_END = 32 * b"\xff\0"  # ones, which are no code: who reads on behind a scan's end decodes differences of 0
_LAST = 256  # bytes of a scan that are looked at for its end; more of filling is left to LibRaw
_CATEGORIES = np.frexp(np.abs(np.arange(1 << 16, dtype=np.uint16).astype(np.int16).astype(int)))[1]  # T.81, table H.2
_ROWS = 256  # whose differences are counted at a time

Counts = NDArray[np.uint16]
Codes = dict[int, tuple[int, int]]  # of a category of differences: the code, and its length in bits


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
    codes: tuple[Codes, ...]  # of each component; none where the scan has restarts or tables that are not there


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
        if len(windows) == 1:
            return part
        room[:] = part[: room.shape[0], : room.shape[1]]
    return mosaic


def hollow(structure: sniff.Tiff, data: bytes) -> bytes:
    """The file without the beginning of its first JPEG: LibRaw reads what it states, and ends before its counts."""
    image = _sensor(structure)
    assert image is not None
    start = _windows(image)[0].offset
    return b"".join([data[:start], b"\0\0", memoryview(data)[start + 2 :]])


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
        part = jpeg8_decode(b"".join([memoryview(data)[window.offset : end], _PAST_END, b"\xff\xd9"]))
    except Jpeg8Error:
        return None
    if part.dtype != np.uint16 or part.size != window.height * window.width or int(part.max()) >> scan.bits:
        return None
    if not _in_scan(part.reshape(*part.shape[:2], -1), scan, data, end):
        return None  # the scan was too short, which LibRaw tells
    decoded: Counts = part.reshape(window.height, window.width)
    return decoded


def _in_scan(samples: Counts, scan: _Scan, data: bytes, end: int) -> bool:
    """Whether all differences were in a scan, none decoded of what was put behind it.

    The last one's code has to stand at the end. The bits of all are counted where that may be chance: where ones, which
    are put there, or zeros, which the decoder puts behind them, give the same.

    Parameters
    ----------
    samples
        (h, w, components) as decoded.
    scan
        Of the JPEG.
    data
        All bytes of the file, which nothing here copies.
    end
        Where the coded differences end in it, ones filling up the last byte.
    """
    last = data[max(scan.start, end - _LAST) : end].rstrip(b"\xff")
    end = max(scan.start, end - _LAST) + len(last)
    if not last or not scan.codes or data.find(b"\xff\xff", scan.start, end) >= 0:  # filling ends it for LibRaw
        return False
    difference = int(_differences(samples[-2:, :, -1], scan.bits)[-1, -1])
    code, length = _coded(difference, scan.codes[-1])
    tail = int.from_bytes(last[-32:].replace(b"\xff\0", b"\xff"), "big")
    ends = [left for left in range(8) if tail & _ones(length + left) == (code << left | _ones(left))]
    if not ends or not length:
        return False
    cuts = [cut for cut in range(1, length) if code & _ones(cut) == _ones(cut)]  # what is missing may have been ones
    if difference and code and not any(tail & _ones(length - cut) == code >> cut for cut in cuts):
        return True
    bits = sum(_bits(samples[..., n], scan.bits, codes) for n, codes in enumerate(scan.codes))
    return 8 * (end - scan.start - data.count(b"\xff\0", scan.start, end)) - bits in ends


def _coded(difference: int, codes: Codes) -> tuple[int, int]:
    """A difference as it is coded, and how many bits that takes; 0 where it has no code.

    References
    ----------
    ITU-T T.81, F.1.2.1.1 and H.1.2.2.
    """
    signed = difference - (difference >> 15 << 16)
    category = abs(signed).bit_length()
    code, length = codes.get(category, (0, 0))
    if not length or category == 16:
        return code, length
    return code << category | (signed if signed > 0 else signed + _ones(category)), length + category


def _ones(many: int) -> int:
    return (1 << many) - 1


def _bits(samples: Counts, bits: int, codes: Codes) -> int:
    """How many the differences of samples (h, w) take; more than any scan has, where one has no code."""
    times = np.zeros(1 << 16, np.int64)  # of each difference
    for top in range(0, len(samples), _ROWS):
        rows = _differences(samples[max(top - 1, 0) : top + _ROWS], bits)[min(top, 1) :]
        times += np.bincount(rows.reshape(-1), minlength=1 << 16)
    of_category = np.bincount(_CATEGORIES, times, 17).astype(int).tolist()
    lengths = [codes[n][1] + n % 16 if n in codes else 1 << 40 for n in range(17)]
    return sum(many * length for many, length in zip(of_category, lengths))


def _differences(samples: Counts, bits: int) -> Counts:
    """Samples (h, w) less what predicts them, mod 2^16: the one on the left, of the first the one above."""
    before = np.concatenate([np.array([1 << (bits - 1)], np.uint16), samples[:-1, 0]])
    return np.diff(samples, axis=1, prepend=before[:, None])


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
    restarts, tables = False, dict[int, Codes]()
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
            named = [tables.get(number >> 4) for number in body[2 : 1 + 2 * components : 2]]
            codes = tuple(table for table in named if table is not None)
            known = not restarts and len(codes) == components
            return _Scan(at, bits, codes if known else ()) if bits and left else None
        elif marker not in _BEFORE:
            return None
        restarts |= marker == _RESTARTS
        tables |= _tables(body) if marker == _TABLES else {}
    return None


def _tables(body: bytes) -> dict[int, Codes]:
    """Huffman tables of a segment, by their numbers; what is damaged is left out.

    References
    ----------
    ITU-T T.81, B.2.4.2 and C.2.
    """
    tables: dict[int, Codes] = {}
    while len(body) > 17:
        number, lengths, body = body[0], body[1:17], body[17:]
        codes, code = Codes(), 0
        categories = iter(body[: sum(lengths)])
        for length, many in enumerate(lengths, 1):
            codes |= {category: (code + n, length) for n, category in zip(range(many), categories)}
            code = code + many << 1
        tables[number], body = codes, body[sum(lengths) :]
    return tables
