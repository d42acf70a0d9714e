"""Refuses photographs that are cut short, incomplete, have wrong levels, or are of a kind that decoders misread.

Decoders return false pixels from such files without an error. The checks run in the child process.
"""

import re
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polcap.errors import DecodeError
from polcap.formats.raw import file_kind
from polcap.formats.raw.file_kind import Directory, TiffStructure, first

MOST_PIXELS = 256_000_000  # the largest sensor has 151 million, a pixel shift of four exposures 240
_LEAST_BITS = 0.5  # per pixel of a RAW file: lossless coding takes one at least, Kodak's JPEG-RAW about half
_REFUSED_COMPRESSION = {
    9: "a GoPro GPR (VC-5 compression 9); convert it to DNG with GoPro's gpr_tools or Adobe DNG Converter",
    52546: "a DNG of JPEG XL (compression 52546); convert the original RAW without it, to DNG 1.4",
}
_LOSSY = 34892  # JPEG of 8 bits under a tone curve; LibRaw decodes some of them to black
DEVELOP = (
    "neither Bayer (2×2) nor X-Trans (6×6); develop every photograph alike to linear 16-bit TIFF (no tone curve, no "
    "denoising, one white balance), or use a camera with a Bayer, X-Trans or monochrome sensor"
)
COPY_AGAIN = "copy it from the card again"
_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")  # of a JPEG, after a scan
_PNG_SAMPLES = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # per pixel, by color type
_DEFLATE = 1032  # greatest compression of zlib (zlib.net, Technical Details: Maximum Compression Factor)
_CLIPPED_SHARE = 0.5  # of a picture; no useful exposure has more at the white level
_PERIOD = 12  # px; mosaics repeat after 2 (Bayer, polarization), 4 (both) or 6 (X-Trans)
_BLOCK = 48  # px
_MOST_BLOCKS = 64  # that are examined
_REPEATED, _CONTRAST = 5.0, 0.01  # of a mosaic's blocks. Measured: 7 to 25 and 0.015 to 0.8; other pictures: 0.7 to 3.1
_BEYOND = 2.0  # white levels; counts that reach so far prove the level wrong


def check_size(path: str, width: int, height: int) -> None:
    """Refuse a picture without pixels, or larger than any camera's, before memory is reserved: DecodeError."""
    if width < 1 or height < 1:
        raise DecodeError(f"{path}: states {width}×{height} px; it is damaged, {COPY_AGAIN}")
    if width * height > MOST_PIXELS:
        raise DecodeError(
            f"{path}: states {width}×{height} px, more than the {MOST_PIXELS / 1e6:.0f} million of any camera; "
            "it is damaged, or make it smaller"
        )


def check_bytes(path: str, width: int, height: int, size: int) -> None:
    """Refuse a file of `size` bytes that is too small for its pixels: only its beginning was copied. DecodeError."""
    if 8 * size < _LEAST_BITS * width * height:
        raise DecodeError(
            f"{path}: {size / 1e3:.0f} kB cannot hold {width}×{height} px; only its beginning is there, {COPY_AGAIN}"
        )


