"""In: what a file states and what came out of it. Out: nothing, or an error that says why its pixels cannot be trusted.

Decoders return pixels from files that are cut, stripped or of a form they do not know: black, grey, or whatever
lay in memory. In the worker.
"""

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.errors import DecodeError
from polcap.formats.raw import sniff

MOST_PIXELS = 256_000_000  # the largest sensor has 151 million, a pixel shift of four exposures 240
_LEAST_BITS = 0.5  # of a file per pixel of a RAW: lossless coding takes one at least, a Kodak's JPEG-RAW about this
_FORMS = {
    9: "a GoPro GPR (VC-5 compression 9); convert it to DNG with GoPro's gpr_tools or Adobe DNG Converter",
    52546: "a DNG of JPEG XL (compression 52546); convert the original RAW without it, to DNG 1.4",
}
_LOSSY = 34892  # JPEG of 8 bits under a curve; LibRaw decodes some of them to black
DEVELOP = (
    "neither Bayer (2×2) nor X-Trans (6×6); develop every photograph alike to linear 16-bit TIFF (no tone curve, no "
    "denoising, one white balance), or use a camera with a Bayer, X-Trans or monochrome sensor"
)
_COPY_AGAIN = "copy it from the card again"
_PART = 1 << 20  # bytes of coded data that are searched at a time
_PNG = b"\x89PNG\r\n\x1a\n"
_SAMPLES = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # of a PNG's pixel by its color type
_DEFLATE = 1032  # zlib makes no byte of more than so many (zlib.net, Technical Details: Maximum Compression Factor)
_CLIPPED_SHARE = 0.5  # of a picture; no exposure of use has more at the white level
_BEYOND = 2.0  # white levels; counts that reach so far deny the level


def check_size(path: str, width: int, height: int) -> None:
    """Refuse a picture of no pixels, or of more than any camera takes, before memory is taken for it: DecodeError."""
    if width < 1 or height < 1:
        raise DecodeError(f"{path}: states {width}×{height} px; it is damaged, {_COPY_AGAIN}")
    if width * height > MOST_PIXELS:
        raise DecodeError(
            f"{path}: states {width}×{height} px, more than the {MOST_PIXELS / 1e6:.0f} million of any camera; "
            "it is damaged, or make it smaller"
        )


def check_bytes(path: str, width: int, height: int, size: int) -> None:
    """A file too small for its pixels is a remnant.

    Parameters
    ----------
    path
        For the message.
    width, height
        px, as stated.
    size
        Bytes of the file.

    Raises
    ------
    DecodeError
        Fewer bits per pixel than any camera writes.
    """
    if 8 * size < _LEAST_BITS * width * height:
        raise DecodeError(
            f"{path}: {size / 1e3:.0f} kB cannot hold {width}×{height} px; only its beginning is there, {_COPY_AGAIN}"
        )