def check_png(path: str, data: bytes) -> None:
    """Refuse a PNG with more pixels than any camera has, or than its bytes can hold; other files pass. DecodeError."""
    if not data.startswith(file_kind.PNG) or len(data) < 26:
        return
    width, height, bits, color_type = struct.unpack_from(">IIBB", data, 16)  # of its first chunk, up to byte 26
    check_size(path, width, height)
    # a row begins with the byte of its filter
    if height * (1 + width * bits * _PNG_SAMPLES.get(color_type, 1) // 8) > _DEFLATE * len(data):
        raise DecodeError(
            f"{path}: {len(data) / 1e3:.3g} kB cannot hold {width}×{height} px; it is damaged, {COPY_AGAIN}"
        )


def check_structure(path: str, structure: TiffStructure, data: bytes) -> None:
    """Refuse a RAW of a kind that LibRaw decodes wrongly, and a DNG without its image data. Raises DecodeError."""
    images = [one for one in structure.directories if file_kind.is_sensor(one)]
    for directory in images:
        refused = _REFUSED_COMPRESSION.get(first(directory, file_kind.COMPRESSION), "")
        if refused and structure.dng:
            raise DecodeError(f"{path}: is {refused}")
        layout = first(directory, file_kind.CFA_LAYOUT, 1)
        if layout != 1:  # LibRaw takes staggered rows for a rectangular mosaic
            raise DecodeError(f"{path}: its color filter is staggered (CFALayout {layout}, SuperCCD), {DEVELOP}")
        _check_strips(path, directory, structure.dng)
        last = sorted(file_kind.strips(directory))[-1:]
        if last and data[last[0][0] : last[0][0] + 2] == b"\xff\xd8":
            check_jpeg(path, data, last[0][0])
    if structure.dng and not images:
        raise DecodeError(f"{path}: is a DNG without a sensor image, its data were stripped; {COPY_AGAIN}")


def is_lossy(structure: TiffStructure) -> bool:
    """Whether the sensor image in this TIFF structure is lossily compressed (a lossy DNG)."""
    return any(
        file_kind.is_sensor(one) and first(one, file_kind.COMPRESSION) == _LOSSY for one in structure.directories
    )


def _check_strips(path: str, directory: Directory, dng: bool) -> None:
    """Refuse a DNG with image strips that have fewer bytes than their pixels need."""
    stored = sum(length for _, length in file_kind.strips(directory))
    width, height = first(directory, file_kind.WIDTH), first(directory, file_kind.LENGTH)
    check_size(path, max(width, 1), max(height, 1))
    bits = first(directory, file_kind.BITS, 8) * first(directory, file_kind.SAMPLES, 1)
    uncompressed = first(directory, file_kind.COMPRESSION, 1) == 1
    needed = width * height * (bits if uncompressed else _LEAST_BITS) / 8
    if dng and stored < needed:
        raise DecodeError(
            f"{path}: states {stored} bytes of image data where {width}×{height} px need {needed:.0f}; "
            f"it was stripped or damaged, {COPY_AGAIN}"
        )


def check_jpeg(path: str, data: bytes, start: int = 0) -> None:
    """Refuse a JPEG from byte `start` on that has no end marker: decoders fill the rest with grey. DecodeError."""
    position = start + 2
    while position + 4 <= len(data) and data[position] == 0xFF:
        marker = data[position + 1]
        if marker == 0xD9:
            return
        if marker == 0xFF:  # padding
            position += 1
            continue
        position += 2 + int.from_bytes(data[position + 2 : position + 4], "big")
        if marker == 0xDA:  # coded data follow, up to a marker that is neither stuffing nor a restart
            end = _MARKER.search(data, position)
            position = end.start() if end else len(data)
    if data[position : position + 2] != b"\xff\xd9":
        raise DecodeError(f"{path}: is cut short, its JPEG data have no end; {COPY_AGAIN}")


def check_levels(path: str, value: NDArray[Any], black: float, white: float, lossy: bool) -> None:
    """Refuse decoded counts (H, W) or (H, W, C) that contradict the stated black and white levels.

    Raises DecodeError: counts far beyond the white level, rows that were never written, or nothing but zeros.
    """
    if lossy and not value.any():
        raise DecodeError(
            f"{path}: is a lossy DNG (JPEG compression {_LOSSY}) that LibRaw decodes to black; "
            "convert the original RAW without lossy compression"
        )
    if not value.any():
        raise DecodeError(f"{path}: decodes to nothing, every count is 0; {COPY_AGAIN}")
    if white <= black:
        raise DecodeError(f"{path}: its black level {black:g} is not below its white level {white:g}; it is damaged")
    top = float(value.max(initial=0))
    if top > _BEYOND * white and float(np.mean(value >= white)) > _CLIPPED_SHARE:
        raise DecodeError(
            f"{path}: its white level is {white:g}, but its counts reach {top:.0f}; the level is wrong (a scanner's "
            "file?); convert it to linear 16-bit TIFF"
        )
    rows = max(1, len(value) // 50)  # the last 2 %
    if black > 0 and top > black and not value[-rows:].any():
        raise DecodeError(f"{path}: its last rows are empty, below the sensor's black level; it is cut, {COPY_AGAIN}")


def check_no_mosaic(path: str, pixels: NDArray[Any]) -> None:
    """Refuse a gray picture (H, W) that is a sensor's mosaic: neighboring pixels differ alike all over. DecodeError.

    In the brightest blocks, second differences along rows and columns are averaged over pixels of equal place in the
    mosaic. The power of these means over that expected of unrelated pixels is about 1 in a picture of one channel.
    """
    rows, columns = (side // _BLOCK for side in pixels.shape)
    tiled = pixels[: rows * _BLOCK, : columns * _BLOCK].reshape(rows, _BLOCK, columns, _BLOCK)
    blocks = tiled.swapaxes(1, 2).reshape(-1, _BLOCK, _BLOCK)
    light = blocks.mean(axis=(1, 2), dtype=np.float64)
    uneven = np.flatnonzero((np.ptp(blocks, axis=(1, 2)) > 0) & (light > 0))
    brightest = uneven[np.argsort(-light[uneven])][: max(1, min(_MOST_BLOCKS, len(uneven) // 4))]
    value = blocks[brightest].astype(np.float32)
    if not len(value):
        return
    samples = (_BLOCK // _PERIOD - 1) * (_BLOCK // _PERIOD)  # of each place in the mosaic: one period less along `axis`
    repeated, contrast = [], []
    for axis in (1, 2):
        lines = np.moveaxis(value, axis, 1)
        differences = (lines[:, 1:-1] - (lines[:, :-2] + lines[:, 2:]) / 2)[:, : _BLOCK - _PERIOD]
        means = differences.reshape(len(value), -1, _PERIOD, _BLOCK // _PERIOD, _PERIOD).mean(axis=(1, 3))
        power = np.mean(means**2, axis=(1, 2))
        repeated.append(samples * power / np.maximum(np.mean(differences**2, axis=(1, 2)), 1e-12))
        contrast.append(np.sqrt(power) / light[brightest])
    if np.median(repeated) > _REPEATED and np.median(contrast) > _CONTRAST:
        raise DecodeError(
            f"{path}: is a sensor's mosaic in a gray file; give the camera's RAW or a DNG, or develop it to a linear "
            'color picture; a polarization sensor\'s frame is read with sensor = "polarization" in capture.toml'
        )