def check_png(path: str, data: bytes) -> None:
    """A PNG holds the pixels that it states, before memory is taken for them; what is no PNG passes.

    Raises
    ------
    DecodeError
        More pixels than any camera has, or than its bytes can be unpacked to.
    """
    if data[:8] != _PNG or len(data) < 26:
        return
    width, height, bits, kind = struct.unpack_from(">IIBB", data, 16)
    check_size(path, width, height)
    if height * (1 + width * bits * _SAMPLES.get(kind, 1) // 8) > _DEFLATE * len(data):
        raise DecodeError(
            f"{path}: {len(data) / 1e3:.3g} kB cannot hold {width}×{height} px; it is damaged, {_COPY_AGAIN}"
        )


def check_structure(path: str, structure: sniff.Tiff, data: bytes) -> None:
    """Refuse by name what LibRaw decodes wrongly, and a DNG whose image data are not there: DecodeError."""
    images = [one for one in structure.directories if _is_sensor(one)]
    for directory in images:
        form = _FORMS.get(sniff.first(directory, sniff.COMPRESSION), "")
        if form and structure.dng:
            raise DecodeError(f"{path}: is {form}")
        layout = sniff.first(directory, sniff.CFA_LAYOUT, 1)
        if layout != 1:  # LibRaw takes staggered rows for a rectangular mosaic
            raise DecodeError(f"{path}: its colour filter is staggered (CFALayout {layout}, SuperCCD), {DEVELOP}")
        _check_strips(path, directory, structure.dng)
        _check_jpeg(path, directory, data)
    if structure.dng and not images:
        raise DecodeError(f"{path}: is a DNG without a sensor image, its data were stripped; {_COPY_AGAIN}")


def is_lossy(structure: sniff.Tiff) -> bool:
    """The sensor image is a lossy DNG's."""
    return any(_is_sensor(one) and sniff.first(one, sniff.COMPRESSION) == _LOSSY for one in structure.directories)


def _is_sensor(directory: sniff.Directory) -> bool:
    return sniff.first(directory, sniff.PHOTOMETRIC) in (sniff.CFA, sniff.LINEAR_RAW)


def _check_strips(path: str, directory: sniff.Directory, dng: bool) -> None:
    """Uncompressed pixels fill the bytes that are stated for them; others have some."""
    held = sum(length for _, length in sniff.strips(directory))
    width, height = sniff.first(directory, sniff.WIDTH), sniff.first(directory, sniff.LENGTH)
    check_size(path, max(width, 1), max(height, 1))
    bits = sniff.first(directory, sniff.BITS, 8) * sniff.first(directory, sniff.SAMPLES, 1)
    plain = sniff.first(directory, sniff.COMPRESSION, 1) == 1
    needed = width * height * (bits if plain else _LEAST_BITS) / 8
    if dng and held < needed:
        raise DecodeError(
            f"{path}: states {held} bytes of image data where {width}×{height} px need {needed:.0f}; "
            f"it was stripped or damaged, {_COPY_AGAIN}"
        )


def _check_jpeg(path: str, directory: sniff.Directory, data: bytes) -> None:
    """The last strip of JPEG data, lossless or not, has its end marker."""
    ends = sorted(sniff.strips(directory))[-1:]
    for offset, _ in ends:
        if data[offset : offset + 2] == b"\xff\xd8":
            check_jpeg(path, data, offset)


def check_jpeg(path: str, data: bytes, start: int = 0) -> None:
    """A JPEG from `start` on goes on until its end marker; a cut one decodes, its rest grey. Raises DecodeError."""
    at = start + 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            break
        marker = data[at + 1]
        if marker == 0xD9:
            return
        if marker == 0xFF:  # filling
            at += 1
            continue
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        if marker == 0xDA:  # coded data follow
            at = end_of_scan(data, at)
    if data[at : at + 2] != b"\xff\xd9":
        raise DecodeError(f"{path}: is cut short, its JPEG data have no end; {_COPY_AGAIN}")


def end_of_scan(data: bytes, start: int) -> int:
    """Where the first marker after a JPEG scan's coded data stands: FF, and what is neither stuffing nor a restart."""
    coded = np.frombuffer(data, np.uint8)
    for at in range(start, len(data), _PART):
        part = coded[at : at + _PART + 1]
        marks = np.flatnonzero(part[:-1] == 0xFF)
        code = part[marks + 1]
        ends = marks[(code != 0) & (code != 0xFF) & ((code < 0xD0) | (code > 0xD7))]
        if len(ends):
            return at + int(ends[0])
    return len(data)


def check_levels(path: str, value: NDArray[Any], black: float, white: float, lossy: bool) -> None:
    """Refuse a mosaic that its own levels deny.

    Parameters
    ----------
    path
        For the message.
    value
        (H, W) or (H, W, C) counts.
    black, white
        Counts, as stated.
    lossy
        It is a lossy DNG.

    Raises
    ------
    DecodeError
        Counts far beyond the white level, rows that were never written, or nothing at all.
    """
    if lossy and not value.any():
        raise DecodeError(
            f"{path}: is a lossy DNG (JPEG compression {_LOSSY}) that LibRaw decodes to black; "
            "convert the original RAW without lossy compression"
        )
    if not value.any():
        raise DecodeError(f"{path}: decodes to nothing, every count is 0; {_COPY_AGAIN}")
    if white <= black:
        raise DecodeError(f"{path}: its black level {black:g} is not below its white level {white:g}; it is damaged")
    top = float(value.max(initial=0))
    if top > _BEYOND * white and float(np.mean(value >= white)) > _CLIPPED_SHARE:
        raise DecodeError(
            f"{path}: its white level is {white:g}, but its counts reach {top:.0f}; the level is wrong (a scanner's "
            "file?); convert it to linear 16-bit TIFF"
        )
    rows = max(1, len(value) // 50)
    if black > 0 and top > black and not value[-rows:].any():
        raise DecodeError(f"{path}: its last rows are empty, below the sensor's black level; it is cut, {_COPY_AGAIN}")
